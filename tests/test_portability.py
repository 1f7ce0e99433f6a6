# Tests of runtime.py
"""The package works where POSIX and all extras are absent, as on a fresh Windows."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from test_dependencies import OTHER_EXTRAS, PROJECT, REQUIREMENTS, declared
from test_extras import SPECS

#: Python's modules that Windows does not have, except those of which subprocess and multiprocessing consist here.
POSIX_MODULES = (
    "curses",
    "fcntl",
    "grp",
    "pty",
    "pwd",
    "readline",
    "resource",
    "syslog",
    "termios",
    "tty",
)
#: Attributes of modules that Windows does not have, except those that Python's own modules use here.
POSIX_NAMES = {
    "os": (
        "O_NONBLOCK",
        "fchmod",
        "fork",
        "geteuid",
        "getpgid",
        "getuid",
        "killpg",
        "sched_getaffinity",
        "setsid",
    ),
    "signal": (
        "SIGALRM",
        "SIGHUP",
        "SIGIO",
        "SIGPROF",
        "SIGQUIT",
        "SIGUSR1",
        "SIGUSR2",
        "SIGXCPU",
        "setitimer",
    ),
}
WITHOUT = """
import importlib, json, os, pkgutil, signal, sys
modules, names, commands = map(json.loads, sys.argv[1:])
sys.modules |= dict.fromkeys(modules)
for module, those in names.items():
    for name in those:
        delattr(sys.modules[module], name)
import nermo_mjx
for module in pkgutil.walk_packages(nermo_mjx.__path__, "nermo_mjx."):
    if not module.name.endswith(("__main__", "_door")):
        importlib.import_module(module.name)
from nermo_mjx.cli import main
for command in commands:
    main(command.split(), standalone_mode=False)
"""


def optional_modules() -> list[str]:
    """Modules at the top of what only extras install."""
    extras = PROJECT["optional-dependencies"].items()
    installed = declared(
        requirement for name, extra in extras if name not in OTHER_EXTRAS for requirement in extra
    )
    modules = {"salib": "SALib", "tensorboardx": "tensorboardX"} | {
        requirement_name: name for name, requirement_name in REQUIREMENTS.items()
    }
    return sorted(
        modules.get(requirement, requirement.replace("-", "_")) for requirement in installed
    )


@pytest.mark.release
def test_the_robot_walks_sweeps_and_is_tuned_without_posix_and_extras(tmp_path: Path) -> None:
    absent = [*POSIX_MODULES, *optional_modules()]
    assert {"fcntl", "cma", "websockets", "SALib", "paho", "tensorboardX"} <= set(absent)
    spec = {
        "spine": "stride_extension",
        "tune": {"spine.amplitude": {"bounds": [0.0, 0.4]}},
        "objective": [{"maximize": "speed"}],
        "method": "local_gradient",
        "iterations": 1,
        "run": {"duration": 0.3, "warmup": 0.0},
    }
    (tmp_path / "tuning.yaml").write_text(json.dumps(spec))
    (tmp_path / "sweep.yaml").write_text(json.dumps(SPECS["sweep"]))
    commands = [
        "walk --engine c --duration 0.3 --json --quiet",
        "sweep sweep.yaml --out swept --engine c --json --quiet",
        "tune tuning.yaml --out tuned --json --quiet",
    ]
    arguments = [json.dumps(argument) for argument in (absent, POSIX_NAMES, commands)]
    # Its own cache: without fcntl, filelock takes the files of other processes' locks for locks.
    environment = os.environ | {"NERMO_MJX_CACHE": str(tmp_path / "cache")}
    process = subprocess.run(
        [sys.executable, "-c", WITHOUT, *arguments],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
    )
    assert process.returncode == 0, process.stderr
    assert '"status": "ok"' in process.stdout
    assert {"swept/summary.json", "tuned/best.json"} <= {
        path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*.json")
    }
