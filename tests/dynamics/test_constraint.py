# Tests of dynamics/constraint.py
"""The Hessian of the constraint problem."""

from __future__ import annotations

import jax
import numpy as np

from nermo_mjx.dynamics import constraint
from nermo_mjx.dynamics.rows import ConstraintProblem, Layout


def test_the_hessian_is_the_slope_of_the_gradient() -> None:
    """By central differences, with an equality, dry friction that holds and that yields, limits that touch and that do
    not, and contacts that slide, stick and are apart."""
    random, dofs = np.random.default_rng(3), 5
    layout = Layout(1, 2, ((3, 3),))
    root = random.normal(size=(dofs, dofs))
    residual = np.array(
        [0.3, 0.01, 2.0, -0.4, 0.5, *(-0.2, 0.9, -0.5), *(-1.0, 0.1, 0.2), *(1.0, 0.1, 0.1)]
    )
    jacobian, qacc = random.normal(size=(len(residual), dofs)), random.normal(size=dofs)
    problem = ConstraintProblem(
        inertia=root @ root.T + np.eye(dofs),
        smooth=random.normal(size=dofs),
        jacobian=jacobian,
        aref=jacobian @ qacc - residual,
        stiffness=random.uniform(1.0, 3.0, len(residual)),
        frictionloss=np.where(np.isin(np.arange(len(residual)), (1, 2)), 0.5, 0.0),
        cone=np.array([[0.8, 0.9, 1.1, 1.0, 1.0, 1.0]] * 3),
    )
    with jax.enable_x64(True):
        gradient = jax.jit(lambda qacc: constraint.gradient(layout, problem, qacc))
        hessian = jax.jit(lambda qacc: constraint.hessian(layout, problem, qacc))(qacc)
        zones = jax.jit(
            lambda qacc: constraint.zones(layout, problem, jacobian @ qacc - problem.aref)
        )(qacc)
        step = 1e-6
        columns = [
            (gradient(qacc + step * e) - gradient(qacc - step * e)) / (2 * step)
            for e in np.eye(dofs)
        ]
    # Springs: equality, friction that holds, the limit that touches; contacts: 0 slides, 1 sticks, 2 is apart.
    assert zones.tolist() == [1, 1, 0, 1, 0, 0, 1, 2]
    np.testing.assert_allclose(hessian, np.stack(columns, axis=1), rtol=1e-6, atol=1e-7)
