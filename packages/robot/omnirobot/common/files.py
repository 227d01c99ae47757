"""Files that several processes read and write."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from omnirobot.common.errors import naming


def write_whole(path: Path, content: str | bytes | memoryview, durable: bool = False) -> None:
    """Writes a file; whoever reads it meanwhile, or after a stop, sees the old one or the new one.

    Args:
        path: of the file.
        content: its bytes, or its text.
        durable: whether it is on the disk, its name included, when this returns.

    Raises:
        OSError: it cannot be written; the error names it, and the old one stays.
    """
    half = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with naming(path):
            with open(half, "wb") as file:
                file.write(content.encode() if isinstance(content, str) else content)
                if durable:
                    file.flush()
                    os.fsync(file.fileno())
            os.replace(half, path)
    finally:
        half.unlink(missing_ok=True)
    if durable:
        _sync(path.parent)


def _sync(folder: Path) -> None:
    """Makes a rename durable."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


@contextmanager
def lock(folder: Path) -> Iterator[None]:
    """Keeps other processes that ask for the same folder waiting, so that none loses what another writes there."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


@contextmanager
def try_lock(folder: Path) -> Iterator[bool]:
    """Holds a folder, and says whether no other process does; it is let go when this ends, or the process dies.

    On a file system without locks nobody is kept off.
    """
    handle = os.open(folder, os.O_RDONLY)
    try:
        yield _locked(handle)
    finally:
        os.close(handle)


def _locked(handle: int) -> bool:
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # this file system has no locks
        pass
    return True
