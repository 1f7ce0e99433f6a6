# Tests of specs/controllers.py, control/protocol.py
"""Custom controllers in spec files: a wrong one is rejected with file and line before a simulation starts."""

from __future__ import annotations

from pathlib import Path

import pytest
from command import refused

from nermo_mjx import Run, Setup, Simulator
from nermo_mjx.sweep import Sweep

BOUND = (Path(__file__).parents[2] / "docs" / "howto" / "controllers" / "bound.py").read_text()


@pytest.mark.parametrize(
    "name", ["speed", "row", "seed", "status", "variant", "repeat", "code", "repeats", "gait"]
)
def test_a_controllers_parameter_may_not_take_a_columns_name(tmp_path: Path, name: str) -> None:
    (tmp_path / "own.py").write_text(
        BOUND.replace(
            "    lag: Any", f"    {name}: Any = quantity(0.1, '1', 0, 1, 'x')\n    lag: Any"
        )
    )
    (tmp_path / "s.yaml").write_text(f"controller: own.py:Bound\nvary: {{{name}: [0.2, 0.4]}}\n")
    refused(
        Sweep.from_file,
        f"s.yaml:1: field 'controller' has a parameter '{name}', which is",
        tmp_path / "s.yaml",
    )


UPDATE = (
    "        phase = (phase + params.frequency * self.dt) % 1.0\n"
    "        return phase, self.servos(params, phase)\n"
)
#: The first line of `UPDATE` in the file.
LINE = BOUND[: BOUND.index(UPDATE)].count("\n") + 1
#: What is replaced in `bound.py`, by what, and what is said of it.
CONTROLLERS = {
    "nothing": (
        UPDATE,
        "        pass\n",
        rf"update \(own.py:{LINE - 1}\), which gives NoneType: expected two",
    ),
    "no servos": (
        UPDATE,
        "        return phase\n",
        r"update .*which gives one number of type float32: expected two",
    ),
    "three": (UPDATE, "        return phase, phase, phase\n", "which gives tuple: expected two"),
    "no angles": (
        UPDATE,
        "        return phase, jnp.zeros(8)\n",
        r"an array of shape \(8,\): expected ServoAngles",
    ),
    "raises": (
        UPDATE,
        "        raise RuntimeError('boom')\n",
        f"update .* fails at own.py:{LINE}: RuntimeError: boom",
    ),
    "if": (
        UPDATE,
        "        if phase > 0.5: pass\n" + UPDATE,
        f"at own.py:{LINE}: it cannot be compiled",
    ),
    "numpy": (
        UPDATE,
        "        import numpy\n        numpy.asarray(phase)\n" + UPDATE,
        f"at own.py:{LINE + 1}: it cannot be",
    ),
    "range": (
        UPDATE,
        "        for i in range(phase): pass\n" + UPDATE,
        f"at own.py:{LINE}: (it cannot be|TypeError)",
    ),
    "sensor": (
        UPDATE,
        "        sensors.gyros\n" + UPDATE,
        f"at own.py:{LINE}: AttributeError.*did you mean 'gyro'",
    ),
    "whole start": (
        "        return phase\n\n    def initial",
        "        return 0\n\n    def initial",
        "makes float32 of the state, which init begins as int32",
    ),
    "truth start": (
        "        return phase\n\n    def initial",
        "        return True\n\n    def initial",
        "makes float32 of the state, which init begins as bool",
    ),
    "NaN start": (
        "        return phase\n\n    def initial",
        "        return phase / phase\n\n    def initial",
        "init .*, which gives nan for a robot at rest",
    ),
    "NaN servos": (
        "params.reach * jnp.cos",
        "jnp.nan * jnp.cos",
        r"initial_servo .*, which gives \[nan.*at rest",
    ),
    "signature": (
        "def init(self, params, sensors, phase)",
        "def init(self, params, sensors)",
        "fails: TypeError",
    ),
    "NaN rate": (
        "        return params.frequency",
        "        return jnp.sqrt(-params.lag)",
        "cycle_rate .*gives nan",
    ),
    "no rate": (
        "        return params.frequency",
        "        return None",
        "cycle_rate .*which gives NoneType",
    ),
    "rate by if": (
        "        return params.frequency",
        "        return 1.0 if params.frequency > 1 else 2.0",
        "cycle_rate .*it cannot be compiled",
    ),
    "no time": ("dt = 0.01", "dt = 0.0", "dt 0.0: expected the seconds of a tick"),
    "NaN time": ("dt = 0.01", "dt = float('nan')", "dt nan: expected the seconds of a tick"),
    "text time": ("dt = 0.01", "dt = '10 ms'", "dt '10 ms': expected the seconds of a tick"),
    "class": (
        "parameters = Parameters()",
        "parameters = Parameters",
        "has parameters with <class.*parameter_tree",
    ),
    "maker": (
        "    dt = 0.01",
        "    dt = 0.01\n    def __init__(self): 1 / 0",
        f"at own.py:{LINE - 19}: ZeroDivisionError",
    ),
    "arguments": (
        "    dt = 0.01",
        "    dt = 0.01\n    def __init__(self, gain): ...",
        "cannot be made without arg",
    ),
    "other state": (
        UPDATE,
        "        return (phase, phase), self.servos(params, phase)\n",
        "which makes a state of",
    ),
    "import": (
        "import jax.numpy as jnp",
        "import jax.numpy as jnp; exit(3)",
        "imported at own.py:5: SystemExit",
    ),
}


