"""The table and numbers of README.md: the optima of `sweeps/three_gaits.yaml` in two profiles, as JSON.

python docs/answers/three_gaits.py PROFILE DIR   # writes DIR/PROFILE.yaml, the same sweep in another profile
python docs/answers/three_gaits.py table DIR     # prints the JSON, and writes docs/answers/three_gaits.csv
python docs/answers/three_gaits.py film DIR      # DIR/three_gaits.gif, of the sweep DIR/exact

`three_gaits.csv` lists the pairs of runs that measured the best points, in SI units: a row contains the samples, the
metrics of the run with the stiff spine, and the metrics of the run at the best point. Its last rows are the pairs of
`as_published` at the simulated frequency of `exact`.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd

from nermo_mjx import Recording, Run, Setup, Simulator, read_table
from nermo_mjx.plotting.shown import half_width
from nermo_mjx.sweep.optimum import optimum_in
from nermo_mjx.sweep.replay import recording_file
from nermo_mjx.sweep.table import SweepRecord, columns_of

ROOT = Path(__file__).parents[2]
SPEC = ROOT / "sweeps" / "three_gaits.yaml"
PAIRS = ROOT / "docs" / "answers" / "three_gaits.csv"
#: Seconds of the film: two gait cycles.
SECONDS = 2.5
#: Of the file [Hz], on the controller's clock.
FREQUENCY = 0.8
ELECTRICAL = "electrical_cost_of_transport"
METRICS = ("speed", "cost_of_transport", ELECTRICAL)
STIFF = "stiff."
#: The row with a mark, which the page explains.
MARKED = ("as_published", "lateral_walk")
HEAD = (
    "profile",
    "gait",
    "stride frequency, simulated [Hz]",
    "amplitude [rad]",
    "phase [°]",
    "gain in speed [%]",
    "mechanical cost [%]",
    "electrical cost [%]",
)


def simulated_frequency(profile: str) -> float:
    """The stride frequency of the file in simulated time [Hz]."""
    return FREQUENCY / Setup(profile=profile).defaults()["tracking.clock_ratio"]


def pairs_of(profile: str, sweep: Path) -> pd.DataFrame:
    """The pairs of runs that measured the best points of a sweep, as rows of three_gaits.csv."""
    sought, record = optimum_in(sweep), SweepRecord.of_directory(sweep)
    assert sought is not None
    assert record is not None
    runs = read_table(sweep).to_pandas()
    runs = runs[
        (runs["repeat"] >= record.repeats) & (runs["repeat"] < record.repeats + sought.asked.fresh)
    ]
    points, sampled = ["spine.amplitude", "spine.phase"], columns_of(sought.results, "randomized")
    found = []
    for answer in sought.answers:
        own = runs[runs["gait"] == answer.group["gait"]]
        stiff, best = (
            own[own["spine"] == "none"],
            own[np.isclose(own[points], [answer.at[name] for name in points]).all(1)],
        )
        both = best.merge(
            stiff[["seed", *METRICS, "status"]].add_prefix(STIFF),
            left_on="seed",
            right_on=f"{STIFF}seed",
        )
        assert len(both) == sought.asked.fresh
        assert (both[["status", f"{STIFF}status"]] == "ok").all(axis=None)
        found.append(
            both[["gait", *points, "seed", *sampled, *(STIFF + name for name in METRICS), *METRICS]]
        )
    both = pd.concat(found)
    both.insert(0, "profile", profile)
    both.insert(1, "frequency", simulated_frequency(profile))
    return both


def at_frequency(pairs: pd.DataFrame, frequency: float) -> pd.DataFrame:
    """The same pairs of one profile at another simulated stride frequency [Hz]."""
    found = pairs.assign(frequency=frequency)
    profile, sampled = (
        pairs["profile"].iloc[0],
        pairs.columns[pairs.columns.get_loc("seed") + 1 : -2 * len(METRICS)],
    )
    for gait in pairs["gait"].unique():
        here = (pairs["gait"] == gait).to_numpy()
        values = {name: pairs.loc[here, name].to_numpy() for name in sampled}
        values["frequency"] = FREQUENCY * frequency / simulated_frequency(profile)
        bent = {
            name: pairs.loc[here, name].to_numpy() for name in ("spine.amplitude", "spine.phase")
        }
        for spine, prefix, more in (("none", STIFF, {}), ("stride_extension", "", bent)):
            setup = Setup(gait=gait, profile=profile, scene="flat", pilot="straight", spine=spine)
            result = Simulator(setup, engine="c").run(values | more, Run(cycles=6, warmup_cycles=2))
            assert set(result.status.tolist()) == {"ok"}, result.status
            for name in METRICS:
                found.loc[here, prefix + name] = np.asarray(result.metrics[name])
    return found


def change(pairs: pd.DataFrame, metric: str) -> tuple[float, float, float]:
    """By how much the spine changes the mean of a metric, and the 95 % confidence interval of this change [%]."""
    stiff, count = pairs[STIFF + metric], len(pairs)
    difference, scale = pairs[metric] - stiff, 100 / stiff.mean()
    half = float(half_width(difference.std(), count))
    return (
        scale * difference.mean(),
        scale * (difference.mean() - half),
        scale * (difference.mean() + half),
    )


def change_of_one_robot(pairs: pd.DataFrame, metric: str) -> tuple[float, float, float]:
    """By how much the spine changes a metric on average, and the 95 % prediction interval of a single pair [%]."""
    each = 100 * (pairs[metric] / pairs[STIFF + metric] - 1)
    half = float(half_width(each.std(), len(each))) * math.sqrt(len(each) + 1)
    return each.mean(), each.mean() - half, each.mean() + half


def text(mean: float, low: float, high: float) -> str:
    """A change and its interval for people."""
    return f"{mean:+.1f} ({low:+.1f} to {high:+.1f})"


def table(pairs: pd.DataFrame) -> str:
    """A row for each profile and gait at the frequency of the file."""
    lines = [f"| {' | '.join(HEAD)} |", "|---" * len(HEAD) + "|"]
    for (profile, gait), own in pairs.groupby(["profile", "gait"], sort=False):
        frequency = simulated_frequency(profile)
        own = own[np.isclose(own["frequency"], frequency)]
        assert len(own) == 24
        amplitude, phase = own["spine.amplitude"].iloc[0], math.degrees(own["spine.phase"].iloc[0])
        mark = " †" if (profile, gait) == MARKED else ""
        cells = [
            f"`{profile}`",
            gait.replace("_", " ") + mark,
            f"{frequency:g}",
            f"{amplitude:g}",
            f"{phase:.0f}",
        ]
        cells += [text(*change(own, metric)) for metric in METRICS if metric != ELECTRICAL]
        electrical = change_of_one_robot(own, ELECTRICAL)
        cells.append(
            text(*electrical) + (", **sign unknown**" if electrical[1] < 0 < electrical[2] else "")
        )
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def slow(pairs: pd.DataFrame) -> str:
    """What the best points of `as_published` gain at the simulated frequency of `exact`, in words."""
    own = pairs[
        (pairs["profile"] == "as_published")
        & np.isclose(pairs["frequency"], simulated_frequency("exact"))
    ]
    gains = [
        f"{gait.replace('_', ' ')} {text(*change(each, 'speed'))} %"
        for gait, each in own.groupby("gait", sort=False)
    ]
    return ", ".join(gains)


def undecided(sweep: Path) -> str:
    """How many points of the marked gait may be the fastest."""
    sought = optimum_in(sweep)
    assert sought is not None
    regions = [each.judged.region for each in sought.answers if each.group["gait"] == MARKED[1]]
    return f"{regions[0].sum()} of {len(regions[0])}"


def worst(sweep: Path) -> str:
    """The most that a point of the maps costs of the base's speed [%], and the gait, amplitude and phase, in words."""
    sought = optimum_in(sweep)
    assert sought is not None
    lowest = []
    for answer in sought.answers:
        gain = 100 * (answer.mean / answer.base_mean - 1.0)
        place = int(np.nanargmin(gain))
        amplitude, phase = (
            float(answer.points[name][place]) for name in ("spine.amplitude", "spine.phase")
        )
        at = f"{answer.group['gait'].replace('_', ' ')}, {amplitude:g} rad, {math.degrees(phase):.0f}°"
        lowest.append((gain[place], f"{-gain[place]:.0f} % of the speed ({at})"))
    return min(lowest)[1]


