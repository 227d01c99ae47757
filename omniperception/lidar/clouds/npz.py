"""Point clouds as .npz: an array for each column."""

from pathlib import Path

import numpy as np

from .table import PointTable, table_of

ABOUT = {"frame": "frame", "time_s": "stamp_s"}
"""What is said of the whole frame, and the name of its array."""


def read(path: Path) -> PointTable:
    """Every one-dimensional array of a file, as a column."""
    loaded = np.load(path)
    if not isinstance(loaded, np.lib.npyio.NpzFile):
        raise ValueError(f"{path} holds a single array; an array for each column was expected")
    with loaded as file:
        columns = {name: file[name] for name in file.files if file[name].ndim == 1}
        about = {key: file[name].item() for key, name in ABOUT.items() if name in file.files}
    return table_of(columns, **about)


def write(path: Path, table: PointTable) -> None:
    """Writes a compressed file."""
    about = {name: np.asarray(getattr(table, key)) for key, name in ABOUT.items()}
    np.savez_compressed(path, **{name: table.points[name] for name in table.names}, **about)  # type: ignore[arg-type]
