"""Empty matplotlib figures, and a refusal at once where it is not installed."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from omnirobot.common.errors import UserError, naming

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class PlotsUnavailable(UserError, ImportError):
    """matplotlib is not installed."""


def check_figures() -> None:
    """Refuses at once what would fail after all is measured; imports nothing, since matplotlib's first import on a
    machine looks through its fonts for seconds.

    Raises:
        PlotsUnavailable: matplotlib is not installed.
    """
    if find_spec("matplotlib") is None:
        raise PlotsUnavailable("pictures need matplotlib: pip install matplotlib")


def new_figure(width: float, height: float) -> Figure:
    """A figure of a given size in inches that is drawn to a file only.

    Raises:
        PlotsUnavailable: matplotlib is not installed.
    """
    check_figures()
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def plain(text: str) -> str:
    """Text, such as a path, as it is: between two $ matplotlib would read a formula."""
    return text.replace("$", r"\$")


def save_figure(figure: Figure, path: Path, dpi: int = 110) -> None:
    """Draws a figure into a file.

    Raises:
        OSError: it cannot be written; the error names it.
    """
    with naming(path):
        figure.savefig(path, dpi=dpi)
