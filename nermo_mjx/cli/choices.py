"""Names that options allow, in names.json, so that `--help` and completion import nothing else.

`python nermo_mjx/cli/choices.py` writes that file from the package; a test says when it is out of date.
"""

from __future__ import annotations

import json
from pathlib import Path

FILE = Path(__file__).with_name("names.json")
CHOICES: dict[str, list[str]] = json.loads(FILE.read_text()) if FILE.exists() else {}


def __getattr__(name: str) -> tuple[str, ...]:
    if name not in CHOICES:
        raise AttributeError(name)
    return tuple(CHOICES[name])


def of_package() -> dict[str, list[str]]:
    """The names, from where they are declared; the first is an option's default."""
    from nermo_mjx.bench import BENCHMARKS
    from nermo_mjx.control.spine_modes import AUXILIARY_MODES, NO_MODE
    from nermo_mjx.experiments.run import EXPERIMENTS
    from nermo_mjx.physics.making import ENGINES
    from nermo_mjx.plotting.files import FORMATS
    from nermo_mjx.robot import GAIT_CODES
    from nermo_mjx.robot.quantity import allowed_names
    from nermo_mjx.robot.scene import scenes
    from nermo_mjx.rollout import METRICS, Setup, all_parameters
    from nermo_mjx.specs.walk import PilotFields
    from nermo_mjx.view import CAMERAS, OVERLAYS

    named = {
        "ENGINES": ENGINES,
        "BENCH_CASES": BENCHMARKS,
        **{field.upper(): names for field, names in allowed_names(Setup).items()},
        "GAIT_CODES": GAIT_CODES,
        "SPINE_MODES": (NO_MODE, *AUXILIARY_MODES),
        "EXPERIMENTS": EXPERIMENTS,
        "OVERLAYS": OVERLAYS,
        "VIEWS": CAMERAS,
        "FORMATS": FORMATS,
        # Way points are given in a sweep file or from Python, not as an option of `walk`.
        "PILOTS": [name for name in PilotFields.model_fields if name != "waypoints"],
        "SCENES": scenes(),
        "METRICS": METRICS,
        "PARAMETERS": all_parameters(),
    }
    return {name: list(values) for name, values in named.items()}


def text_of(named: dict[str, list[str]]) -> str:
    """names.json: a line for each list."""
    return (
        "{\n"
        + ",\n".join(f"{json.dumps(name)}: {json.dumps(values)}" for name, values in named.items())
        + "\n}\n"
    )


if __name__ == "__main__":
    FILE.write_text(text_of(of_package()))
