"""Command lines of this package as messages show them: they work where they are read."""

from __future__ import annotations

import shlex
import shutil
import sys
from pathlib import Path


def command_line(name: str, *words: object) -> str:
    """`omniperception <name> <words>` as a shell in the working directory takes it.

    Where the `omniperception` that the shell would find is not this environment's, as without `activate`, its Python
    stands in front.
    """
    python, here = Path(sys.executable), Path.cwd()
    found = shutil.which("omniperception")
    if found is not None and Path(found).parent == python.parent:
        program = ["omniperception"]
    else:
        program = [str(python.relative_to(here) if python.is_relative_to(here) else python), "-m", "omniperception"]
    return shlex.join([*program, name, *map(str, words)])
