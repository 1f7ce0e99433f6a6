"""The shares of the identified bodies that ship with the package, for reports of runs with the default settings.

    python -m nermo_mjx.experiments.published.shares DIR

writes them from a directory that `nermo-mjx experiment all --bodies N --out DIR` has filled. Bodies of the experiments
with predicted lines, straight-line and maze, are enough: only those are evidence, and the others take ten times longer.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Final

from nermo_mjx.experiments.ensemble import Ensemble

FILE: Final = Path(__file__).with_name("ensemble_shares.json")


def shipped(experiment: str, file: Path = FILE) -> Ensemble | None:
    """The shares of an experiment that ship with the package, or None."""
    content = json.loads(file.read_text(encoding="utf-8"))
    shares = content["shares"].get(experiment)
    return Ensemble(content["bodies"], shares) if shares else None


def write(directory: str | Path, file: Path = FILE) -> int:
    """Write the shares of all experiments of a directory, and return the number of bodies.

    Raises:
        ValueError: the directory holds no bodies of an experiment with predicted lines, different numbers of them, a
            quick run, or one with other parameters than the default.
    """
    from nermo_mjx.experiments.catalogue import EXPERIMENTS
    from nermo_mjx.experiments.directory import Directory
    from nermo_mjx.experiments.ensemble import of_outcome

    found: dict[str, Ensemble] = {}
    for name, experiment in EXPERIMENTS.items():
        stored = Directory(directory).load_bodies(name)
        if stored is None and all(figure.kind != "predicted" for figure in experiment.figures):
            continue
        if stored is None:
            raise ValueError(f"{directory} holds no bodies of {name}: run `nermo-mjx experiment all --bodies N` there.")
        settings = stored.about["settings"]
        if settings["quick"] or settings["values"]:
            raise ValueError(f"{directory} holds a run of {name} that is quick, or has other parameters.")
        found[name] = of_outcome(stored.outcome, experiment.figures)
    counts = {each.bodies for each in found.values()}
    if len(counts) != 1:
        raise ValueError(f"{directory} holds different numbers of bodies: {sorted(counts)}.")
    (bodies,) = counts
    shares = {
        name: {figure: None if share is None else round(share, 4) for figure, share in each.shares.items()}
        for name, each in found.items()
    }
    text = json.dumps({"bodies": bodies, "shares": shares}, indent=1, ensure_ascii=False)
    file.write_text(f"{text}\n", encoding="utf-8")
    return bodies


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python -m nermo_mjx.experiments.published.shares DIR")
    try:
        print(f"{FILE}: {write(sys.argv[1])} bodies")
    except ValueError as error:
        sys.exit(str(error))
