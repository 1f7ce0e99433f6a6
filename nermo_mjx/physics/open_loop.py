"""Differentiable trajectories of any MuJoCo model on MuJoCo C: states from an initial state and controls, in open loop.

The derivative of a step is that of the solution of MuJoCo's discrete inverse dynamics (implicit function theorem). With
a = (v' - v) / h and the inverse dynamics' force f(q, v, a, act, u), which is zero along a motion,

    dv' = dv - h (df/da)^-1 (df/dq dq + df/dv dv + df/dact dact + df/du du).

`mjd_inverseFD` gives the first three derivatives by differences (`mjENBL_INVDISCRETE`, so that it includes the implicit
terms of the integrator). The derivatives with respect to activations and controls are differences of the same function.
If the inverse dynamics does not return the step (Runge-Kutta, the noslip solver), the derivatives are differences of
steps.
"""

from __future__ import annotations

import copy
import threading
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Final, NamedTuple, NoReturn

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float
from mujoco import rollout

from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.runtime import thread_count
from nermo_mjx.shapes import Array

#: Half-widths of the differences, the first at which both sides agree: wide ones have little rounding, and narrow ones
#: seldom cross the border of a contact. For accelerations, as a share of the largest.
HALF_WIDTHS: Final = (1e-6, 1e-7, 1e-8)
#: The same of differences of steps, which are exact to the solver's tolerance.
STEP_WIDTH: Final = 1e-6
#: The same of activations and controls, in which forces are smooth.
ACTUATION_WIDTH: Final = 1e-6
#: The forward and the backward difference of a smooth function are nearer than this, as a share of the larger. Then
#: their mean is exact to its square.
LARGEST_ASYMMETRY: Final = 3e-3
#: Largest force that the inverse dynamics may leave over, as a share of the forces in it.
LARGEST_RESIDUAL_SHARE: Final = 1e-6
#: Tolerance and most iterations of the constraint solver: at MuJoCo's default of 1e-8 states are no smooth function.
SOLVER_TOLERANCE: Final = 1e-12
SOLVER_ITERATIONS: Final = 200
#: Joints with a quaternion.
FREE_JOINT_TYPE, BALL_JOINT_TYPE = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_BALL)
#: Activations whose next value follows from themselves and the control.
_SIMPLE_ACTIVATIONS: Final = ("NONE", "INTEGRATOR", "FILTER", "FILTEREXACT", "MUSCLE")
_FULL_STATE: Final = mujoco.mjtState.mjSTATE_FULLPHYSICS
_SECOND_DERIVATIVE_MESSAGE: Final = (
    "A trajectory on MuJoCo C has first derivatives only: for others take nermo_mjx.dynamics.step."
)


def first_order_callback(
    function: Callable[..., Any], shapes: Any, refusal: str, *arguments: Array
) -> Any:
    """A callback under `jit` and `vmap`; a further derivative raises `ParameterError` with the message `refusal`."""

    @jax.custom_jvp
    def called(*arguments: Array) -> Any:
        return jax.pure_callback(function, shapes, *arguments, vmap_method="broadcast_all")

    @called.defjvp
    def refused(primals: Any, tangents: Any) -> NoReturn:
        raise ParameterError(refusal)

    return called(*arguments)


class States(NamedTuple):
    """States of a trajectory of T steps, the initial state first.

    Attributes:
        qpos, qvel, act: Positions (T + 1, nq), velocities (T + 1, nv) and activations (T + 1, na).
    """

    qpos: Float[Array, "states nq"]
    qvel: Float[Array, "states nv"]
    act: Float[Array, "states na"]


class Linearized(NamedTuple):
    """Derivatives of the T steps of a trajectory, in MuJoCo's tangent space x = (dq, dv, dact), of size 2 nv + na.

    Attributes:
        states: States, (T + 1, ...) each.
        a: Derivatives d x' / d x (T, 2 nv + na, 2 nv + na).
        b: Derivatives d x' / d u (T, 2 nv + na, nu).
        kinks: Whether contacts or limits change within the width of the differences (T,).
    """

    states: States
    a: np.ndarray
    b: np.ndarray
    kinks: np.ndarray


