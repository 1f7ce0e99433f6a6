"""The environment as an `MjxEnv` of MuJoCo Playground, in its registry; needs the extra `playground`.

An import of this module registers `NermoFlat` and one environment for each terrain (`NermoPlanks`, ...); `register`
adds others.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, Final

import jax
import jax.numpy as jnp
import mujoco

try:
    from ml_collections import ConfigDict
    from mujoco_playground import MjxEnv, State, dm_control_suite
except ModuleNotFoundError as error:
    message = f"{error.name} is not installed: pip install playground, or nermo-mjx with its extra playground."
    raise ModuleNotFoundError(message, name=error.name) from None

from nermo_mjx.dynamics.mjx_import import mjx
from nermo_mjx.learn.environment import Environment, MjxWorlds, World, select
from nermo_mjx.learn.own import custom_name, is_custom
from nermo_mjx.learn.task import Outcome, Task, Term
from nermo_mjx.robot import ParameterError
from nermo_mjx.robot.terrains import TERRAINS
from nermo_mjx.rollout.setup import Setup

__all__ = ["NermoMjxEnv", "default_config", "register"]

_ARRIVAL_CODE: Final = list(Outcome).index(Outcome.arrived)


def default_config(setup: Setup | None = None, task: Task | None = None) -> ConfigDict:
    """The options of the environment, which you can override when you load it, by the names of Playground.

    Returns:
        `ctrl_dt` and `sim_dt` [s], `episode_length` in control steps, `action_repeat`, `impl` of the physics (`jax`),
        and the weights of the reward's terms, `reward_config.scales`.
    """
    setup, task = setup or Setup(), task or Task()
    control = setup.make_controller().dt
    scales = {_name(term): float(weight) for term, weight in task.rewards.items()}
    return ConfigDict(
        {
            "ctrl_dt": control * task.decimation,
            "sim_dt": float(setup.timestep),
            "episode_length": round(task.episode_length / control / task.decimation),
            "action_repeat": 1,
            "impl": "jax",
            "reward_config": {"scales": scales},
        }
    )


class NermoMjxEnv(MjxEnv):
    """One world on MJX. `reset` and `step` are pure functions, so that `jax.vmap` makes a batch of worlds.

    The observations are `state`, for the policy, and `privileged_state`, for a critic. An episode is `done` if the robot
    failed, or has walked the task's distance; Playground's wrappers apply time limits. `info["world"]` contains the
    parameters of the episode and the state of the controller. If a wrapper restores the initial `data` of a world, the
    episode restarts. Only the time, state, controls and sensors in `data` are up to date.
    """

    def __init__(
        self,
        config: ConfigDict | None = None,
        config_overrides: Mapping[str, Any] | None = None,
        *,
        setup: Setup | None = None,
        task: Task | None = None,
    ) -> None:
        """
        Args:
            config: Options with the fields of `default_config` for this setup and task.
            config_overrides: New values of single fields, such as `reward_config.scales.work`.
            setup, task: See `Environment`.

        Raises:
            ParameterError: The control step is not a multiple of the controller's, the implementation is not `jax`, or
                the task does not fit.
        """
        setup, task = setup or Setup(), task or Task()
        super().__init__(
            default_config(setup, task) if config is None else config, config_overrides
        )
        config = self._config
        if config.impl != "jax":
            raise ParameterError(f"impl is {config.impl!r}: allowed is 'jax'.")
        control = setup.make_controller().dt
        control_ratio = config.ctrl_dt / control
        if round(control_ratio) < 1 or abs(control_ratio - round(control_ratio)) > 1e-6:
            raise ParameterError(
                f"ctrl_dt is {config.ctrl_dt:g}: allowed is a multiple of {control:g} s."
            )
        if config.sim_dt != setup.timestep:
            setup = dataclasses.replace(setup, timestep=config.sim_dt)
        own_terms = {_name(term): term for term in task.rewards}
        task = dataclasses.replace(
            task,
            decimation=round(control_ratio),
            episode_length=config.episode_length * config.ctrl_dt,
            rewards={
                own_terms.get(name, name): weight
                for name, weight in config.reward_config.scales.items()
            },
        )
        self._ctrl_dt, self._sim_dt = float(self._config.ctrl_dt), float(self._config.sim_dt)
        self.environment = Environment(setup, engine="mjx", worlds=1, task=task)
        worlds = self.environment._worlds
        assert isinstance(worlds, MjxWorlds)
        self._worlds = worlds

    def reset(self, rng: jax.Array) -> State:
        """Begin the episode of a random key, typed or raw (2,)."""
        raw = jax.random.key_data(rng) if jnp.issubdtype(rng.dtype, jax.dtypes.prng_key) else rng
        world = self._worlds.begin(raw)
        return self._state(world, jnp.zeros(()), {})

    def step(self, state: State, action: jax.Array) -> State:
        """Simulate one control step under an action (a,) in [-1, 1]."""
        world = self._restore_start(state.info["world"], state.data)
        world = self._worlds.act(world, action)
        return self._state(world, state.data.time + self._ctrl_dt, state.info)

    def _restore_start(self, world: World, data: mjx.Data) -> World:
        """The world; if a wrapper has restored the initial data, the world at the start of its episode."""
        start = self._worlds.engine.start(world.params, data.qpos, data.qvel, data.sensordata)
        start = self._worlds.engine.playing(start, world.fields)
        ran = world.carry.loop.loop.tick > 0
        return world._replace(carry=select(ran & (data.time == 0.0), start, world.carry))

    def _state(self, world: World, time: jax.Array, info: dict[str, Any]) -> State:
        observed, carry = self._worlds.observe(world), world.carry
        data = self._worlds.engine.data.replace(
            time=time,
            qpos=carry.physics.qpos,
            qvel=carry.physics.qvel,
            act=carry.physics.act,
            qacc_warmstart=carry.physics.qacc_warmstart,
            sensordata=carry.sensordata[-1],
        )
        is_done = observed.terminated | (observed.status == _ARRIVAL_CODE)
        metrics = {f"reward/{name}": value for name, value in observed.terms.items()}
        metrics |= {f"episode/{name}": value for name, value in observed.episode.items()}
        return State(
            data=data,
            obs={"state": observed.observation, "privileged_state": observed.privileged},
            reward=observed.reward,
            done=is_done.astype(observed.reward.dtype),
            metrics=metrics,
            info={**info, "world": world},
        )

    @property
    def xml_path(self) -> str:
        """Empty, because the model is composed of robot and scene; see `mj_model`."""
        return ""

    @property
    def action_size(self) -> int:
        """Length of an action."""
        return self.environment.action_size

    @property
    def mj_model(self) -> mujoco.MjModel:
        """The simulated model, with its visual geoms."""
        return self.environment.robot.model

    @property
    def mjx_model(self) -> mjx.Model:
        """The simulated model on MJX."""
        return self._worlds.engine.model


def register(name: str, setup: Setup | None = None, task: Task | None = None) -> None:
    """Add an environment to `mujoco_playground.registry` by a name.

    Args:
        name: Name of the environment; an existing environment of this name is replaced.
        setup, task: See `Environment`.
    """

    def make(
        config: ConfigDict | None = None, config_overrides: Mapping[str, Any] | None = None
    ) -> NermoMjxEnv:
        return NermoMjxEnv(config, config_overrides, setup=setup, task=task)

    # This is the only suite of Playground that does not download all of MuJoCo Menagerie first.
    dm_control_suite.register_environment(name, make, lambda: default_config(setup, task))


def _name(term: str | Term) -> str:
    if isinstance(term, Term):
        return term.name
    return custom_name(term) if is_custom(term) else term


for _scene in ("flat", *TERRAINS):
    register(f"Nermo{_scene.title().replace('_', '')}", Setup(scene=_scene, physics="fast"))
