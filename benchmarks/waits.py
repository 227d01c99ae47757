"""Finds where code would make the host wait for a GPU, on a machine without one."""

from __future__ import annotations

import traceback
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

import omniperception

_PACKAGE = Path(omniperception.__file__).resolve().parent
_READS = {"item", "tolist", "cpu", "numpy", "__array__", "__bool__", "__int__", "__float__", "__index__"}
"""Methods that need a tensor's numbers on the host."""
_SENDS = {"tensor", "as_tensor", "new_tensor", "from_numpy"}
"""Functions that copy numbers of the host to the device, for which PyTorch waits as well."""
_COUNTS = {
    "nonzero",
    "_local_scalar_dense",
    "is_nonzero",
    "equal",
    "bincount",
    "masked_select",
    "_unique2",
    "unique_dim",
    "unique_consecutive",
    "repeat_interleave.Tensor",
}
"""Operators whose result has a size, or is a number, that the host has to know."""
_INDEXED = {"index", "index_put", "index_put_", "_index_put_impl_"}
"""Operators that count the elements of a mask, if their index is one."""


class _Calls(TorchFunctionMode):
    def __init__(self, found: Counter) -> None:
        super().__init__()
        self._found = found

    def __torch_function__(self, func, types, args=(), kwargs=None):
        name = getattr(func, "__name__", "")
        sends = name in _SENDS and not (name == "as_tensor" and args and isinstance(args[0], torch.Tensor))
        if name in _READS or sends:
            self._found[name, _place()] += 1
        return func(*args, **(kwargs or {}))


class _Operators(TorchDispatchMode):
    def __init__(self, found: Counter) -> None:
        super().__init__()
        self._found = found

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        _, _, name = str(func).partition(".")
        kind = name.partition(".")[0]
        by_mask = kind in _INDEXED and any(i is not None and i.dtype == torch.bool for i in args[1])
        if kind in _COUNTS or name in _COUNTS or by_mask:
            self._found[kind, _place()] += 1
        self._found.operators += 1
        return func(*args, **(kwargs or {}))


class Waits(Counter):
    """How often each (operation, place) would have waited.

    Attributes:
        operators: PyTorch's operators that were called; each is a launch or less.
    """

    operators = 0

    def places(self) -> dict[str, int]:
        """Times by place."""
        places: Counter[str] = Counter()
        for (_, place), times in self.items():
            places[place] += times
        return dict(places)


@contextmanager
def find_waits() -> Iterator[Waits]:
    """Runs the block and notes every operation of PyTorch for which the host would wait on a GPU."""
    found = Waits()
    with _Calls(found), _Operators(found):
        yield found


def _place() -> str:
    """File and line of the package from which PyTorch was called."""
    for frame in reversed(traceback.extract_stack()):
        path = Path(frame.filename)
        if path.is_relative_to(_PACKAGE) and path.name != "waits.py":
            return f"{path.relative_to(_PACKAGE.parent)}:{frame.lineno}"
    return "elsewhere"