class Trajectory:
    """The motion of a model as a function of initial state and controls, for `jax.grad`, `jax.jvp`, `jax.vmap` and `jax.jit`.

    >>> xml = "<mujoco><worldbody><body><joint name='a' axis='0 1 0'/><geom size='.1' pos='0 0 -1'/></body></worldbody>"
    >>> xml += "<actuator><motor joint='a' gear='10'/></actuator></mujoco>"
    >>> from nermo_mjx.physics import trajectory
    >>> swing = trajectory(mujoco.MjModel.from_xml_string(xml))
    >>> height = lambda torque: swing(jnp.zeros(1), jnp.zeros(1), jnp.full((100, 1), torque)).qpos[-1, 0]
    >>> bool(jax.grad(height)(0.5) > 0)
    True

    It is simulated in float64 whatever JAX's precision, at a solver tolerance of 1e-12; nothing of it is compiled. A
    batch runs on all cores. A derivative costs some 30 trajectories, for any number of parameters. Where the set of
    active contacts changes within the narrowest width, 1e-8, a warning names the steps: the derivative there
    is the mean of its two sides. What the start does not contain (mocap bodies, applied forces) is as in `MjData`.
    """

    def __init__(self, model: mujoco.MjModel, threads: int | None = None) -> None:
        """
        Args:
            model: Compiled model, which is copied.
            threads: Processors that share a batch, by default all.

        Raises:
            ParameterError: The model has states other than positions, velocities and activations.
        """
        if model.npluginstate or getattr(model, "nhistory", 0):
            raise ParameterError(
                "The model has states of plugins or delays, which a trajectory does not contain."
            )
        self.model = copy.copy(model)
        self.model.opt.tolerance = min(model.opt.tolerance, SOLVER_TOLERANCE)
        self.model.opt.iterations = max(model.opt.iterations, SOLVER_ITERATIONS)
        self._inverse = copy.copy(self.model)
        self._inverse.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_INVDISCRETE)
        dynamics = {
            mujoco.mjtDyn(int(kind)).name.removeprefix("mjDYN_") for kind in model.actuator_dyntype
        }
        invertible = (
            model.opt.integrator != mujoco.mjtIntegrator.mjINT_RK4
            and not model.opt.noslip_iterations
        )
        self._by_inverse = bool(invertible and dynamics <= set(_SIMPLE_ACTIVATIONS))
        self.threads, self._local = thread_count(threads), threading.local()
        self._simulated = self._differentiable()

    def __call__(self, qpos: Any, qvel: Any, ctrl: Any, act: Any = None) -> States:
        """States of T steps.

        Args:
            qpos, qvel: Initial positions (nq,) and velocities (nv,).
            ctrl: Controls of each step (T, nu).
            act: Initial activations (na,), by default 0.

        Raises:
            ParameterError: An argument has another shape.
        """
        act = jnp.zeros(self.model.na) if act is None else act
        sizes = {"qpos": self.model.nq, "qvel": self.model.nv, "act": self.model.na}
        for (name, size), argument in zip(sizes.items(), (qpos, qvel, act), strict=True):
            if jnp.shape(argument) != (size,):
                raise ParameterError(
                    f"{name} has shape {jnp.shape(argument)}: expected ({size},); use jax.vmap for a batch."
                )
        if jnp.ndim(ctrl) != 2 or jnp.shape(ctrl)[1] != self.model.nu:
            raise ParameterError(
                f"ctrl has shape {jnp.shape(ctrl)}: expected (steps, {self.model.nu})."
            )
        return self._simulated(
            *(jnp.asarray(argument_value, float) for argument_value in (qpos, qvel, act, ctrl))
        )

    def linearized(self, qpos: Any, qvel: Any, ctrl: Any, act: Any = None) -> Linearized:
        """The same trajectory with the derivatives of its steps, in NumPy and float64; the arguments are the same."""
        act = np.zeros(self.model.na) if act is None else act
        start = np.concatenate([np.asarray(part, float) for part in (qpos, qvel, act)])[None]
        controls = np.asarray(ctrl, float)[None]
        states = self._states(start, controls)
        a, b, kinks = self._steps(states, controls)
        return Linearized(States(*(part[0] for part in self._parts(states))), a[0], b[0], kinks[0])

    # Long because the rule of the derivative uses the local functions before it.
    def _differentiable(self) -> Callable[..., States]:
        m = self.model
        nx = 2 * m.nv + m.na

        def shapes(steps: int) -> tuple[States, tuple[Any, ...]]:
            real = jnp.zeros(()).dtype
            parts: Any = [
                jax.ShapeDtypeStruct((steps + 1, size), real) for size in (m.nq, m.nv, m.na)
            ]
            sizes = ((steps, nx, nx), (steps, nx, m.nu), (steps + 1, m.nq, m.nv))
            return States(*parts), tuple(jax.ShapeDtypeStruct(size, real) for size in sizes)

        def batched(*arguments: Any) -> tuple[tuple[int, ...], np.ndarray, np.ndarray]:
            qpos, qvel, act, ctrl = (np.asarray(argument, float) for argument in arguments)
            start = np.concatenate([qpos, qvel, act], axis=-1)
            rows = start.reshape(-1, start.shape[-1])
            return start.shape[:-1], rows, ctrl.reshape(len(rows), *ctrl.shape[-2:])

        def like(tree: Any, lead: tuple[int, ...], expected: Any) -> Any:
            return jax.tree.map(
                lambda leaf, expected_leaf: leaf.reshape(*lead, *expected_leaf.shape).astype(
                    expected_leaf.dtype
                ),
                tree,
                expected,
            )

        def values(*arguments: Any) -> States:
            lead, start, controls = batched(*arguments)
            return like(
                self._parts(self._states(start, controls)), lead, shapes(controls.shape[1])[0]
            )

        def slopes(*arguments: Any) -> tuple[States, tuple[Any, ...]]:
            lead, start, controls = batched(*arguments)
            states = self._states(start, controls)
            a, b, kinks = self._steps(states, controls)
            if kinks.any():
                steps = np.flatnonzero(kinks.any(axis=0))
                step_names = ", ".join(map(str, steps[:10])) + (", ..." if len(steps) > 10 else "")
                warnings.warn(
                    f"The set of active contacts or limits changes within {HALF_WIDTHS[-1]:g} at {len(steps)} steps "
                    f"({step_names}): the derivative there is the mean of its two sides.",
                    stacklevel=2,
                )
            parts = self._parts(states)
            return like((parts, (a, b, self._turns(parts.qpos))), lead, shapes(controls.shape[1]))

        @jax.custom_jvp
        def simulated(*arguments: Array) -> States:
            return first_order_callback(
                values, shapes(arguments[-1].shape[0])[0], _SECOND_DERIVATIVE_MESSAGE, *arguments
            )

        @simulated.defjvp
        def rule(primals: tuple[Array, ...], tangents: tuple[Array, ...]) -> tuple[States, States]:
            states, (a, b, turns) = first_order_callback(
                slopes, shapes(primals[-1].shape[0]), _SECOND_DERIVATIVE_MESSAGE, *primals
            )
            dqpos, dqvel, dact, dctrl = tangents
            # Only the rotation of a quaternion counts: its rows have the square 1/4.
            scale = jnp.where((turns[0] ** 2).sum(axis=0) < 0.5, 4.0, 1.0)
            first = jnp.concatenate([scale * (turns[0].T @ dqpos), dqvel, dact])

            def step(x: Array, matrices: tuple[Array, Array, Array]) -> tuple[Array, Array]:
                next_x = matrices[0] @ x + matrices[1] @ matrices[2]
                return next_x, next_x

            with jax.default_matmul_precision("highest"):
                _, others = jax.lax.scan(step, first, (a, b, dctrl))
                x = jnp.concatenate([first[None], others])
                dq, dv, da = x[:, : m.nv], x[:, m.nv : 2 * m.nv], x[:, 2 * m.nv :]
                return states, States(jnp.einsum("tqv,tv->tq", turns, dq), dv, da)

        return simulated

    def _parts(self, states: Any) -> States:
        """Positions, velocities and activations of states (..., nq + nv + na)."""
        nq, nv = self.model.nq, self.model.nv
        return States(states[..., :nq], states[..., nq : nq + nv], states[..., nq + nv :])

    def _states(self, start: np.ndarray, controls: np.ndarray) -> np.ndarray:
        """States (n, T + 1, nq + nv + na) of n trajectories."""
        worlds, steps, _ = controls.shape
        data = [mujoco.MjData(self.model) for _ in range(max(1, min(self.threads, worlds)))]
        first = np.concatenate([np.zeros((worlds, 1)), start], axis=1)
        for row in first:  # MuJoCo's own normalization, so that all states are of one kind
            mujoco.mj_normalizeQuat(self.model, row[1 : 1 + self.model.nq])
        if not steps:
            return first[:, None, 1:]
        states, _ = rollout.rollout(
            self.model, data, first, controls if self.model.nu else None, nstep=steps
        )
        return np.concatenate([first[:, None], states], axis=1)[:, :, 1:]

    def _steps(
        self, states: np.ndarray, controls: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Derivatives of the steps between states: a (n, T, x, x), b (n, T, x, u), and kinks (n, T)."""
        (worlds, steps, nu), nx = controls.shape, 2 * self.model.nv + self.model.na
        a, b = np.zeros((worlds, steps, nx, nx)), np.zeros((worlds, steps, nx, nu))
        kinks = np.zeros((worlds, steps), bool)

        def some(places: Sequence[tuple[int, int]]) -> None:
            forward, inverse = mujoco.MjData(self.model), mujoco.MjData(self._inverse)
            for n, t in places:
                if self._by_inverse:
                    slopes = self._implicit(inverse, states[n, t], controls[n, t], states[n, t + 1])
                    if slopes is not None:
                        a[n, t], b[n, t], kinks[n, t] = slopes
                        continue
                a[n, t], b[n, t], kinks[n, t] = self._explicit(
                    forward, states[n, t], controls[n, t]
                )

        places = [(n, t) for n in range(worlds) for t in range(steps)]
        shares = [places[i :: self.threads] for i in range(self.threads)]
        if self.threads == 1 or len(places) < 2 * self.threads:
            some(places)
        else:
            with ThreadPoolExecutor(self.threads) as pool:
                list(pool.map(some, shares))
        return a, b, kinks

    def _explicit(
        self, data: mujoco.MjData, state: np.ndarray, control: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, bool]:
        """Derivatives of a step by differences of steps, and whether their two sides differ."""
        m = self.model
        nx = 2 * m.nv + m.na

        def after(column: int, width: float) -> np.ndarray:
            self._set(m, data, state, control)
            way = np.eye(1, nx + m.nu, column)[0]
            mujoco.mj_integratePos(m, data.qpos, np.ascontiguousarray(way[: m.nv]), width)
            data.qvel[:] += width * way[m.nv : 2 * m.nv]
            data.act[:] += width * way[2 * m.nv : nx]
            data.ctrl[:] += width * way[nx:]
            mujoco.mj_step(m, data)
            return np.concatenate([data.qpos, data.qvel, data.act])

        def rise(low: np.ndarray, high: np.ndarray) -> np.ndarray:
            turned = np.zeros(m.nv)
            mujoco.mj_differentiatePos(m, turned, 1.0, low[: m.nq], high[: m.nq])
            return np.concatenate([turned, (high - low)[m.nq :]])

        middle = after(0, 0.0)
        upper = np.stack(
            [rise(middle, after(i, STEP_WIDTH)) / STEP_WIDTH for i in range(nx + m.nu)], axis=1
        )
        lower = np.stack(
            [rise(after(i, -STEP_WIDTH), middle) / STEP_WIDTH for i in range(nx + m.nu)], axis=1
        )
        whole = 0.5 * (upper + lower)
        return whole[:, :nx], whole[:, nx:], _apart(upper, lower)

    def _set(
        self, model: mujoco.MjModel, data: mujoco.MjData, state: np.ndarray, control: np.ndarray
    ) -> None:
        """Set the data to a state, as in a rollout, without a warm start from another state."""
        mujoco.mj_resetData(model, data)
        mujoco.mj_setState(model, data, np.concatenate([[0.0], state]), _FULL_STATE)
        data.ctrl[:] = control

    def _implicit(
        self, data: mujoco.MjData, state: np.ndarray, control: np.ndarray, next_state: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, bool] | None:
        """Derivatives of a step by the implicit function theorem; None if the inverse dynamics does not return it."""
        m = self._inverse
        nv, na, h = m.nv, m.na, float(m.opt.timestep)
        self._set(m, data, state, control)
        v, v_next = (self._parts(state_vector).qvel for state_vector in (state, next_state))
        data.qacc[:] = (v_next - v) / h
        mujoco.mj_inverse(m, data)
        acceleration = data.qacc.copy()
        largest = max(
            np.abs(state_vector).max(initial=0.0)
            for state_vector in (data.qfrc_inverse, data.qfrc_constraint, data.qfrc_bias)
        )
        mujoco.mj_fwdActuation(m, data)
        if (
            np.abs(data.qfrc_inverse - data.qfrc_actuator).max(initial=0.0)
            > LARGEST_RESIDUAL_SHARE * largest
        ):
            return None
        sides, kink = self._inverse_changes(data, max(1.0, np.abs(acceleration).max(initial=0.0)))
        force_q, force_v, force_a = (0.5 * (up + down).T for up, down in zip(*sides, strict=True))
        data.qacc[:] = acceleration
        (force_act, act_act), (force_u, act_u) = self._actuation_slopes(data)
        try:
            v_by = -h * np.linalg.solve(
                force_a, np.concatenate([force_q, force_v, force_act, force_u], axis=1)
            )
        except np.linalg.LinAlgError:
            return None
        v_by[:, nv : 2 * nv] += np.eye(nv)
        nx = 2 * nv + na
        q_q, q_v = self._integrated(v_next, h)
        q_by = q_v @ v_by
        q_by[:, :nv] += q_q
        act_by = np.concatenate([np.zeros((na, 2 * nv)), act_act, act_u], axis=1)
        slopes = np.concatenate([q_by, v_by, act_by])
        return slopes[:, :nx], slopes[:, nx:], kink

    def _inverse_changes(
        self, data: mujoco.MjData, fast: float
    ) -> tuple[list[list[np.ndarray]], bool]:
        """One-sided derivatives of the inverse dynamics on both sides, and whether they differ.

        Args:
            data: Data at the state, with the inverse dynamics computed.
            fast: Factor by which the width for accelerations is larger.
        """
        m, kink, sides = self._inverse, False, list[list[np.ndarray]]()
        # The force is linear in accelerations, except where rows change. For large accelerations, a small width would only
        # cause rounding errors.
        for width in HALF_WIDTHS:
            sides = [[np.zeros((m.nv, m.nv)) for _ in range(3)] for _ in "+-"]
            for side, by in zip((1.0, -1.0), sides, strict=True):
                mujoco.mjd_inverseFD(
                    m, data, side * width, True, by[0], by[1], None, None, None, None, None
                )
                mujoco.mjd_inverseFD(
                    m, data, side * width * fast, True, None, None, by[2], None, None, None, None
                )
            kink = any(_apart(up, down) for up, down in zip(*sides, strict=True))
            if not kink:
                break
        return sides, kink

    def _actuation_slopes(self, data: mujoco.MjData) -> list[tuple[np.ndarray, np.ndarray]]:
        """Derivatives of force and next activations with respect to activations, and to controls."""
        m, nv, na = self._inverse, self._inverse.nv, self._inverse.na

        def force() -> tuple[np.ndarray, np.ndarray]:
            """The inverse dynamics' force, which is zero along the motion, and the activations after the step."""
            mujoco.mj_inverseSkip(m, data, mujoco.mjtStage.mjSTAGE_VEL, True)
            mujoco.mj_fwdActuation(m, data)
            return data.qfrc_inverse - data.qfrc_actuator, self._next_activation(data)

        columns = []
        # At the end of its range, a control has a one-sided difference.
        limits = np.where(
            m.actuator_ctrllimited[:, None] > 0, m.actuator_ctrlrange, [-np.inf, np.inf]
        )
        for values, (low, high) in (
            (data.act, np.full((na, 2), [-np.inf, np.inf]).T),
            (data.ctrl, limits.T),
        ):
            force_by, next_by = np.zeros((nv, len(values))), np.zeros((na, len(values)))
            for i in range(len(values)):
                value, width = values[i], ACTUATION_WIDTH * max(1.0, abs(values[i]))
                above = value if low[i] < value <= high[i] < value + width else value + width
                below = value if value - width < low[i] <= value < high[i] else value - width
                values[i] = above
                upper = force()
                values[i] = below
                lower = force()
                values[i] = value
                force_by[:, i] = (upper[0] - lower[0]) / (above - below)
                next_by[:, i] = (upper[1] - lower[1]) / (above - below)
            columns.append((force_by, next_by))
        return columns

    def _integrated(self, velocity: Any, h: float) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives (nv, nv) of the positions after a step with respect to the positions before, and to the new velocities."""
        m = self.model
        by_position, by_velocity = np.eye(m.nv), h * np.eye(m.nv)
        for kind, dof in zip(m.jnt_type.tolist(), m.jnt_dofadr.tolist(), strict=True):
            if kind in (FREE_JOINT_TYPE, BALL_JOINT_TYPE):
                first = dof + (3 if kind == FREE_JOINT_TYPE else 0)
                turn = slice(first, first + 3)
                by_turn, by_rate, unused = np.zeros(9), np.zeros(9), np.zeros(3)
                mujoco.mjd_quatIntegrate(np.array(velocity[turn]), h, by_turn, by_rate, unused)
                by_position[turn, turn] = by_turn.reshape(3, 3)
                by_velocity[turn, turn] = h * by_rate.reshape(3, 3)  # MuJoCo's lacks the time step
        return by_position, by_velocity

    def _next_activation(self, data: mujoco.MjData) -> np.ndarray:
        """Activations after the step (na,): `mj_nextActivation`, which Python does not have."""
        m, after = self.model, np.array(data.act)
        for i in range(m.nu):
            first, count = m.actuator_actadr[i], m.actuator_actnum[i]
            for j in range(first, first + count) if first >= 0 else ():
                h = float(m.opt.timestep)
                if m.actuator_dyntype[i] == mujoco.mjtDyn.mjDYN_FILTEREXACT:
                    tau = max(mujoco.mjMINVAL, m.actuator_dynprm[i, 0])
                    h = tau * (1.0 - np.exp(-h / tau))
                after[j] += data.act_dot[j] * h
                if m.actuator_actlimited[i]:
                    after[j] = np.clip(after[j], *m.actuator_actrange[i])
        return after

    def _turns(self, qpos: Any) -> np.ndarray:
        """Derivatives of qpos with respect to the tangent space (..., nq, nv).

        The rows of a quaternion are half of its left multiplication.
        """
        m = self.model
        matrix = np.zeros((*qpos.shape[:-1], m.nq, m.nv))
        for kind, address, dof in zip(
            m.jnt_type.tolist(), m.jnt_qposadr.tolist(), m.jnt_dofadr.tolist(), strict=True
        ):
            plain = {FREE_JOINT_TYPE: 3, BALL_JOINT_TYPE: 0}.get(kind, 1)
            for i in range(plain):
                matrix[..., address + i, dof + i] = 1.0
            if kind in (FREE_JOINT_TYPE, BALL_JOINT_TYPE):
                w, x, y, z = np.moveaxis(qpos[..., address + plain : address + plain + 4], -1, 0)
                product = np.stack([-x, -y, -z, w, -z, y, z, w, -x, -y, x, w], axis=-1)
                rows = slice(address + plain, address + plain + 4)
                dofs = slice(dof + plain, dof + plain + 3)
                matrix[..., rows, dofs] = 0.5 * product.reshape(*product.shape[:-1], 4, 3)
        return matrix


def _apart(forward: np.ndarray, backward: np.ndarray) -> bool:
    """Whether the differences to both sides disagree, so that the function is not smooth."""
    largest = max(np.abs(forward).max(initial=0.0), np.abs(backward).max(initial=0.0))
    return bool(np.abs(forward - backward).max(initial=0.0) > LARGEST_ASYMMETRY * largest)


def trajectory(model: mujoco.MjModel, threads: int | None = None) -> Trajectory:
    """Return the motion of any model in MuJoCo C as a differentiable function of start and controls; see `Trajectory`.

    >>> ball = "<mujoco><worldbody><body><freejoint/><geom size='.1'/></body></worldbody></mujoco>"
    >>> fall = trajectory(mujoco.MjModel.from_xml_string(ball))
    >>> end = fall(jnp.zeros(7).at[3].set(1.0), jnp.zeros(6), jnp.zeros((500, 0))).qpos[-1]
    >>> print(f"{end[2]:.3f} m")
    -4.915 m

    Args:
        model: Compiled model, which is copied.
        threads: Number of processors that share a batch, by default all.

    Raises:
        ParameterError: The model has states of plugins or delays.
    """
    return Trajectory(model, threads)
