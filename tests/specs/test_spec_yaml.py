# Tests of specs/reading.py
"""YAML's own means in spec files: anchors and merge keys work, and what is no plain value is refused in words."""

import pytest

from nermo_mjx.hardware.channels import read_channels
from nermo_mjx.optimize.tuning_spec import Tuning
from nermo_mjx.robot import SERVOS
from nermo_mjx.specs.reading import read_text
from nermo_mjx.sweep import SpecError, Sweep


def data(text):
    return read_text(text, "s.yaml").data


def test_a_merge_key_brings_fields_and_own_fields_win():
    """Own fields override those of `<<`, wherever it stands."""
    assert data("a: &a {x: 1, y: 2}\nb: {y: 3, <<: *a}\n")["b"] == {"x": 1, "y": 3}


def test_of_a_list_of_merged_mappings_the_first_one_wins():
    """As YAML defines it; merges of merges count, too."""
    text = "a: &a {x: 1}\nb: &b {<<: *a, x: 2, y: 2}\nc:\n  <<: [*a, *b, {z: 9}]\n  w: 0\n"
    assert list(data(text)["c"].items()) == [("x", 1), ("y", 2), ("z", 9), ("w", 0)]


def test_an_alias_stands_for_its_value_and_is_not_shared():
    """Changing one of the two does not change the other."""
    document = data("a: &a [1, {b: 2}]\nc: *a\n")
    assert document["c"] == document["a"] == [1, {"b": 2}]
    assert document["c"] is not document["a"]
    assert document["c"][1] is not document["a"][1]


def test_a_quoted_merge_key_is_a_name():
    """Only the plain `<<` merges."""
    assert data('a: {"<<": 1}\n') == {"a": {"<<": 1}}


def test_a_sweep_and_a_tuning_with_merge_keys_are_those_written_out():
    """What is run does not depend on how its file was written."""
    sweep = "spine: stride_extension\nvary:\n  frequency: &f {linspace: [0.4, 1.2, 3]}\n  spine.phase: {%s}\n"
    assert (
        Sweep.from_text(sweep % "<<: *f").resolved()
        == Sweep.from_text(sweep % "linspace: [0.4, 1.2, 3]").resolved()
    )
    tuning = (
        "spine: stride_extension\ntune:\n  spine.phase: &p {bounds: [0.0, 0.3], start: 0.1}\n"
        "  spine.amplitude: {%s}\nobjective: [{maximize: speed}]\n"
    )
    assert (
        Tuning.from_text(tuning % "<<: *p").resolved()
        == Tuning.from_text(tuning % "bounds: [0.0, 0.3], start: 0.1").resolved()
    )


def test_a_message_names_the_line_where_a_merged_value_stands():
    """The line of the value that is wrong, not that of the merge key."""
    with pytest.raises(SpecError, match=r"^s.yaml:3: field 'run.cycles' is the text 'many'"):
        Sweep.from_text(
            "vary: {frequency: [0.5]}\nrun: {<<: &run {warmup_cycles: 1,\n  cycles: many}}\n",
            "s.yaml",
        )


def test_what_an_alias_stands_for_has_the_lines_of_the_anchor():
    """The field that uses it has its own line."""
    doc = read_text("a: &a\n  x: 1\n  y:\n  - 2\nb: *a\n", "s.yaml")
    assert [doc.where(path) for path in (("b",), ("b", "x"), ("b", "y", 0))] == [
        "s.yaml:5",
        "s.yaml:2",
        "s.yaml:4",
    ]
    with pytest.raises(SpecError, match=r"^s.yaml:3: field 'spine.amplitude' is 1.2: allowed is"):
        Sweep.from_text("vary:\n  frequency: &f [0.4, 1.2]\n  spine.amplitude: *f\n", "s.yaml")


