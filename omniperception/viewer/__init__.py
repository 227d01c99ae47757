"""The live viewer: a page that shows a task while it runs, and takes hold of it. The page needs the extra `viewer`.

`serve` shows a run and returns when it is stopped; `serve_lab` shows sensors in a room. Nothing else in the package
knows of the viewer: it reads tasks by what they offer to everybody.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from omniperception.viewer.options import PageOptions, Room, Shown, ViewerError

if TYPE_CHECKING:
    from omniperception.env.sensing import SensorConfig

__all__ = ["PageOptions", "Room", "Shown", "ViewerError", "serve", "serve_lab"]


def serve(shown: Shown, options: PageOptions | None = None) -> None:
    """Shows a run in the browser until Ctrl-C.

    Args:
        shown: which run, where.
        options: where the page listens, and until when.

    Raises:
        ViewerError: the page cannot be opened, or a library is missing.
        ConfigError, CheckpointError: the run cannot be shown.
    """
    with libraries():
        from omniperception.viewer.viewer import Viewer

        viewer = Viewer(shown, options or PageOptions())
    try:
        viewer.run()
    finally:
        viewer.close()


def serve_lab(
    room: Room, sensors: Mapping[str, Callable[[], SensorConfig]], out: Path, options: PageOptions | None = None
) -> None:
    """Shows sensors in a room in the browser until Ctrl-C.

    Args:
        room: where.
        sensors: makers of the sensors by name, the first one is shown first.
        out: folder that clouds are written to.
        options: where the page listens, and until when.

    Raises:
        ViewerError: the page cannot be opened, or a library is missing.
        ConfigError: the first sensor cannot be had.
    """
    with libraries():
        from omniperception.viewer.lab import Lab

        lab = Lab(room, sensors, out, options or PageOptions())
    try:
        lab.run()
    finally:
        lab.close()


@contextmanager
def libraries() -> Iterator[None]:
    """Turns a missing library of the extra `viewer` into one line, before a task is built."""
    try:
        importlib.import_module("viser")
        yield
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] not in ("viser", "trimesh", "rich"):
            raise
        raise ViewerError(f"viewer=web needs {error.name}: pip install 'omniperception[viewer]'") from None