@pytest.mark.parametrize("case", CONTROLLERS)
def test_a_wrong_controller_is_refused_with_file_and_line(tmp_path: Path, case: str) -> None:
    old, new, message = CONTROLLERS[case]
    assert BOUND.count(old) == 1
    (tmp_path / "own.py").write_text(BOUND.replace(old, new))
    (tmp_path / "s.yaml").write_text("vary: {frequency: [1.0, 1.5]}\ncontroller: own.py:Bound\n")
    refused(Sweep.from_file, f"s.yaml:2: field 'controller' .*{message}", tmp_path / "s.yaml")


@pytest.mark.release
@pytest.mark.parametrize("engine", ["c", pytest.param("mjx", marks=pytest.mark.long)])
def test_angles_that_become_nan_are_a_divergence(tmp_path: Path, engine: str) -> None:
    """Whether servos, and not only the body, lose their numbers."""
    code = UPDATE.replace(
        "self.servos(params, phase)", "self.servos(params, jnp.sqrt(params.lag - phase) ** 2)"
    )
    (tmp_path / "own.py").write_text(BOUND.replace(UPDATE, code))
    simulator = Simulator(
        Setup(controller=f"{tmp_path / 'own.py'}:Bound", physics="fast"), engine=engine
    )
    result = simulator.run({"lag": [0.0001, 1.0]}, Run(duration=0.2))
    assert result.status.tolist() == ["diverged", "ok"]


def test_derived_values_are_refused_at_the_field_that_was_written(tmp_path: Path) -> None:
    refused(
        Sweep.from_text,
        r"^x:2: field 'duty' is 0.005: allowed is \[0.01, 1\)",
        "vary:\n  duty: [0.5, 0.6, 0.005]",
        "x",
    )
    controller_text = (
        BOUND
        + "\n    def complete(self, values):\n        return {'lag': 1 / values.get('reach', 1.0), **values}\n"
    )
    controller_text += "\n\nclass Root(Bound):\n    def cycle_rate(self, params):\n"
    controller_text += "        return jnp.sqrt(params.frequency - 1.0)\n"
    (tmp_path / "own.py").write_text(controller_text)
    for name, varied, message in (
        (
            "Bound",
            "reach: [0.01, 0.05]",
            "field 'reach' is 0.01, with which lag is 100: allowed is ",
        ),
        (
            "Root",
            "frequency: [1.5, 0.5, 2.0]",
            "field 'frequency' is 0.5, with which controller has cycle_rate .* gives nan",
        ),
    ):
        path = tmp_path / "s.yaml"
        path.write_text(f"controller: own.py:{name}\nvary:\n  {varied}\n")
        refused(Sweep.from_file, f"s.yaml:3: {message}", path)
    # Among others in a grid, and out of range only together.
    grid = (
        "vary:\n  stance.front_z: [-0.05, -0.06]\n  stride: [0.2, 1.0]\n  contact.friction: [1, 2]"
    )
    refused(Sweep.from_text, "^x:[23]: field 'st.* reach a stride of 0.030 m", grid, "x")
