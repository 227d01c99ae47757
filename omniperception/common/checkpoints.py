"""Where a run keeps its checkpoints."""

from __future__ import annotations

import os
import re
from pathlib import Path

_NAME = re.compile(r"model_(\d+)\.pt")


def checkpoint_path(run_dir: str | os.PathLike, iteration: int) -> Path:
    """``run_dir/checkpoints/model_<iteration>.pt``; ``iteration`` is the number of completed iterations."""
    return Path(run_dir) / "checkpoints" / f"model_{iteration}.pt"


def list_checkpoints(run_dir: str | os.PathLike) -> list[Path]:
    """Complete checkpoints of a run, oldest first; half-written temporary files are not among them."""
    folder = Path(run_dir) / "checkpoints"
    found = [(int(match[1]), path) for path in folder.glob("model_*.pt") if (match := _NAME.fullmatch(path.name))]
    return [path for _, path in sorted(found)]
