"""Memory: bytes of the buffers below objects."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import warp as wp


def buffer_bytes(*roots: object) -> int:
    """Bytes of all arrays of torch, NumPy and Warp that can be reached from the roots; what is shared counts once."""
    total, seen, spans = 0, set[int](), list[tuple[int, int]]()
    extents, left = [], list(roots)
    while left:
        thing = left.pop()
        if id(thing) in seen or isinstance(thing, torch.nn.Module | type):
            continue
        seen.add(id(thing))
        extent = _extent(thing)
        if extent is not None:
            extents.append(extent)
        else:
            left += _children(thing)
    for start, size in sorted(extents, key=lambda extent: -extent[1]):
        if size and not any(low <= start and start + size <= high for low, high in spans):
            spans.append((start, start + size))
            total += size
    return total


def _children(thing: object) -> list[object]:
    """What an object holds: a container, one of this package, or one of Warp's structs and meshes."""
    if isinstance(thing, dict):
        return list(thing.values())
    if isinstance(thing, list | tuple):
        return list(thing)
    kind: Any = type(thing)
    of_warp = any(base.__name__ in ("StructInstance", "Mesh") for base in kind.__mro__)
    ours = kind.__module__.startswith(("omnilidar.", "omniperception."))
    return list(vars(thing).values()) if hasattr(thing, "__dict__") and (of_warp or ours) else []


def _extent(thing: object) -> tuple[int, int] | None:
    """(address, bytes) of the memory that an array keeps alive; None for what is no array."""
    if isinstance(thing, torch.Tensor):
        storage = thing.untyped_storage()
        return storage.data_ptr(), storage.nbytes()
    if isinstance(thing, np.ndarray):
        while isinstance(thing.base, np.ndarray):
            thing = thing.base
        return thing.__array_interface__["data"][0], thing.nbytes
    return (thing.ptr or 0, thing.capacity) if isinstance(thing, wp.array) else None
