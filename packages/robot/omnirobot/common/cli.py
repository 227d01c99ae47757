"""Command lines: each command declares its own `key=value` arguments, and all are read and explained in one way.

    @dataclass(frozen=True, kw_only=True)
    class Arguments:
        what: str = argument(doc="what is timed", choices=("step", "iteration"))  # no default: must be given
        trials: int = argument(1000, "at least so many episodes", least=1)
        seconds: float = argument(0.1, "length of a frame (s)", positive=True)
        num_envs: int | None = argument(None, "environments at a time; as many as the trials need", least=1)
        variants: tuple[str, ...] = argument(("fps_mlp", "fps_gru"), "perception presets")
        out: Path = argument(Path("outputs/x"), "folder of what is written")

    def main(arguments: Arguments, overrides: list[str]) -> None:
        run = build.assemble(config.compose(overrides))

    command = Command(main, Arguments, __doc__, overrides="of the task")

    if __name__ == "__main__":
        command()

`trials=200 variants=fps_mlp,pd_risknet out=here num_envs=64` on the command line then gives
`Arguments(trials=200, variants=("fps_mlp", "pd_risknet"), out=Path("here"))` if `num_envs` is not an argument of the
command, and the overrides `["num_envs=64"]`. A command without `overrides` refuses them, and its `main` takes the
arguments alone. `--help` prints the documentation and every argument with its default. Wrong input ends with one line
on standard error and exit code 2; so does a ConfigError, and each of `errors`, that `main` raises. Ctrl-C ends with one
line, too, and exit code 130.
"""

from __future__ import annotations

import codecs
import dataclasses
import importlib
import io
import math
import os
import re
import select
import sys
import types
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omnirobot.common.errors import ConfigError, UnknownKey, UserError, of_a_disk, one_line

INTERRUPTED, UNREAD = 130, 141  # as of a shell: 128 + SIGINT, 128 + SIGPIPE
_SIMPLER, _SIGNS = "omniperception.simpler", {"–": "-", "…": "..."}

_COMMA = re.compile(r',(?=(?:[^"]*"[^"]*")*[^"]*$)')
"""A comma outside of double quotes."""
_KINDS = {int: "a whole number", float: "a number", bool: "true or false"}


PICTURES = (".png", ".pdf", ".svg")
"""Suffixes of pictures."""
RESULTS = (".json", ".json.gz")
"""Suffixes of files of results."""


def argument(
    default: Any = dataclasses.MISSING,
    doc: str = "",
    *,
    choices: Sequence[str] = (),
    least: float | None = None,
    positive: bool = False,
    suffixes: Sequence[str] = (),
) -> Any:
    """An argument of a command: a field of a frozen dataclass with str, int, float, bool, Path, or a tuple of these.

    Args:
        default: its value unless given; none: it must be given.
        doc: what it is, in one line.
        choices: the only values allowed, of each item of a tuple.
        least: the least value allowed.
        positive: whether it must be above 0.
        suffixes: one that a file that is written must end in; () where it is none or a folder.
    """
    limits = {"choices": tuple(choices), "least": least, "positive": positive, "suffixes": tuple(suffixes)}
    return dataclasses.field(default=default, metadata={"doc": doc, **limits})


def trust() -> Any:
    """The argument `trust` of commands that read a configuration, for `build.assemble(config, trust)`."""
    return argument((), "packages of your own that a configuration may name, such as own_project")


