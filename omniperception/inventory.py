"""What hangs on a run's objects: every array and every recorded launch, found by looking, not by asking a flag."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from tensordict import TensorDictBase

_ENTERED = ("omniperception.", "mujoco.batch", "mujoco_warp.", "rsl_rl.storage")
"""Objects of these modules are looked into, and so are dicts, lists and Warp's structs; networks and others are not."""


@dataclass(frozen=True)
class Buffer:
    """Memory that a run holds.

    Attributes:
        name: where it hangs, such as "env.sensing.frames".
        shape: as allocated.
        num_bytes: altogether.
        per_env: whether it grows with the number of environments.
    """

    name: str
    shape: tuple[int, ...]
    num_bytes: int
    per_env: bool


def walk(roots: Mapping[str, object]) -> Iterator[tuple[str, object]]:
    """Arrays of torch, NumPy and Warp and `SplitLaunch`es below the roots, each once, by where they hang."""
    seen: set[int] = set()
    left = list(reversed(roots.items()))
    while left:
        path, thing = left.pop()
        if id(thing) in seen or isinstance(thing, torch.nn.Module | type):
            continue
        seen.add(id(thing))
        if is_array(thing) or is_launch(thing):
            yield path, thing
        else:
            left += reversed([(f"{path}.{name}", child) for name, child in _children(thing)])


def is_array(thing: object) -> bool:
    """Whether it is an array of torch, NumPy or, where that is loaded, Warp."""
    warp = sys.modules.get("warp")
    return isinstance(thing, torch.Tensor | np.ndarray) or (warp is not None and isinstance(thing, warp.array))


def is_launch(thing: object) -> bool:
    """Whether it is a recorded launch of a kernel."""
    module = sys.modules.get("omniperception.lidar.launch")
    return module is not None and isinstance(thing, module.SplitLaunch)


def buffers_of(things: Mapping[str, object], num_envs: int) -> list[Buffer]:
    """The memory of arrays by name; one that lies within another's is not counted again.

    An array is taken to grow with the environments if one of its first two dimensions is `num_envs`.
    """
    arrays = [(name, thing, *_extent(thing)) for name, thing in things.items() if is_array(thing)]
    buffers, spans = [], []
    for name, array, start, size in sorted(arrays, key=lambda item: -item[3]):
        if size == 0 or any(low <= start and start + size <= high for low, high in spans):
            continue
        spans.append((start, start + size))
        shape = tuple(int(n) for n in array.shape)
        buffers.append(Buffer(name, shape, size, num_envs in shape[:2]))
    return buffers


def _children(thing: object) -> Iterable[tuple[object, object]]:
    if isinstance(thing, dict | TensorDictBase):
        return list(thing.items())
    if isinstance(thing, list | tuple):
        return list(enumerate(thing))
    if type(thing).__name__ == "StructInstance":  # of Warp
        return [(name, getattr(thing, name)) for name in type(thing)._cls.vars]
    if type(thing).__module__.startswith(_ENTERED) and hasattr(thing, "__dict__"):
        return list(vars(thing).items())
    return []


def _extent(array) -> tuple[int, int]:
    """(address, bytes) of the memory that an array keeps alive."""
    if isinstance(array, torch.Tensor):
        storage = array.untyped_storage()
        return storage.data_ptr(), storage.nbytes()
    if isinstance(array, np.ndarray):
        while isinstance(array.base, np.ndarray):
            array = array.base
        return array.__array_interface__["data"][0], array.nbytes
    return array.ptr or 0, array.capacity
