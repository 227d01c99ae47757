"""Downloads robots that presets name and this package does not ship: Unitree's Go1 and G1, for robot=go1 and robot=g1.

    robot-fetch
    robot-fetch wheel=mjlab-1.6.0-py3-none-any.whl      # a copy that is here already: no network is needed

They come from the wheel of mjlab 1.6.0 (Apache-2.0), which pip downloads without its dependencies and does not install;
its SHA-256 is checked. MJCF files, meshes and the licence are unpacked into $XDG_CACHE_HOME/omniperception/robots, or
~/.cache/omniperception/robots. Then: omniperception robot-check g1.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from omniperception.robots.fetch import MJLAB, fetch
from omnirobot.common.cli import Command, argument, refuse_arguments
from omnirobot.common.shell import command_line


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """The command's own arguments."""

    wheel: Path | None = argument(None, "a copy of the wheel; null: pip downloads it")
    again: bool = argument(False, "whether what is there already is written over")


def main(arguments: Arguments) -> None:
    """Fetches, and says what is where."""
    there = MJLAB.folder.is_dir() and not arguments.again
    if there:
        refuse_arguments(arguments, ("wheel",), f"{MJLAB.folder} is there already, and again=true writes over it")
    folder = MJLAB.folder if there else fetch(MJLAB, arguments.wheel)
    print(f"{'already there' if there else 'written'}: {folder} ({MJLAB.name} {MJLAB.version}, {MJLAB.licence})")
    for name in MJLAB.robots:
        print(f"next: {command_line('robot-check', name)}")


command = Command(main, Arguments, __doc__)