@dataclass(frozen=True)
class Command:
    """A function behind a command line.

    Attributes:
        main: called with the arguments and, where overrides are accepted, with the list of them.
        arguments: dataclass of `argument` fields.
        doc: help; its first line says what the command does.
        overrides: what other `key=value` arguments and `--config-dir` change, such as "of the run's configuration";
            empty: they are refused.
        errors: exceptions beside UserError whose message is for the user.
        flags: such as -m, that stay among the overrides, each with the words without '=' after it.
        first: argument that a first word without '=' gives, such as `file` of `robot-new FILE`; empty: none.
    """

    main: Callable[..., Any]
    arguments: type
    doc: str
    overrides: str = ""
    errors: tuple[type[Exception], ...] = ()
    flags: tuple[str, ...] = ()
    first: str = ""

    def __call__(self, argv: Sequence[str] | None = None, name: str | None = None) -> None:
        """Runs the command line `argv`, by default the process's."""
        with terminal():
            self._run(list(sys.argv[1:] if argv is None else argv), name)

    def _run(self, argv: list[str], name: str | None) -> None:
        if {"-h", "--help"} & set(argv):
            print(self.help(name or f"python {sys.argv[0]}"))
            return
        for_the_user: tuple[type[Exception], ...] = (UserError, *self.errors)
        try:
            arguments, overrides = self.parse(argv)
            self.main(arguments, overrides) if self.overrides else self.main(arguments)
        except UnknownKey as error:
            own = () if "." in error.given else [field.name for field in dataclasses.fields(self.arguments)]
            fail(UnknownKey(error.given, dict.fromkeys((*error.known, *own)), error.name))
        except for_the_user as error:
            fail(error)
        except KeyboardInterrupt as error:  # Ctrl-C
            print(str(error) or "interrupted", file=sys.stderr, flush=True)
            sys.exit(INTERRUPTED)

    def parse(self, argv: Sequence[str]) -> tuple[Any, list[str]]:
        """Arguments and overrides of a command line."""
        fields = {field.name: field for field in dataclasses.fields(self.arguments)}
        hints = typing.get_type_hints(self.arguments)
        given, keys, overrides, is_of_flag = {}, set(), [], False
        for k, text in enumerate(self._without_flags(argv)):
            if is_of_flag := text.startswith("-") or (is_of_flag and "=" not in text and not text.startswith("~")):
                overrides.append(text)
                continue
            if k == 0 and self.first and (Path(text).exists() or not ("=" in text or text.startswith("~"))):
                text = f"{self.first}={text}"
            key, separator, value = text.partition("=")
            if not separator and not text.startswith("~"):
                raise ConfigError(f"argument '{text}' is not of the form key=value")
            if key in keys:
                raise ConfigError(f"{key} is given twice")
            keys.add(key)
            if key in fields:
                given[key] = _value(fields[key], hints[key], value)
            elif self.overrides:
                overrides.append(text)
            else:
                raise UnknownKey(text, tuple(fields))
        for name, field in fields.items():
            if field.default is dataclasses.MISSING and name not in given:
                expected = f" one of {', '.join(field.metadata['choices'])}" if field.metadata["choices"] else ""
                raise ConfigError(f"{name}=... must be given:{expected or ' ' + field.metadata['doc']}")
        return self.arguments(**given), overrides

    def _without_flags(self, argv: Sequence[str]) -> list[str]:
        """Arguments of the form key=value; folders of `--config-dir DIR` as Hydra's search path."""
        words, rest, folders = iter(argv), [], []
        for word in words:
            flag, _, value = word.partition("=")
            if self.overrides and flag in ("--config-dir", "-cd"):
                folder = value or next(words, "")
                path = os.path.realpath(os.path.expanduser(folder))
                if not folder or not os.path.isdir(path):
                    raise ConfigError(f"{flag} {folder}: there is no such folder")
                folders.append("'file://{}'".format(path.replace("'", r"\'")))
            elif word.startswith("-") and flag not in self.flags:
                known = ["--help", *(["--config-dir DIR"] if self.overrides else []), *self.flags]
                raise ConfigError(f"{word} is unknown; known flags: {', '.join(known)}")
            else:
                rest.append(word)
        return [*rest, f"hydra.searchpath=[{','.join(folders)}]"] if folders else rest

    def help(self, name: str) -> str:
        """Text that `--help` prints."""
        fields = dataclasses.fields(self.arguments)
        first = f" {self.first.upper()}" if self.first else ""
        lines = [f"usage: {name}{first} [key=value ...]", "", self.doc.strip(), ""]
        shown = {field.name: f"{field.name}={_text(field.default)}" for field in fields}
        width = min(max((len(text) for text in shown.values()), default=0), 30)
        lines += ["arguments:"] if fields else []
        for field in fields:
            choices = f" ({', '.join(field.metadata['choices'])})" if field.metadata["choices"] else ""
            given = " (must be given)" if field.default is dataclasses.MISSING else ""
            lines.append(f"  {shown[field.name]:<{width}}  {field.metadata['doc']}{choices}{given}")
        if self.overrides:
            lines += [
                "",
                f"Any other key=value is an override {self.overrides} in Hydra's grammar, such as num_envs=64,",
                "obstacles=static, commands.lin_vel_x=[0,1], +key=value, ~key.",
                "--config-dir DIR adds a folder of presets of your own.",
            ]
        return "\n".join(lines)


