"""How far a training is: the console's line, and a file in its run directory."""

from __future__ import annotations

import json
import os
import shutil
import sys
from collections.abc import Mapping
from pathlib import Path

from omnirobot.common.files import write_whole

PROGRESS_FILE = "progress.json"
"""In the run directory: completed iterations, those at which training ends, and the newest rates."""

_CLEAR = "\r\x1b[K"
"""To the beginning of the terminal's line, which is emptied."""


class ProgressLine:
    """The newest line of a training: on a terminal in place of the one before, elsewhere a line each."""

    def __init__(self) -> None:
        self._in_place = sys.stdout.isatty()
        self._shown = False

    def show(self, text: str) -> None:
        """Prints the line; on a terminal as much of it as fits."""
        if not self._in_place:
            say(text)
            return
        width = shutil.get_terminal_size().columns
        say(_CLEAR + (text if len(text) < width else f"{text[: width - 2]}…"), end="")
        self._shown = True

    def end(self) -> None:
        """Leaves the line as it is, so that what is printed next has one of its own."""
        if self._shown:
            say("")
            self._shown = False


def say(text: str, end: str = "\n") -> None:
    """Prints; where nobody reads any more, a closed pipe or terminal, nothing is printed from then on."""
    try:
        print(text, end=end, flush=True)
    except OSError:
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115


def save_progress(run_dir: Path, iterations: int, total: int, rates: Mapping[str, float]) -> None:
    """Writes PROGRESS_FILE; whoever reads it meanwhile sees the old one or the new one."""
    line = json.dumps({"iterations": iterations, "total": total, "rates": rates}) + "\n"
    write_whole(run_dir / PROGRESS_FILE, line.encode())


def load_progress(run_dir: Path) -> dict | None:
    """What `save_progress` wrote; None where there is nothing, or nothing readable."""
    try:
        return dict(json.loads((run_dir / PROGRESS_FILE).read_text()))
    except (OSError, ValueError, TypeError):
        return None
