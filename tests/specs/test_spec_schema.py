# Tests of specs/described.py, specs/fields.py, specs/model.py
"""JSON Schemas of spec files: they accept what is read, refuse what is misspelt, and describe each parameter."""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from command import call, json_of

from nermo_mjx.cli.tools import FILES
from nermo_mjx.rollout import all_parameters
from nermo_mjx.specs.fields import Fields
from nermo_mjx.specs.reading import read_file, read_text

SHIPPED = sorted(Path(__file__).parents[2].glob("sweeps/*.yaml"))


def schema(kind: str) -> dict[str, Any]:
    ran = call("schema", kind)
    assert ran.exit_code == 0, ran.output
    return json.loads(ran.stdout)


@pytest.fixture(scope="module")
def schemas() -> dict[str, dict[str, Any]]:
    """The schema of each kind, as the command prints it."""
    return {kind: schema(kind) for kind in FILES}


def kind_of(path: Path) -> str:
    """Which command a shipped file is for."""
    data = read_file(path).data
    section = next((name for name in ("tune", "task") if name in data), "")
    if section:
        return {"tune": "tune", "task": "train"}[section]
    return "search" if {"objective", "pareto"} & set(data) else "sweep"


def faults(schema: dict[str, Any], data: Any) -> list[str]:
    return [error.message for error in jsonschema.Draft7Validator(schema).iter_errors(data)]


@pytest.mark.parametrize("kind", FILES)
def test_a_schema_is_one_itself(schemas, kind):
    """In the dialect that it names; every reference leads somewhere."""
    jsonschema.Draft7Validator.check_schema(schemas[kind])
    assert schemas[kind]["$schema"] == jsonschema.Draft7Validator.META_SCHEMA["$schema"]
    text = json.dumps(schemas[kind])
    assert set(re.findall(r'"#/\$defs/(\w+)"', text)) == set(schemas[kind].get("$defs", ()))
    assert "NaN" not in text
    assert "Infinity" not in text


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_the_shipped_files_are_valid(schemas, path):
    """An editor marks nothing in them."""
    assert faults(schemas[kind_of(path)], read_file(path).data) == []


@pytest.mark.release(cases=("train_own", "train_terrains", "atlas", "search_published_gait"))
@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_resolved_files_are_valid(schemas, path):
    """So are those that results hold, with all defaults written out."""
    from nermo_mjx.learn.spec import Training
    from nermo_mjx.optimize import Search, Tuning
    from nermo_mjx.sweep import Sweep

    kind = kind_of(path)
    spec_class = {"tune": Tuning, "search": Search, "sweep": Sweep, "train": Training}[kind]
    assert faults(schemas[kind], spec_class.from_file(path).resolved()) == []


SWEEP, TUNE = "vary: {frequency: [0.5]}\n", "tune: {duty: }\nobjective: [{maximize: speed}]\n"
#: Valid spellings that the shipped files do not have.
GOOD = [
    ("sweep", "pilot: {waypoints: {points: [[0, 0], [0, -0.5], [0.3, -1]]}}"),
    ("sweep", "pilot: {arc: {radius: 0.5, direction: right}}"),
    ("sweep", "pilot: arc"),
    ("sweep", "pilot: {straight: }"),
    ("sweep", "sample: grid\nchunk: 16\nplots: false\nspine: stride_extension+balance\nseed: 3"),
    (
        "sweep",
        "sample: {sobol: 64}\nrandomize: {repeats: 2, from: identified, mass.front: {normal: [0.16, 0.01]}}",
    ),
    ("tune", "optimizer: sgd\nmethod: {wide_differences: {scheme: forward}}"),
    (
        "tune",
        "optimizer: {name: adam, learning_rate: {cosine: {init_value: 0.1, decay_steps: 20}}, b1: 0.8}",
    ),
]


@pytest.mark.parametrize(("kind", "addition"), GOOD)
def test_what_is_read_is_valid(schemas, kind, addition):
    """A schema that rejects valid files would be ignored."""
    from nermo_mjx.optimize import Tuning
    from nermo_mjx.sweep import Sweep

    text = (SWEEP if kind == "sweep" else TUNE) + addition
    (Sweep if kind == "sweep" else Tuning).from_text(text)
    assert faults(schemas[kind], read_text(text, "s.yaml").data) == []


#: Mistakes in one field each.
WRONG = [
    ("sweep", "gate: trot"),
    ("sweep", "gait: trott"),
    ("sweep", "duty: 0.5"),
    ("sweep", "set: {duty: 1.5}"),
    ("sweep", "set: {dutty: 0.5}"),
    ("sweep", "set: {duty: true}"),
    ("sweep", "set: [0.5]"),
    ("sweep", "vary: {frequency: 0.5}"),
    ("sweep", "vary: {frequency: {linspce: [0, 1, 3]}}"),
    ("sweep", "vary: {frequency: {linspace: [0, 1, 3], values: [1]}}"),
    ("sweep", "vary: {frequency: {uniform: [0.4]}}"),
    ("sweep", "sample: random"),
    ("sweep", "sample: {sobol: 0}"),
    ("sweep", "randomize: {repeats: 2.5}"),
    ("sweep", "randomize: {from: identifed}"),
    ("sweep", "pilot: {strait: {distance: 2}}"),
    ("sweep", "pilot: {straight: {distance: -2}}"),
    ("sweep", "pilot: external"),
    ("sweep", "run: {cycels: 2}"),
    ("sweep", "plots: 3"),
    ("tune", "vary: {duty: [0.5]}"),
    ("tune", "tune: {duty: {bounds: [0.4]}}"),
    ("tune", "objective: []"),
    ("tune", "objective: [{maximise: speed}]"),
    ("tune", "objective: [{maximize: sped}]"),
    ("tune", "objective: [{maximize: speed, minimize: slip}]"),
    ("tune", "objective: [{hold: speed}]"),
    ("tune", "optimizer: adamm"),
    ("tune", "optimizer: {learning_rate: -0.1}"),
    ("tune", "estimator: exact"),
    ("tune", "mode: reverse"),
    ("servos", "spin: {channel: 0}"),
    ("servos", "neck: {zero: 90}"),
    ("servos", "neck: {channel: 0, direction: 2}"),
]


