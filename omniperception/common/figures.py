"""Empty matplotlib figures, and a refusal at once where it is not installed."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from omniperception.common.errors import naming

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class PlotsUnavailable(ImportError):
    """matplotlib is not installed."""


def new_figure(width: float, height: float) -> Figure:
    """A figure of a given size in inches that is drawn to a file only.

    Raises:
        PlotsUnavailable: matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise PlotsUnavailable("pictures need matplotlib: pip install 'omniperception[plots]'") from None
    return Figure(figsize=(width, height), layout="constrained")


def save_figure(figure: Figure, path: Path, dpi: int = 110) -> None:
    """Draws a figure into a file.

    Raises:
        OSError: it cannot be written; the error names it.
    """
    with naming(path):
        figure.savefig(path, dpi=dpi)
