# Tests of cli/options.py, cli/tools.py, cli/choices.py
"""Completion in the shell: what is offered, quickly, and without anything heavy."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from command import call, json_of

from nermo_mjx.cli import choices, main
from nermo_mjx.cli.options import offered


def complete(line: str, folder: Path, shell: str = "bash") -> list[str]:
    """What a shell is offered for the last word of a line, in a process of its own."""
    words = line.split(" ")
    word_position = words[-1] if shell == "fish" else str(len(words) - 1)
    script = (
        "import sys\nfrom nermo_mjx.cli import main\n"
        "try:\n    main(prog_name='nermo-mjx')\n"
        "finally:\n    assert not {'jax', 'mujoco', 'numpy', 'pyarrow'} & set(sys.modules), 'heavy'\n"
    )
    environment = os.environ | {
        "_NERMO_MJX_COMPLETE": f"{shell}_complete",
        "COMP_WORDS": line,
        "COMP_CWORD": word_position,
    }
    environment |= {"PYTHONPATH": str(Path(__file__).parents[2])}
    done = subprocess.run(
        [sys.executable, "-c", script], env=environment, cwd=folder, capture_output=True, text=True
    )
    assert "heavy" not in done.stderr
    return done.stdout.splitlines()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in (
        "trot.yaml",
        "walk.npz",
        "notes.txt",
        "runs/a.yaml",
        "runs/b.npz",
        "deep/er/c.yaml",
        ".hidden.yaml",
    ):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    return tmp_path


@pytest.mark.parametrize(
    ("line", "offer"),
    [
        ("nermo-mjx pl", ["plain,play", "plain,plot"]),
        ("nermo-mjx walk --gait t", ["plain,trot"]),
        ("nermo-mjx walk --set spine.a", ["plain,spine.amplitude=", "plain,spine.amplitude=X"]),
        ("nermo-mjx walk --scene q", ["plain,quarter_circles"]),
        ("nermo-mjx render --camera th", ["plain,three_quarter"]),
        ("nermo-mjx plot runs --x roll_s", ["plain,roll_std"]),
        ("nermo-mjx sweep ", ["plain,deep/", "plain,runs/", "plain,trot.yaml"]),
        ("nermo-mjx play ", ["plain,deep/", "plain,runs/", "plain,trot.yaml", "plain,walk.npz"]),
        ("nermo-mjx tune runs/", ["plain,runs/a.yaml"]),
        ("nermo-mjx tune d", ["plain,deep/er/c.yaml"]),
        ("nermo-mjx tune nothing", ["file,nothing"]),
    ],
)
def test_the_shell_offers_commands_names_and_files_by_their_kind(
    line: str, offer: list[str], folder: Path
) -> None:
    assert complete(line, folder) == offer


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_every_shell_is_offered_the_same_after_what_the_command_prints(
    shell: str, folder: Path
) -> None:
    assert set(complete("nermo-mjx sweep t", folder, shell)) & {"trot.yaml", "plain,trot.yaml"}
    text = call("completion", shell).stdout
    assert text == call("completion", shell, "--quiet").stdout
    assert json_of("completion", shell) == {"shell": shell, "script": text.removesuffix("\n")}
    assert f"_NERMO_MJX_COMPLETE={shell}_complete" in text
    assert "nermo-mjx" in text


@pytest.mark.parametrize("name", sorted(main.commands))
def test_every_command_has_json_and_quiet(name: str) -> None:
    """As its reference and the README promise; a failure prints no object, and its sentence on standard error."""
    options = {flag for parameter in main.commands[name].params for flag in parameter.opts}
    assert {"--json", "--quiet", "-q"} <= options
    failed = call(name, "--json", "--no-such-option")
    assert (failed.exit_code, failed.stdout) == (2, "")
    assert "--no-such-option" in failed.stderr


def test_names_written_out_for_the_shell_are_those_of_the_package() -> None:
    """After a parameter, metric, gait or scene is added, `python nermo_mjx/cli/choices.py` writes them anew."""
    assert choices.FILE.read_text() == choices.text_of(choices.of_package())


def test_hidden_files_are_offered_when_asked_for(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    assert offered(".h", (".yaml",)) == [".hidden.yaml"]
    assert offered(f"{folder}/tr", (".yaml",)) == [f"{folder}/trot.yaml"]
    assert offered("missing/", (".yaml",)) == []