@dataclass(frozen=True)
class Program:
    """A console script with commands, a module each that has a `command`.

    Attributes:
        name: what a person types; its distribution is called the same.
        commands: what each command does, by name.
        modules: where each one is.
        extras: extra of the distribution that brings a library, by the name of what is imported.
    """

    name: str
    commands: Mapping[str, str]
    modules: Mapping[str, str]
    extras: Mapping[str, str]

    def __call__(self, argv: Sequence[str] | None = None) -> None:
        """Runs `<name> <command> [key=value ...]`."""
        with terminal():
            self._run(list(sys.argv[1:] if argv is None else argv))

    def _run(self, argv: list[str]) -> None:
        name, *rest = argv or ["--help"]
        if name in ("-h", "--help"):
            width = max(map(len, self.commands))
            lines = (f"  {command:<{width}}  {what}" for command, what in self.commands.items())
            print("\n".join([f"usage: {self.name} <command> [key=value ...]", "", *lines, ""]))
            print(f"{self.name} <command> --help explains a command.")
            return
        if name not in self.commands:
            fail(ConfigError(f"{name} is unknown; known: {', '.join(self.commands)}"))
        try:
            importlib.import_module(self.modules[name]).command(rest, f"{self.name} {name}")
        except ModuleNotFoundError as error:
            library = (error.name or "").partition(".")[0]
            if library not in self.extras:
                raise
            fail(ConfigError(f"{name} needs {library}: pip install '{self.name}[{self.extras[library]}]'"))


