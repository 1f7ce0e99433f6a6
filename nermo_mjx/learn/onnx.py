"""A policy as ONNX: from an observation to an action, for programs that do not use this package."""

from __future__ import annotations

import importlib.util
import json
from typing import Any, Final

import numpy as np

from nermo_mjx.learn.policy import Policy
from nermo_mjx.robot.quantity import ParameterError

#: Operators and file format that every runtime of the last years reads.
_OPSET: Final = 17
_IR: Final = 8


def check_onnx() -> None:
    """Refuse to export where the package is not installed; raises `ParameterError`."""
    if importlib.util.find_spec("onnx") is None:
        raise ParameterError("onnx is not installed: install nermo-mjx with its extra onnx, or onnx itself, by pip.")


def export(policy: Policy) -> bytes:
    """An ONNX model with the input `observation` (n, o) and the output `action` (n, a), both float32.

    Its metadata describe the values: `observation`, `actions` and `action` (what an action does) as JSON.

    Raises:
        ParameterError: the package `onnx` is not installed.
    """
    check_onnx()
    from onnx import TensorProto, checker, helper

    nodes: list[Any] = []
    constants = {
        "mean": policy.statistics.mean,
        "spread": np.sqrt(np.asarray(policy.statistics.variance) + 1e-6),
        "least": np.float32(-10.0),
        "most": np.float32(10.0),
    }

    def node(kind: str, *inputs: str) -> str:
        name = f"{kind.lower()}_{len(nodes)}"
        nodes.append(helper.make_node(kind, list(inputs), [name]))
        return name

    last = node("Clip", node("Div", node("Sub", "observation", "mean"), "spread"), "least", "most")
    for i, (weights, bias) in enumerate(policy.actor.layers):
        constants |= {f"weights.{i}": weights, f"bias.{i}": bias}
        last = node("Tanh", node("Add", node("MatMul", last, f"weights.{i}"), f"bias.{i}"))
    nodes.append(helper.make_node("Identity", [last], ["action"]))
    arrays = {name: np.asarray(value, np.float32) for name, value in constants.items()}
    stored = [
        helper.make_tensor(name, TensorProto.FLOAT, each.shape, each.tobytes(), raw=True)
        for name, each in arrays.items()
    ]
    sizes = {"observation": len(policy.observer.names), "action": len(policy.kind.names)}
    ends = [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["n", size]) for name, size in sizes.items()]
    graph = helper.make_graph(nodes, "policy", ends[:1], ends[1:], stored)
    model = helper.make_model(
        graph, producer_name="nermo-mjx", opset_imports=[helper.make_opsetid("", _OPSET)], ir_version=_IR
    )
    helper.set_model_props(model, {name: json.dumps(value) for name, value in policy.facts().items()})
    checker.check_model(model, full_check=True)
    content: bytes = model.SerializeToString()
    return content
