"""Errors that are for the user: one line that says what to change."""

from __future__ import annotations

import difflib
import errno
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

_OF_A_DISK = {
    "make room there, or write elsewhere": ("ENOSPC", "EDQUOT", "EFBIG"),
    "choose a place that you may read and write": ("EACCES", "EPERM", "EROFS"),
    "choose another place": ("ENOENT", "EEXIST", "ENOTDIR", "EISDIR", "ENAMETOOLONG", "ELOOP"),
}
"""What mends an error of a file system, by names of its number."""


class UserError(Exception):
    """An error whose message is one line for the user; a command ends with it and exit code 2."""


class ConfigError(UserError, ValueError):
    """A configuration that cannot run; the message is one line that says what to change."""


class DoesNotFit(ConfigError):
    """A configuration that has keys, names or kinds of values which this program does not know, or lacks some."""


class UnknownKey(DoesNotFit):
    """A key that nothing takes.

    Attributes:
        given: the override or key.
        known: the keys that could have been meant.
    """

    def __init__(self, given: str, known: Iterable[str], name: str = "") -> None:
        self.given, self.known = given, tuple(known)
        path = given.lstrip("+~").partition("=")[0]
        self.name = name or path.rpartition(".")[2]
        super().__init__(f"{given} is unknown; {suggest(self.name, self.known, path[: path.rfind(self.name)])}")


def suggest(name: str, known: Sequence[str], before: str = "", and_all: bool = False) -> str:
    """The known name that is most similar, with what stands before it; or all of them, or both."""
    near = difflib.get_close_matches(name, known, 1)
    hints = [f"did you mean {before}{near[0]}?"] if near else []
    if and_all or not near:
        hints.append(f"known: {', '.join(sorted(known))}")
    return " ".join(hints)


def check_known(key: str, names: Iterable[str], known: Sequence[str]) -> None:
    """Refuses names that are none of those that are known, with what they are given by.

    Raises:
        ConfigError: one is unknown.
    """
    for name in names:
        if name not in known:
            raise ConfigError(f"{key}={name} is unknown; {suggest(name, known)}")


def repeated(names: Sequence[str]) -> list[str]:
    """Those that are there more than once, sorted."""
    return sorted(name for name, count in Counter(names).items() if count > 1)


def one_line(error: BaseException) -> str:
    """The message of an error without line breaks."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return " ".join(lines) or type(error).__name__


def of_a_disk(error: OSError) -> str:
    """What a file system refuses, and what mends it; empty for errors of other kinds."""
    name = errno.errorcode.get(error.errno or 0)
    return next((f"{error.strerror}; {remedy}" for remedy, names in _OF_A_DISK.items() if name in names), "")


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Says in errors of the system which file is written: those of a full disk do not."""
    try:
        yield
    except OSError as error:
        error.filename = str(path)
        raise
