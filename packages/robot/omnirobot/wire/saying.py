"""Lines to the terminal from loops that must not wait for it."""

from __future__ import annotations

import contextlib
import io
import select
import sys


def say(text: str) -> None:
    """A line on standard error, or nothing where that is gone or stopped."""
    with contextlib.suppress(OSError):
        if _takes():
            print(text, file=sys.stderr, flush=True)


def _takes() -> bool:
    try:
        return bool(select.select([], [sys.stderr], [], 0.0)[1])
    except io.UnsupportedOperation:  # held in memory
        return True
