"""Point clouds as .npz: an array for each column."""

import zlib
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from .table import PointTable, table_of

ABOUT = {"frame": "frame", "time_s": "stamp_s"}
"""What is said of the whole frame, and the name of its array."""


def read(path: Path) -> PointTable:
    """Every one-dimensional array of a file, as a column."""
    try:
        loaded = np.load(path)
        if not isinstance(loaded, np.lib.npyio.NpzFile):
            raise TypeError
        with loaded as file:
            arrays = {name: file[name] for name in file.files}
    except TypeError:
        raise ValueError(f"{path} holds a single array; an array for each column was expected") from None
    except (ValueError, EOFError, BadZipFile, NotImplementedError, OSError, zlib.error) as error:
        raise ValueError(f"{path} is broken, or no .npz file of numbers: save it again with np.savez") from error
    about = {key: arrays[name].item() for key, name in ABOUT.items() if name in arrays}
    return table_of({name: values for name, values in arrays.items() if values.ndim == 1}, **about)


def write(path: Path, table: PointTable) -> None:
    """Writes a compressed file."""
    about = {name: np.asarray(getattr(table, key)) for key, name in ABOUT.items()}
    np.savez_compressed(path, **{name: table.points[name] for name in table.names}, **about)  # type: ignore[arg-type]