@pytest.mark.parametrize(("kind", "wrong"), WRONG)
def test_what_is_wrong_in_a_field_is_not_valid(schemas, kind, wrong):
    """An editor marks what reading the file refuses, too."""
    from nermo_mjx.hardware.channels import read_channels
    from nermo_mjx.optimize import Tuning
    from nermo_mjx.sweep import SpecError, Sweep

    base = {"sweep": SWEEP, "tune": TUNE, "servos": ""}[kind]
    field = wrong.partition(":")[0]
    text = re.sub(rf"(?m)^{field}:.*\n", "", base) + wrong
    data = read_text(text, "s.yaml").data
    reader = {"sweep": Sweep.from_dict, "tune": Tuning.from_dict, "servos": read_channels}[kind]
    with pytest.raises(SpecError):
        reader(data)
    assert faults(schemas[kind], data) != []


def test_every_parameter_is_offered_with_meaning_unit_default_and_range(schemas):
    """In each section that names parameters; an editor shows the description beside the name."""
    sections = [schemas["sweep"]["properties"]["set"]]
    sections += [schemas["sweep"]["$defs"][name] for name in ("Vary", "Randomized")]
    sections += [schemas["tune"]["properties"]["tune"]]
    for section in sections:
        for name, quantity in all_parameters().items():
            description = section["properties"][name]["description"]
            assert quantity.doc in description
            assert f"default {quantity.default:g}" in description
            assert quantity.allowed() in description
        assert section["additionalProperties"] is False


def test_the_command_writes_a_file(tmp_path):
    """It prints only its name then, and with --quiet nothing; its folder is made."""
    out = tmp_path / "new" / "sweep.schema.json"
    for options, message in (((), f"wrote {out}\n"), (("--quiet",), "")):
        ran = call("schema", "sweep", "--out", out, *options)
        assert (ran.exit_code, ran.output) == (0, message)
    assert (
        json_of("schema", "sweep", "--out", out)
        == json.loads(out.read_text())
        == json_of("schema", "sweep")
    )
    assert json.loads(call("schema", "sweep", "--quiet").stdout) == json_of("schema", "sweep")
    gaits = json.loads(out.read_text())["properties"]["gait"]["enum"]
    assert gaits == ["trot", "walking_trot", "lateral_walk", "bound", "gallop"]


def test_an_unknown_kind_is_wrong_use():
    ran = call("schema", "sweeps")
    assert ran.exit_code == 2
    assert "'sweep', 'search', 'tune', 'train', 'servos'" in ran.output


ODD = [
    None,
    True,
    0,
    -1,
    2.5,
    float("nan"),
    float("inf"),
    10**400,
    "",
    "x",
    [],
    [1],
    ["a"],
    [[1, 2]],
    [{}],
    {},
]
ODD += [{"x": value} for value in (None, 1, "a", [1], {})]


def sections(kind: type[Fields]) -> Iterator[type[Fields]]:
    """Every section of every file that is a model of its own; what others build on is part of them."""
    for subclass in kind.__subclasses__():
        yield from sections(subclass) if subclass.__subclasses__() else [subclass]


@pytest.mark.release
def test_no_odd_value_leads_to_anything_but_a_sentence():
    """At each field of each file, and at each field of what stands there."""
    from nermo_mjx.learn import PPO, Modulation, Residual, Task
    from nermo_mjx.learn.spec import EvaluationSpec, TrainingFile
    from nermo_mjx.optimize.objective import ObjectiveTerm
    from nermo_mjx.optimize.search_spec import CmaMe, Limit, SearchFile
    from nermo_mjx.optimize.tuning_spec import Differences, Tuned, TuningFile
    from nermo_mjx.specs.fields import read
    from nermo_mjx.specs.reading import SpecError, read_mapping

    messages = []
    for model in sections(Fields):
        for name in [*model.declared(), "frequency", "other"]:
            for odd in ODD:
                try:
                    read(read_mapping({name: odd}), model)
                except SpecError as error:
                    messages.append(str(error))
    places = {
        Task: (TrainingFile, lambda value: {"task": value}),
        EvaluationSpec: (TrainingFile, lambda value: {"evaluate": value}),
        PPO: (TrainingFile, lambda value: {"algorithm": {"ppo": value}}),
        Residual: (TrainingFile, lambda value: {"task": {"action": {"residual": value}}}),
        Modulation: (TrainingFile, lambda value: {"task": {"action": {"modulation": value}}}),
        ObjectiveTerm: (TuningFile, lambda value: {"objective": [value]}),
        Tuned: (TuningFile, lambda value: {"tune": {"duty": value}}),
        Differences: (TuningFile, lambda value: {"method": {"wide_differences": value}}),
        Limit: (SearchFile, lambda value: {"subject_to": {"speed": value}}),
        CmaMe: (SearchFile, lambda value: {"method": {"cma_me": value}}),
    }
    for section, (file, placed) in places.items():
        for name in [field.name for field in dataclasses.fields(section)]:
            for odd in ODD:
                try:
                    read(read_mapping(placed({name: odd})), file)
                except SpecError as error:
                    messages.append(str(error))
    assert len(messages) > 5000
    assert [message for message in messages if message[-1] not in ".?" or "\n" in message] == []