PLAIN = "allowed are texts (in quotes where needed), numbers, true, false, lists and mappings."
#: A field of a file, the line of the message, and the message.
ODD = {
    "tagged text": ("a: !foo bar", 2, f"field 'a' is 'bar' with the tag !foo: {PLAIN}"),
    "tagged mapping": (
        "a:\n  b: !foo {c: 1}",
        3,
        f"field 'a.b' is a mapping with the tag !foo: {PLAIN}",
    ),
    "tagged list": ("a: [1, !foo [2]]", 2, f"field 'a.1' is a list with the tag !foo: {PLAIN}"),
    "tagged key": (
        "!foo a: 1",
        2,
        "the name of a field is 'a' with the tag !foo: expected a text.",
    ),
    "set": ("a: !!set {b, c}", 2, f"field 'a' is a mapping with the tag !!set: {PLAIN}"),
    "binary": ("a: !!binary aGk=", 2, f"field 'a' is 'aGk=' with the tag !!binary: {PLAIN}"),
    "ordered mapping": ("a: !!omap [b: 1]", 2, f"field 'a' is a list with the tag !!omap: {PLAIN}"),
    "date": ("a: 2021-12-01", 2, f"field 'a' is '2021-12-01' with the tag !!timestamp: {PLAIN}"),
    "wrong number": (
        "a: !!float much",
        2,
        "field 'a' is 'much' with the tag !!float, which it is not.",
    ),
    "number as a key": ("a: {3: 1}", 2, "the name of a field is the number 3: expected a text."),
    "truth value as a key": (
        "true: 1",
        2,
        "the name of a field is the truth value true: expected a text.",
    ),
    "nothing as a key": ("a:\n  ~: 1", 3, "the name of a field is nothing: expected a text."),
    "list as a key": ("? [1, 2]\n: 3", 2, "the name of a field is a list: expected a text."),
    "duplicate key": ("a: {b: 1,\n  b: 2}", 3, "field 'a.b' stands twice; keep one of them."),
    "two merge keys": (
        "a: &a {}\nb: {<<: *a, <<: *a}",
        3,
        "field 'b.<<' stands twice; merge a list instead.",
    ),
    "merged number": (
        "a: {<<: 3}",
        2,
        "field 'a.<<' is the number 3: expected a mapping or a list of mappings.",
    ),
    "merged texts": (
        "a:\n  <<: [b]",
        3,
        "field 'a.<<' is the text 'b': expected a mapping or a list of mappings.",
    ),
    "alias within itself": ("a: &a [1, *a]", 2, "field 'a.1' contains itself through an alias."),
    "merged into itself": ("a: &a {<<: *a}", 2, "field 'a.<<' contains itself through an alias."),
}


@pytest.mark.parametrize("case", ODD)
def test_what_is_no_plain_value_is_refused_with_line_field_and_value(case):
    """One sentence, as for every other mistake."""
    text, line, message = ODD[case]
    with pytest.raises(SpecError) as caught:
        read_text(f"# a comment\n{text}\n", "s.yaml")
    assert str(caught.value) == f"s.yaml:{line}: {message}"


def test_a_file_that_is_one_tagged_value_is_refused():
    """There is no field to name."""
    with pytest.raises(
        SpecError, match=r"^s.yaml:1: the sweep is a mapping with the tag !foo: allowed are"
    ):
        read_text("!foo {a: 1}", "s.yaml")


def test_a_standard_tag_gives_the_value_it_names():
    """`!!str 5` is a text, as YAML says, and `!!float 1` a number."""
    assert data("a: !!str 5\nb: !!float 1\nc: ! x\n") == {"a": "5", "b": 1.0, "c": "x"}


def test_a_servo_table_may_merge(tmp_path):
    """Every file that is read as a spec can."""
    path = tmp_path / "c.yaml"
    path.write_text(
        f"{SERVOS[0]}: &a {{channel: 0, zero: 90}}\n{SERVOS[1]}: {{<<: *a, channel: 1}}\n"
    )
    assert [(c.number, c.zero) for c in read_channels(path)] == [(0, 90.0), (1, 90.0)]