@contextmanager
def terminal() -> Iterator[None]:
    """Prints to whatever reads it: signs that a terminal lacks become others, and where nobody reads any more, as in a
    pipe into head, the process ends without a word. What a disk refuses is one line."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors=_SIMPLER)
    try:
        try:
            yield
        finally:
            if sys.stdout is not None:  # as with >&-
                sys.stdout.flush()
    except UnicodeEncodeError as error:
        if error.reason != "surrogates not allowed":
            raise
        fail(ConfigError(f"{error.object!a}: a name that is not UTF-8, which not every library takes; rename it"))
    except OSError as error:
        closed = [stream for stream in (sys.stdout, sys.stderr) if stream is not None and _is_closed(stream)]
        for stream in closed:  # Python would try, and complain, once more at its end
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
        if closed and isinstance(error, BrokenPipeError):
            sys.exit(UNREAD)
        if not (refused := of_a_disk(error)):
            raise
        fail(OSError(f"{os.fsdecode(error.filename or 'a file, or what is printed')}: {refused}"))


def _is_closed(stream: typing.TextIO) -> bool:
    """Tell whether nobody reads what is printed, or it cannot be written."""
    poll = select.poll()
    try:
        poll.register(stream.fileno(), 0)
        stream.flush()
    except io.UnsupportedOperation:  # it is kept in memory
        return False
    except OSError:
        return True
    return bool(poll.poll(0))


def _simpler(error: UnicodeError) -> tuple[str, int]:
    """Signs in place of those that an encoding lacks."""
    assert isinstance(error, UnicodeEncodeError)
    return "".join(_SIGNS.get(sign, ascii(sign)[1:-1]) for sign in error.object[error.start : error.end]), error.end


codecs.register_error(_SIMPLER, _simpler)


def refuse_overrides(overrides: Sequence[str], own: Mapping[str, object]) -> None:
    """Raises a ConfigError where an override changes what the command sets itself; own: these values by key."""
    for override in overrides:
        key = override.partition("=")[0].lstrip("+~")
        if key in own:
            raise ConfigError(f"{override}: this command sets {key}={own[key]} itself; leave it out")


def refuse_arguments(arguments: Any, names: Iterable[str], why: str) -> None:
    """Raises a ConfigError where one of these arguments is not its default; why: it would mean nothing."""
    for field in dataclasses.fields(arguments):
        if field.name in names and getattr(arguments, field.name) != field.default:
            raise ConfigError(f"{field.name}= would mean nothing: {why}; leave it out")


def fail(error: BaseException) -> typing.NoReturn:
    """Ends the process with one line on standard error and exit code 2."""
    print(f"error: {one_line(error)}", file=sys.stderr, flush=True)
    sys.exit(2)


def _value(field: dataclasses.Field, hint: Any, text: str) -> Any:
    """The value of `name=text`."""
    if not text:
        raise ConfigError(f"{field.name}= is empty; it is {field.metadata['doc']}")
    if isinstance(hint, types.UnionType):
        (hint,) = (part for part in hint.__args__ if part is not types.NoneType)
        if text == "null":
            return None
    if typing.get_origin(hint) is not tuple:
        return _single(field, hint, text)
    if hint.__args__[0] is Path and Path(text).exists():
        return (Path(text),)  # one whose name has commas, too
    parts = _COMMA.split(text[1:-1] if text[0] + text[-1] == "[]" else text)
    values = tuple(_single(field, hint.__args__[0], part.strip(), ", or several with commas between") for part in parts)
    if hint.__args__[0] in (str, Path) and len(set(values)) < len(values):
        raise ConfigError(f"{field.name}={text} names one twice")
    return values


def _single(field: dataclasses.Field, kind: type, text: str, several: str = "") -> Any:
    limits = field.metadata
    if len(text) > 1 and text[0] == text[-1] and text[0] in "'\"":  # as Hydra's grammar has text
        text = text[1:-1]
    if limits["choices"] and text not in limits["choices"]:
        raise ConfigError(f"{field.name}={text} must be one of {', '.join(limits['choices'])}")
    if limits["suffixes"] and (not text.endswith(limits["suffixes"]) or Path(text).is_dir()):
        raise ConfigError(f"{field.name}={text} must be a file that ends in {' or '.join(limits['suffixes'])}")
    if kind is bool:
        if text not in ("true", "false"):
            raise ConfigError(f"{field.name}={text} must be true or false")
        return text == "true"
    if kind not in (int, float):
        return Path(os.path.expanduser(text)) if kind is Path else kind(text)
    bound = " above 0" if limits["positive"] else f" >= {limits['least']:g}" if limits["least"] is not None else ""
    try:
        value = kind(text)
        inside = (not limits["positive"] or value > 0) and (limits["least"] is None or value >= limits["least"])
        if not (inside and math.isfinite(value)):
            raise ValueError
    except ValueError:
        raise ConfigError(f"{field.name}={text} must be {_KINDS[kind]}{bound}{several}") from None
    return value


def _text(value: Any) -> str:
    """A default as it would be given."""
    if value is dataclasses.MISSING or value == ():
        return "..."
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    return ",".join(map(str, value)) if isinstance(value, tuple) else str(value)