def film(sweep: Path, out: Path) -> None:
    """The last cycles of the best points and their bases, from above."""
    sought = optimum_in(sweep)
    assert sought is not None
    files = []
    for row in sought.shown_rows():
        recording = Recording.load(recording_file(sweep, row))
        files.append(sweep / f"{recording.metadata['kept']}.npz")
        recording.between(recording.time[-1] - SECONDS, recording.time[-1]).save(files[-1])
    small = ["--camera", "top", "--width", "360", "--height", "150", "--fps", "12"]
    subprocess.run(
        [sys.executable, "-m", "nermo_mjx", "render", *files, *small, "--out", out], check=True
    )


if __name__ == "__main__":
    what, out = sys.argv[1], Path(sys.argv[2])
    if what == "table":
        made = {profile: pairs_of(profile, out / profile) for profile in ("exact", "as_published")}
        slower = at_frequency(made["as_published"], simulated_frequency("exact"))
        pd.concat([*made.values(), slower]).to_csv(PAIRS, index=False, float_format="%.6g")
        pairs = pd.read_csv(PAIRS)
        found = {
            "answers": table(pairs),
            "answers.slow": slow(pairs),
            "answers.worst": worst(out / "exact"),
        }
        found["answers.undecided"] = undecided(out / MARKED[0])
        print(json.dumps(found, indent=1, ensure_ascii=False))
    elif what == "film":
        film(out / "exact", out / "three_gaits.gif")
    else:
        (out / f"{what}.yaml").write_text(
            SPEC.read_text().replace("robot: nermo_lite\n", f"robot: nermo_lite\nprofile: {what}\n")
        )
