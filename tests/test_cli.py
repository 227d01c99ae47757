"""Command lines are read, explained and refused in one way."""

from dataclasses import dataclass
from pathlib import Path

import pytest

from omniperception.config import ConfigError
from omnirobot.common.cli import Command, argument


@dataclass(frozen=True, kw_only=True)
class Arguments:
    what: str = argument(doc="what is timed", choices=("step", "iteration"))
    trials: int = argument(1000, "at least so many episodes", least=1)
    seconds: float = argument(0.1, "length of a frame (s)", positive=True)
    num_envs: int | None = argument(None, "environments at a time", least=1)
    variants: tuple[str, ...] = argument(("a", "b"), "presets")
    out: Path | None = argument(None, "folder")
    plots: bool = argument(True, "whether to draw")


def nothing(arguments, overrides=()):
    """A command that does nothing."""


OPEN = Command(nothing, Arguments, "Times things.\n\nAnd more.", overrides="of the task")
CLOSED = Command(nothing, Arguments, "Times things.")


def test_arguments_and_overrides():
    given = ["what=step", "trials=7", "seconds=0.5", "variants=x,y", "out=here", "plots=false", "seed=3", "~foo"]
    arguments, overrides = OPEN.parse(given)
    expected = Arguments(what="step", trials=7, seconds=0.5, variants=("x", "y"), out=Path("here"), plots=False)
    assert arguments == expected and overrides == ["seed=3", "~foo"]
    assert OPEN.parse(["what=step", "num_envs=null"])[0] == Arguments(what="step")


def test_folders_of_presets_become_hydras_search_path(tmp_path):
    _, overrides = OPEN.parse(["what=step", "--config-dir", str(tmp_path), f"--config-dir={tmp_path}"])
    assert overrides == [f"hydra.searchpath=['file://{tmp_path}','file://{tmp_path}']"]


def test_help_shows_defaults_and_choices(capsys):
    for flag in ("--help", "-h"):
        OPEN([flag])
        text = capsys.readouterr().out
        assert text.startswith("usage: python ") and "And more." in text and "--config-dir DIR" in text
        for shown in ("trials=1000 ", "variants=a,b ", "plots=true ", "(step, iteration) (must be given)"):
            assert shown in text
    CLOSED(["--help"])
    assert "--config-dir" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("given", "named"),
    [
        ("", "what=... must be given: one of step, iteration"),
        ("what=walk", "what=walk must be one of step, iteration"),
        ("what=step what=step", "what is given twice"),
        ("what=step seed=1 seed=2", "seed is given twice"),
        ("what=step trials=0", "trials=0 must be a whole number >= 1"),
        ("what=step trials=2.5", "trials=2.5 must be a whole number"),
        ("what=step trials=", "trials= is empty"),
        ("what=step seconds=nan", "seconds=nan must be a number above 0"),
        ("what=step seconds=inf", "seconds=inf must be a number above 0"),
        ("what=step variants=a,a", "variants=a,a names one twice"),
        ("what=step variants=,", "variants=,"),
        ("what=step plots=yes", "plots=yes must be true or false"),
        ("what=step many", "argument 'many' is not of the form key=value"),
        ("what=step --fast", "--fast is unknown; known flags: --help, --config-dir DIR"),
        ("what=step --config-dir nowhere", "--config-dir nowhere"),
        ("what=step --config-dir", "--config-dir"),
    ],
)
def test_wrong_input_is_one_line_and_exit_code_2(given, named, capsys):
    with pytest.raises(SystemExit) as stopped:
        OPEN(given.split())
    (line,) = capsys.readouterr().err.splitlines()
    assert stopped.value.code == 2 and named in line


def test_what_is_unknown_is_guessed():
    with pytest.raises(ConfigError, match=r"trails=3 is unknown; did you mean trials\?"):
        CLOSED.parse(["what=step", "trails=3"])


def test_errors_of_a_command(capsys):
    def fails(arguments):
        raise KeyError("no\nsuch")

    with pytest.raises(SystemExit):
        Command(fails, Arguments, "", errors=(KeyError,))(["what=step"])
    assert len(capsys.readouterr().err.splitlines()) == 1
    with pytest.raises(KeyError):
        Command(fails, Arguments, "")(["what=step"])


@pytest.mark.parametrize("said", ["", "interrupted after 3 iterations, checkpoint saved"])
def test_ctrl_c_is_one_line(said, capsys):
    def interrupted(arguments):
        raise KeyboardInterrupt(*filter(None, [said]))

    with pytest.raises(SystemExit) as stopped:
        Command(interrupted, Arguments, "")(["what=step"])
    assert stopped.value.code == 130 and capsys.readouterr().err == f"{said or 'interrupted'}\n"
