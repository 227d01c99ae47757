"""Files of which nobody sees a half."""

from __future__ import annotations

import os
from pathlib import Path


def write_whole(path: Path, content: bytes) -> None:
    """Writes a file; whoever reads it meanwhile, or after a stop, sees the old one or the new one."""
    half = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    half.write_bytes(content)
    os.replace(half, path)
