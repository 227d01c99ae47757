"""Where robots lie that are downloaded, not shipped: `omniperception robot-fetch` puts them there."""

from __future__ import annotations

import os
from pathlib import Path

from omnirobot.common.shell import command_line

SCHEME = "fetched:"
"""Begins the `robot.file` of a robot that is downloaded; the rest is its place in the cache."""


def cache() -> Path:
    """Folder of downloaded robots: in `$XDG_CACHE_HOME`, or in ~/.cache."""
    return Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")) / "omniperception" / "robots"


def fetched(file: str) -> Path:
    """The file of a downloaded robot.

    Args:
        file: SCHEME and its place in the cache.

    Raises:
        ValueError: it is not there.
    """
    path = cache() / file.removeprefix(SCHEME)
    if not path.is_file():
        raise ValueError(
            f"robot.file={file} is downloaded, not shipped, and is not in {cache()}; run: {command_line('robot-fetch')}"
        )
    return path
