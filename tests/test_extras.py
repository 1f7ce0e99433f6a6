# Tests of robot/quantity.py
"""Without an extra, the commands that need it say so before anything else happens, and all others work."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest
from command import call

from nermo_mjx import ParameterError, Simulator, run_search, run_sweep, sensitivity
from nermo_mjx.hardware import connected
from nermo_mjx.identify.identification import identify_log
from nermo_mjx.learn.run import run_training
from nermo_mjx.live.server import LiveDrive

SWEEP: dict[str, Any] = {"vary": {"frequency": {"uniform": [0.5, 0.9]}}, "run": {"duration": 0.2}}
VARY: dict[str, Any] = {
    "spine": "stride_extension",
    "vary": {"spine.amplitude": {"uniform": [0.0, 0.4]}},
}
SPECS: dict[str, dict[str, Any]] = {
    "sweep": SWEEP | {"sample": {"sobol": 4}},
    "saltelli": SWEEP | {"sample": {"saltelli": 4}},
    "training": {"worlds": 8, "steps": 1},
    "search": VARY | {"objective": [{"maximize": "speed"}], "budget": {"evaluations": 64}},
    "front": VARY
    | {"pareto": [{"maximize": "speed"}, {"minimize": "roll_std"}], "budget": {"evaluations": 64}},
    "atlas": VARY
    | {
        "objective": [{"maximize": "speed"}],
        "atlas": {"roll_std": [0.0, 0.1, 4]},
        "budget": {"evaluations": 64},
    },
}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Files of each kind, in the current directory; nothing can be simulated."""

    def refuse(*_: Any, **__: Any) -> None:
        raise AssertionError("a simulator was made")

    monkeypatch.setattr(Simulator, "__init__", refuse)
    monkeypatch.chdir(tmp_path)
    for name, spec in SPECS.items():
        Path(f"{name}.yaml").write_text(json.dumps(spec))
    Path("log.csv").write_text("")
    Path("table").mkdir()
    return tmp_path


@pytest.mark.parametrize(
    ("library", "extra", "purpose", "command"),
    [
        ("ray", "ray", "--workers ray", "sweep sweep.yaml --out out --workers ray"),
        ("tensorboardX", "tensorboard", "tensorboard", "sweep sweep.yaml --out out --tensorboard"),
        (
            "tensorboardX",
            "tensorboard",
            "tensorboard",
            "train training.yaml --out out --tensorboard",
        ),
        ("onnx", "onnx", "--onnx", "train training.yaml --out out --onnx"),
        ("paho", "mqtt", "send", "servos --send mqtt://127.0.0.1 --out out"),
        ("paho", "mqtt", "connect", "drive --connect mqtt://127.0.0.1 --headless"),
        ("paho", "mqtt", "serve", "drive --serve mqtt://127.0.0.1"),
        ("websockets", "drive", "send", "servos --send ws://127.0.0.1 --out out"),
        ("websockets", "drive", "connect", "drive --connect ros://127.0.0.1 --headless"),
        ("websockets", "drive", "serve", "drive --serve ws://127.0.0.1"),
        ("websockets", "drive", "drive", "drive --no-browser"),
        ("SALib", "sensitivity", "sample: saltelli", "sweep saltelli.yaml --out out"),
        ("SALib", "sensitivity", "sample: saltelli", "sweep saltelli.yaml --out out --dry-run"),
        ("SALib", "sensitivity", "sensitivity", "sensitivity table --out out"),
        ("cma", "cma", "method is cma, which", "search search.yaml --out out"),
        ("cma", "cma", "method is cma, which", "search search.yaml --out out --dry-run"),
        ("cma", "cma", "identify", "identify --log log.csv --channels sweep.yaml --out out"),
        ("pymoo", "search", "method is nsga2, which", "search front.yaml --out out"),
        ("ribs", "search", "method is cma_me, which", "search atlas.yaml --out out"),
    ],
)
def test_a_command_names_the_extra_that_it_needs_before_it_does_anything(
    library: str,
    extra: str,
    purpose: str,
    command: str,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, library, None)
    former_files = sorted(folder.rglob("*"))
    result = call(*command.split())
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr.splitlines()[-1].removeprefix("nermo-mjx: ") == (
        f'{purpose} needs {library}: pip install "nermo-mjx[{extra}]".'
    )
    assert sorted(folder.rglob("*")) == former_files


@pytest.mark.parametrize(
    ("library", "function", "arguments"),
    [
        ("cma", run_search, (SPECS["search"], "out")),
        ("cma", identify_log, ([],)),
        ("SALib", run_sweep, (SPECS["saltelli"], "out")),
        ("SALib", sensitivity, ("table",)),
        ("websockets", LiveDrive, (None,)),
        ("websockets", lambda url: connected(url).__enter__(), ("ws://127.0.0.1",)),
        ("paho", lambda url: connected(url).__enter__(), ("mqtt://127.0.0.1",)),
        (
            "tensorboardX",
            lambda *values: run_training(*values, tensorboard=True),
            (SPECS["training"], "out"),
        ),
    ],
)
def test_a_function_names_the_extra_that_it_needs(
    library: str, function: Any, arguments: Any, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(ParameterError, match=rf'{library}: pip install "nermo-mjx\['):
        function(*arguments)
    assert not Path("out").exists()
