"""Mutants of the package: one-line faults, and the tests that find them.

    python tests/mutants.py --list
    python tests/mutants.py --check
    python tests/mutants.py --run [NAME ...] [-m MARKEXPR ...] [-n PROCESSES] [--nearest] [--out FILE.csv]

A mutant is a copy of the package with one wrong line. A mutant is killed if a test fails because of this line. The
mutation score is the percentage of mutants that are killed; it estimates how many faults a selection of tests finds.

`--run` applies one mutant at a time to a temporary copy of the repository. It runs the test files that name or import
the mutated module first, then the folder of the subpackage, then all tests, and stops at the first test that fails.
This test must pass without the mutant, otherwise it is excluded. With several `-m`, a mutant that survives the first
selection meets the next; for example, `-m "not release and not long" -m "release and not long"` scores the default run
and the whole suite. `--nearest` omits the third group, which gives a lower bound of the score at a small part of its
cost. Results are appended to FILE.csv, and a mutant that is listed there is not run again.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import csv
import dataclasses
import os
import re
import resource
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Final

import pytest

ROOT: Final = Path(__file__).resolve().parents[1]
#: Tests of the default run.
DEFAULT: Final = "not release and not long"
#: Longest time of a selection of tests [s]. A mutant whose tests do not end by then is killed.
LONGEST: Final = 3 * 3600
COLUMNS: Final = ("mutant", "subpackage", "killed", "test", "test_seconds", "seconds")


@dataclasses.dataclass(frozen=True)
class Mutant:
    """A one-line fault.

    Attributes:
        file: Path of the module in the package.
        old: Text that the file contains exactly once.
        new: Text that replaces it.
        why: What goes wrong, in one sentence.
    """

    file: str
    old: str
    new: str
    why: str

    @property
    def subpackage(self) -> str:
        """First folder of the module; `nermo_mjx` for a module of the package itself."""
        return self.file.split("/")[0] if "/" in self.file else "nermo_mjx"

    @property
    def module(self) -> str:
        """Dotted name of the module."""
        return f"nermo_mjx.{self.file.removesuffix('.py').replace('/', '.')}"

    @contextlib.contextmanager
    def applied(self, root: Path) -> Iterator[None]:
        """The copy of the repository at `root` has the fault within this context."""
        path = root / "nermo_mjx" / self.file
        text = path.read_text()
        if text.count(self.old) != 1:
            raise ValueError(
                f"{self.file} contains {self.old.strip()!r} {text.count(self.old)} times: expected once."
            )
        _write(path, text.replace(self.old, self.new))
        try:
            yield
        finally:
            _write(path, text)


def _write(path: Path, text: str) -> None:
    """Write a module. Its bytecode is removed, because Python recognizes it by a size and a time in whole seconds."""
    path.write_text(text)
    for compiled in (path.parent / "__pycache__").glob(f"{path.stem}.*.pyc"):
        compiled.unlink(missing_ok=True)


MUTANTS: Final[dict[str, Mutant]] = {
    # robot
    "inertia_axes": Mutant(
        "robot/masses.py",
        "self.mass / 3 * (a + c), self.mass / 3 * (a + b)",
        "self.mass / 3 * (a + b), self.mass / 3 * (a + c)",
        "The moments of inertia about y and z of every part change places.",
    ),
    "open_bound": Mutant(
        "robot/quantity.py",
        "below = numbers <= self.low if self.open_low",
        "below = numbers < self.low if self.open_low",
        "A range that excludes its lower bound accepts it.",
    ),
    "slope_direction": Mutant(
        "robot/model_parameters.py",
        "-along * xp.cos(direction), -gravity",
        "along * xp.cos(direction), -gravity",
        "A slope falls ahead of the robot where it should rise.",
    ),
    # kinematics
    "slope_of_segment": Mutant(
        "kinematics/spine.py",
        "slope[0, 3] = 0.5 *",
        "slope[0, 3] = 1.0 *",
        "The spine grows twice as much as the length of its segments.",
    ),
    "ankle_sign": Mutant(
        "kinematics/leg.py",
        "shin - leg.theta3 - ankle",
        "shin - leg.theta3 + ankle",
        "A deflected ankle turns the foot to the wrong side.",
    ),
    "lift_side": Mutant(
        "kinematics/body.py",
        "jnp.where(has_third, side * lift, 0.0)",
        "jnp.where(has_third, -side * lift, 0.0)",
        "The spine moves the centre of mass out of the triangle of the supporting feet.",
    ),
    # control
    "heading_of_bend": Mutant(
        "control/pilot.py",
        "jnp.arctan2(across, along) - 0.5 * bend",
        "jnp.arctan2(across, along) + 0.5 * bend",
        "The heading of a bent robot is wrong by the whole bend.",
    ),
    "erratum_of_fusion": Mutant(
        "control/spine_modes.py",
        "1.0 - jnp.abs(steering), jnp.asarray(spine.fusion_exponent)",
        "1.0 - steering, jnp.asarray(spine.fusion_exponent)",
        "A turn to the right amplifies the auxiliary spine mode, as the equation is printed (erratum to 5.46).",
    ),
    "long_way_round": Mutant(
        "control/schedule.py",
        "moves = jnp.cumsum(moves - jnp.round(moves), -1)",
        "moves = jnp.cumsum(moves, -1)",
        "A switch of the gait moves a limb's phase the longer way around the cycle.",
    ),
    "progress_goes_back": Mutant(
        "control/path.py",
        "return PathPoint(error, point[..., 3], tangent, jnp.maximum(progress, reached))",
        "return PathPoint(error, point[..., 3], tangent, reached)",
        "The progress along a course decreases with the sway of the body.",
    ),
    "bow_of_spline": Mutant(
        "control/trajectory.py",
        "0.75 * u * u * (u - 1.0)",
        "0.5 * u * u * (u - 1.0)",
        "The acceleration of the foot along y jumps at the mid point.",
    ),
    # dynamics
    "weld_anchors": Mutant(
        "dynamics/impedance.py",
        "anchors = anchors[::-1]",
        "anchors = anchors",
        "The anchors of a weld change places in its centripetal acceleration.",
    ),
    "box_inside": Mutant(
        "dynamics/collision.py",
        "jnp.where(is_inside, into,",
        "jnp.where(is_inside, -into,",
        "A sphere whose centre is in a box is pulled further in.",
    ),
    "newton_early": Mutant(
        "dynamics/solver.py",
        "newton_step.small & (newton_step.stays | solution.small)",
        "newton_step.small",
        "The solver stops after a small step across the border of a contact's zone.",
    ),
    "cone_curvature": Mutant(
        "dynamics/constraint.py",
        "- mu * zone.outside / zone.length * turns",
        "+ mu * zone.outside / zone.length * turns",
        "The Hessian of a sliding contact has the wrong curvature across the direction of sliding.",
    ),
    # physics
    "stale_reset": Mutant(
        "physics/c_engine.py",
        "    block._sensordata[ids] = at_rest[:, None]\n",
        "",
        "The first observation of an episode contains the readings of the last one.",
    ),
    "asymmetry_side": Mutant(
        "physics/variation.py",
        "1.0 + side * p.build.asymmetry",
        "1.0 - side * p.build.asymmetry",
        "A positive asymmetry stiffens the right knees instead of the left ones.",
    ),
    "play_side": Mutant(
        "physics/servo_play.py",
        "xp.where(shift < 0.0, half + motor, half - motor)",
        "xp.where(shift < 0.0, half - motor, half + motor)",
        "A reversed servo transmits its torque before it has crossed the backlash.",
    ),
    "inertia_curve": Mutant(
        "physics/geometry_fields.py",
        "return at_a / a - curve * a, curve",
        "return at_a / a, curve",
        "The inertia of a lengthened part has a wrong slope with respect to the length.",
    ),
    # rollout
    "back_emf": Mutant(
        "rollout/metrics.py",
        "torque = torque - tick.brake * sensors",
        "torque = torque + tick.brake * sensors",
        "The back-EMF adds torque to a turning servo in the metrics of work and current.",
    ),
    "image_axis": Mutant(
        "rollout/metrics.py",
        "turning_head[..., 0] ** 2 + turning_head[..., 2] ** 2",
        "turning_head[..., 0] ** 2 + turning_head[..., 1] ** 2",
        "The image motion counts the roll of the head instead of its yaw.",
    ),
    "fall_before_run": Mutant(
        "rollout/metrics.py",
        "judged = ~ended & begins_in_run(window, tick.time, tick.dt)",
        "judged = ~ended",
        "A fall after the end of a run counts, so that results depend on the batch.",
    ),
    "spread_of_gradient": Mutant(
        "rollout/differentiable.py",
        "for width in (SLOPE_WIDTH, 0.1 * SLOPE_WIDTH)",
        "for width in (SLOPE_WIDTH, SLOPE_WIDTH)",
        "The spread of two difference widths is always 0.",
    ),
    "rest_of_cycle": Mutant(
        "rollout/path_metrics.py",
        "place=is_open * sum_place + rest_time * position",
        "place=is_open * sum_place",
        "The mean position of a gait cycle misses the rest of the tick in which the last cycle ended.",
    ),
    # runs
    "first_file_wins": Mutant(
        "runs/files.py",
        "    except FileExistsError:\n        pass\n    except OSError:",
        "    except OSError:",
        "The last of several processes overwrites the file of the first.",
    ),
    "minus_zero": Mutant(
        "runs/rows.py",
        "(np.asarray(values[name], float) + 0.0)",
        "(np.asarray(values[name], float))",
        "A run with -0.0 has another key than the run with 0.0, and is made twice.",
    ),
    "lost_interruption": Mutant(
        "runs/job.py",
        "        self._pending = True\n",
        "        self._pending = not self._shielded\n",
        "Ctrl-C while a file is written is forgotten.",
    ),
    # specs
    "merge_wins": Mutant(
        "specs/reading.py",
        "return {**merged, **entries}",
        "return {**entries, **merged}",
        "A merged YAML mapping overrides the fields of the mapping that merges it.",
    ),
    "line_of_field": Mutant(
        "specs/reading.py",
        "for length in range(len(path), -1, -1):",
        "for length in range(len(path) + 1):",
        "Errors report the first line of the file instead of the line of the field.",
    ),
    # sweep
    "freedom": Mutant(
        "sweep/counting.py",
        "np.fmin(welch, largest_freedom), several - 1.0)",
        "np.fmin(welch, largest_freedom), several)",
        "The interval of a mean over variants has one degree of freedom too many.",
    ),
    "unpaired_left_out": Mutant(
        "sweep/counting.py",
        "[mean.index.isin(shared) | ~mean.index.isin(paired, level=0)]",
        "[mean.index.isin(shared)]",
        "A comparison drops the variants whose runs have no common seed.",
    ),
    "truncated_normal": Mutant(
        "sweep/sampling.py",
        "special.ndtri(low + (high - low) * share)",
        "special.ndtri(share)",
        "A normal distribution is clipped to the range instead of truncated, so that samples pile up at its ends.",
    ),
    "fresh_runs_choose": Mutant(
        "sweep/selection.py",
        "begin = question.fresh + look * repeats",
        "begin = look * repeats",
        "The runs that validate the optimum also choose it.",
    ),
    # optimize
    "rank_of_fallen": Mutant(
        "optimize/search_methods.py",
        "fallen = worst + 2.0 + np.nanmax",
        "fallen = worst + 1.0 + 0.0 * np.nanmax",
        "A fallen robot ranks before a robot that violates a constraint.",
    ),
    "best_without_gradient": Mutant(
        "optimize/tuner.py",
        "better = ok & (value < state.best_value)",
        "better = value < state.best_value",
        "A point without a finite gradient becomes the best point of a tuning.",
    ),
    "edge_of_atlas": Mutant(
        "optimize/search_methods.py",
        "(values <= measure.high)",
        "(values < measure.high)",
        "A point at the upper end of a measure's range is not in the atlas.",
    ),
    "slope_of_turn": Mutant(
        "optimize/objective.py",
        "jnp.where(bounds.periodic, 0.25, share * (1.0 - share))",
        "jnp.where(bounds.periodic, 0.5, share * (1.0 - share))",
        "The gradient with respect to a periodic parameter is twice as large.",
    ),
    # learn
    "truncation": Mutant(
        "learn/experience.py",
        "decay = jnp.where(terminated | truncated, 0.0",
        "decay = jnp.where(terminated, 0.0",
        "Advantages leak from one episode into the one before it at a time limit.",
    ),
    "spread_of_parts": Mutant(
        "learn/experience.py",
        "            + difference**2 * self.count * count / total\n",
        "",
        "The running variance ignores the difference between the means of two batches.",
    ),
    "delay_sign": Mutant(
        "learn/observing.py",
        "(newest_first[index + 1] - newest_first[index])",
        "(newest_first[index] - newest_first[index + 1])",
        "Delayed observations are extrapolated instead of interpolated.",
    ),
    "clip_without_minimum": Mutant(
        "learn/algorithms.py",
        "-jnp.minimum(ratio * scaled, clipped * scaled).mean()",
        "-(clipped * scaled).mean()",
        "PPO does not correct a sample whose probability ratio moved too far in the wrong direction.",
    ),
    # experiments
    "half_range": Mutant(
        "experiments/measures.py",
        "return 0.5 * (high - low)",
        "return high - low",
        "The reported amplitude of an angle is its range.",
    ),
    "white_floor": Mutant(
        "identify/estimation.py",
        "rms(np.diff(residual)) / math.sqrt(2)",
        "rms(np.diff(residual))",
        "The noise of a channel is overestimated, so that a wrong model class counts as right.",
    ),
    "early_commands": Mutant(
        "identify/twin.py",
        "np.interp(self.grid - delay_value, knots, area)",
        "np.interp(self.grid + delay_value, knots, area)",
        "A delay makes the twin follow its commands before they come.",
    ),
    "judged_on_fitted": Mutant(
        "identify/identification.py",
        "lambda times, duration: times >= FITTED_SHARE * duration",
        "lambda times, duration: times < FITTED_SHARE * duration",
        "An identified model is validated on the samples that it was fitted to.",
    ),
    # hardware
    "no_clearance": Mutant(
        "hardware/table.py",
        "pairs[between < reach]",
        "pairs[between > reach]",
        "Only parts that are far apart are checked for contact.",
    ),
    "vertex_of_lag": Mutant(
        "hardware/signals.py",
        "lags[best] - (0.5 * slope / bend",
        "lags[best] + (0.5 * slope / bend",
        "The lag between two signals is refined to the wrong side.",
    ),
    "own_clock": Mutant(
        "hardware/log.py",
        '+ time_fields.get("scale", 1.0) * (stamps - first)',
        '+ time_fields.get("scale", 1.0) * stamps - first',
        "The scale of a clock also moves its first time stamp.",
    ),
    # live
    "no_limit_on_wire": Mutant(
        "live/wire.py",
        "degrees = np.clip(servo_angles, self._low, self._high)",
        "degrees = servo_angles",
        "The real robot gets commands beyond the limits of its servos.",
    ),
    "repeated_stamp": Mutant(
        "live/wire.py",
        "stamp <= self._stamp",
        "stamp < self._stamp",
        "A message that arrives twice counts as two measurements.",
    ),
    # plotting
    "last_edge": Mutant(
        "plotting/charts.py",
        "[2 * c[-1] - middle[-1]]",
        "[c[-1]]",
        "The last row and the last column of a heat map have half their size.",
    ),
    "width_of_interval": Mutant(
        "plotting/shown.py",
        "* std / np.sqrt(freedom + 1)",
        "* std / np.sqrt(freedom)",
        "The drawn intervals of means are too wide.",
    ),
    # view
    "pitch_sign": Mutant(
        "view/recorded.py",
        "r20, r21, r22 = 2 * (x * z - w * y)",
        "r20, r21, r22 = 2 * (x * z + w * y)",
        "The plotted roll and pitch are those of another rotation.",
    ),
    "half_cycles": Mutant(
        "view/recorded.py",
        "(begin >= time[0] - 1e-9) & (end <= time[-1] + 1e-9)",
        "(end <= time[-1] + 1e-9)",
        "The mean over a gait cycle is shown where the recording has only a part of the cycle.",
    ),
    "sign_flips": Mutant(
        "view/clip.py",
        "np.cumprod(signs, axis=0)[..., None]",
        "signs[..., None]",
        "An interpolated body turns the long way round after a quaternion has changed its sign.",
    ),
    # cli
    "first_assignment": Mutant(
        "cli/options.py",
        "            values |= {\n",
        "            values = values or {\n",
        "Of two --set of one parameter the first is used instead of the last.",
    ),
    "lost_output": Mutant(
        "cli/output.py",
        "if out.lost is None or ending.code:",
        "if out.lost is None or not ending.code:",
        "A command whose output is lost on a full disk ends with exit code 0.",
    ),
    # the package itself
    "lengths_agree": Mutant(
        "files.py",
        "sizes.setdefault(want, have) if isinstance(want, str) else want\n",
        "have if isinstance(want, str) else want\n",
        "Arrays of different lengths are read as one recording.",
    ),
    "first_sample": Mutant(
        "recording.py",
        "np.searchsorted(self.time, begin - 1e-9)",
        "np.searchsorted(self.time, begin + 1e-9)",
        "A part of a recording misses its first sample.",
    ),
    "pace_of_resumed": Mutant(
        "progress.py",
        "fraction - self._pace_start[1]",
        "fraction",
        "The remaining time of a resumed job counts the work of earlier sessions.",
    ),
}


def check(root: Path = ROOT) -> list[str]:
    """The mutants that no longer fit the package at `root`, with the reason."""
    wrong = []
    for name, mutant in MUTANTS.items():
        path = root / "nermo_mjx" / mutant.file
        count = path.read_text().count(mutant.old) if path.exists() else 0
        if count != 1:
            wrong.append(
                f"{name}: {mutant.file} contains {mutant.old.strip()!r} {count} times, expected once."
            )
        else:
            try:
                ast.parse(path.read_text().replace(mutant.old, mutant.new))
            except SyntaxError as error:
                wrong.append(f"{name}: the mutated {mutant.file} is no Python: {error}.")
    return wrong


def nearest_files(mutant: Mutant, root: Path) -> list[str]:
    """Test files whose first line, `# Tests of robot/masses.py, ...`, names the module, or that import from it.

    If a file names the module, files that only import from it are left out.
    """
    texts = {path: path.read_text() for path in sorted((root / "tests").rglob("test_*.py"))}
    first = {
        path: text.partition("\n")[0].removeprefix("# Tests of ") for path, text in texts.items()
    }
    listed_files = [path for path, line in first.items() if mutant.file in line.split(", ")]
    package, _, module = mutant.module.rpartition(".")
    imports = re.compile(
        rf"^\s*(from|import) {re.escape(mutant.module)}\b|^from {re.escape(package)} import \(?[^)\n]*\b{module}\b",
        re.MULTILINE,
    )
    files = listed_files or [path for path, text in texts.items() if imports.search(text)]
    return [path.relative_to(root).as_posix() for path in files]


def selections(mutant: Mutant, root: Path, nearest: bool) -> Iterator[list[str]]:
    """Arguments of pytest for the groups of tests, the nearest first; with `nearest` without the last group."""
    folder = f"tests/{mutant.subpackage}"
    groups = [
        nearest_files(mutant, root),
        [folder] if (root / folder).is_dir() else [],
        [] if nearest else ["tests"],
    ]
    preceding: list[str] = []
    for group in filter(None, groups):
        yield [*group, *(f"--ignore={path}" for path in preceding)]
        preceding += group


@dataclasses.dataclass
class Outcome:
    """The first failed test of a run of pytest, and CPU seconds of the test and of all processes."""

    test: str
    test_seconds: float
    seconds: float


def run_tests(
    root: Path, arguments: Sequence[str], expression: str, excluded: Sequence[str]
) -> Outcome:
    """Run pytest in a copy of the repository until a test fails; `test` is empty if all pass."""
    start_seconds = _seconds(resource.RUSAGE_CHILDREN)
    clock = root / "seconds.csv"
    clock.unlink(missing_ok=True)
    command = [
        sys.executable,
        "-m",
        "pytest",
        *arguments,
        "-m",
        expression,
        "-x",
        "-q",
        "-n",
        "0",
        "-rfE",
        "--tb=no",
    ]
    command += [
        "-p",
        "mutants",
        "-p",
        "no:cacheprovider",
        *(f"--deselect={test}" for test in excluded),
    ]
    environment = os.environ | {
        "PYTHONPATH": f"{root}{os.pathsep}{root / 'tests'}",
        "MUTANTS_CLOCK": str(clock),
    }
    try:
        process = subprocess.run(
            command, cwd=root, env=environment, capture_output=True, text=True, timeout=LONGEST
        )
        failed = re.search(r"^(?:FAILED|ERROR) (.+?)(?: - .*)?$", process.stdout, re.MULTILINE)
        test = (
            failed[1]
            if failed
            else ""
            if process.returncode in (0, 5)
            else f"pytest ended with {process.returncode}"
        )
    except subprocess.TimeoutExpired:
        test = "time-out"
    spent = (
        dict(line.rsplit(",", 1) for line in clock.read_text().splitlines())
        if clock.exists()
        else {}
    )
    return Outcome(
        test, float(spent.get(test, "nan")), _seconds(resource.RUSAGE_CHILDREN) - start_seconds
    )


def _seconds(process_kind: int) -> float:
    usage = resource.getrusage(process_kind)
    return usage.ru_utime + usage.ru_stime


def kill(name: str, expressions: Sequence[str], nearest: bool, root: Path) -> dict[str, str]:
    """Row of the table about one mutant."""
    mutant, seconds, excluded = MUTANTS[name], 0.0, list[str]()
    row = dict.fromkeys(COLUMNS, "") | {"mutant": name, "subpackage": mutant.subpackage}
    for expression in expressions:
        for arguments in selections(mutant, root, nearest):
            while True:
                with mutant.applied(root):
                    result = run_tests(root, arguments, expression, excluded)
                seconds += result.seconds
                if not result.test:
                    break
                # Only a test that passes without the mutant has found it.
                if result.test.startswith("tests"):
                    function = result.test.partition("[")[0]
                    single_run = run_tests(root, [function], expression, ())
                    seconds += single_run.seconds
                    if single_run.test and (function in excluded or "::" not in function):
                        raise RuntimeError(
                            f"{function} fails without a mutant, too, and cannot be excluded."
                        )
                    if single_run.test:
                        excluded.append(function)
                        continue
                killed = {
                    "killed": expression,
                    "test": result.test,
                    "test_seconds": f"{result.test_seconds:.1f}",
                }
                return row | killed | {"seconds": f"{seconds:.0f}"}
    return row | {"seconds": f"{seconds:.0f}"}


def _copied(root: Path) -> Path:
    """A copy of the repository, without hidden folders but `.ci`, and without results and caches."""

    def left_out(folder: str, names: list[str]) -> set[str]:
        hidden = {
            name for name in names if name.startswith(".") and name not in (".ci", ".gitignore")
        }
        return (
            hidden
            | {"__pycache__"}
            | ({"runs", "build", "dist"} if Path(folder) == ROOT else set())
        )

    shutil.copytree(ROOT, root, ignore=left_out)
    return root


def _work(names: Sequence[str], expressions: Sequence[str], nearest: bool, out: Path) -> None:
    """Run the mutants one after the other in one copy, and append a row about each."""
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        root = _copied(Path(folder) / "nermo_mjx")
        for name in names:
            row = kill(name, expressions, nearest, root)
            with out.open("a", newline="") as file:
                csv.DictWriter(file, COLUMNS).writerow(row)
            print(f"{name}: {row['test'] or 'survived'} ({row['seconds']} s)", flush=True)


def run(
    names: Sequence[str], expressions: Sequence[str], processes: int, nearest: bool, out: Path
) -> None:
    """Run mutants, append their rows to `out`, and print the table and the score."""
    if not out.exists():
        out.write_text(",".join(COLUMNS) + "\n")
    finished = {row["mutant"] for row in _rows(out)}
    remaining = [name for name in names if name not in finished]
    if processes == 1:
        _work(remaining, expressions, nearest, out)
    else:
        with ProcessPoolExecutor(processes) as pool:
            parts = [remaining[i::processes] for i in range(processes)]
            for job in [
                pool.submit(_work, part, expressions, nearest, out) for part in parts if part
            ]:
                job.result()
    print(table([row for row in _rows(out) if row["mutant"] in names], expressions))


def _rows(out: Path) -> list[dict[str, str]]:
    with out.open(newline="") as file:
        return list(csv.DictReader(file))


def table(rows: Sequence[dict[str, str]], expressions: Sequence[str]) -> str:
    """Markdown: a row for each mutant, and the score after each selection of tests."""
    lines = ["| mutant | subpackage | killed by | CPU [s] |", "|---|---|---|--:|"]
    order = list(MUTANTS)
    for row in sorted(rows, key=lambda row: order.index(row["mutant"])):
        test = f"`{row['test'].rpartition('/')[2]}`" if row["test"] else "survived"
        lines.append(
            f"| `{row['mutant']}` | {row['subpackage']} | {test} | {row['test_seconds']} |"
        )
    killed = 0
    for expression in expressions:
        killed += sum(row["killed"] == expression for row in rows)
        percent = 100.0 * killed / max(len(rows), 1)
        lines.append(
            f"\nKilled up to -m {expression!r}: {killed} of {len(rows)} ({percent:.0f} %)."
        )
    return "\n".join(lines)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: object, nextitem: object) -> Iterator[object]:
    """As a plugin of pytest (`-p mutants`): record CPU seconds of each test in the file that `run_tests` names."""
    start_seconds = _seconds(resource.RUSAGE_SELF) + _seconds(resource.RUSAGE_CHILDREN)
    result = yield
    end_seconds = _seconds(resource.RUSAGE_SELF) + _seconds(resource.RUSAGE_CHILDREN)
    with open(os.environ["MUTANTS_CLOCK"], "a") as file:
        file.write(f"{item.nodeid},{end_seconds - start_seconds:.3f}\n")  # type: ignore[attr-defined]
    return result


def main() -> None:
    parser = argparse.ArgumentParser(
        description="One-line faults of the package, and the tests that find them."
    )
    modes = parser.add_mutually_exclusive_group(required=True)
    modes.add_argument("--list", action="store_true", help="print all mutants with their reasons")
    modes.add_argument(
        "--check", action="store_true", help="check that all mutants still fit the package"
    )
    modes.add_argument("--run", nargs="*", metavar="NAME", help="run these mutants, by default all")
    parser.add_argument(
        "-m", action="append", metavar="MARKEXPR", help=f"selections of tests; default: {DEFAULT!r}"
    )
    parser.add_argument(
        "-n", type=int, default=1, metavar="PROCESSES", help="mutants at a time; default: 1"
    )
    parser.add_argument("--nearest", action="store_true", help="omit tests of other folders")
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("mutants.csv"),
        help="table of results; default: mutants.csv",
    )
    options = parser.parse_args()
    if options.list:
        for name, mutant in MUTANTS.items():
            print(
                f"{name} ({mutant.file}): {mutant.why}\n  - {mutant.old.strip()}\n  + {mutant.new.strip()}"
            )
    elif options.check:
        wrong = check()
        print("\n".join(wrong) or f"All {len(MUTANTS)} mutants fit the package.")
        sys.exit(bool(wrong))
    else:
        unknown = [name for name in options.run if name not in MUTANTS]
        if unknown:
            parser.error(f"unknown mutant {unknown[0]!r}: --list prints all.")
        run(
            options.run or list(MUTANTS),
            options.m or [DEFAULT],
            options.n,
            options.nearest,
            options.out.absolute(),
        )


if __name__ == "__main__":
    main()
