"""Functions that return a known value, with a custom derivative in every transformation.

`jax.custom_jvp` is not enough: where JAX (0.9 to 0.10) linearizes the body of a loop, it replaces such a function by
its code and ignores the rule. Second derivatives through `scan` then lack the contribution of the rule, without a
warning. A primitive keeps its rule.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from nermo_mjx.shapes import Array


def own_derivative(name: str, tangent: Callable[..., Array]) -> Callable[..., Array]:
    """A function (value, *arguments, static=None) -> value with a custom derivative.

    Args:
        name: Name of the function in programs.
        tangent: Function (static, value, arguments, changes of the arguments) -> change of the value. It is linear in
            the changes, and differentiable. `static` is hashable, such as a layout; arguments are trees of arrays.

    Example:
        >>> root = own_derivative("root", lambda _, y, args, changes: changes[0] / (2 * y))
        >>> jax.grad(lambda x: jax.grad(lambda x: root(jax.lax.stop_gradient(jnp.sqrt(x)), x))(x))(4.0).item()
        -0.03125
    """
    primitive = Primitive(name)

    def call(value: Array, *arguments: Any, static: Hashable = None) -> Array:
        leaves, tree = jax.tree.flatten(arguments)
        result: Array = primitive.bind(value, *leaves, static=static, tree=tree, axes=0)
        return result

    def itself(value: Any, *_: Any, **__: Any) -> Any:
        return value

    def derivative(
        primals: Any, tangents: Any, *, static: Hashable, tree: Any, axes: int
    ) -> tuple[Array, Array]:
        value = primitive.bind(
            *primals, static=static, tree=tree, axes=axes
        )  # for derivatives of the tangent

        def change(value: Array, leaves: Any, changes: Any) -> Array:
            return tangent(static, value, tree.unflatten(leaves), tree.unflatten(changes))

        for _ in range(axes):
            change = jax.vmap(change)
        return value, change(
            value,
            primals[1:],
            [ad.instantiate_zeros(input_tangent) for input_tangent in tangents[1:]],
        )

    def batched(
        arguments: Any, axes_of: Any, *, static: Hashable, tree: Any, axes: int
    ) -> tuple[Array, int]:
        size = next(
            argument.shape[axis]
            for argument, axis in zip(arguments, axes_of, strict=True)
            if axis is not None
        )
        first = [
            jnp.broadcast_to(argument, (size, *argument.shape))
            if axis is None
            else jnp.moveaxis(argument, axis, 0)
            for argument, axis in zip(arguments, axes_of, strict=True)
        ]
        return primitive.bind(*first, static=static, tree=tree, axes=axes + 1), 0

    primitive.def_impl(itself)
    primitive.def_abstract_eval(itself)
    mlir.register_lowering(primitive, mlir.lower_fun(itself, multiple_results=False))
    ad.primitive_jvps[primitive] = derivative
    batching.primitive_batchers[primitive] = batched
    return call
