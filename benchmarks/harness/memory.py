"""Memory: bytes of the buffers below objects, and of this process."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import torch
import warp as wp

_STATUS = Path("/proc/self/status")


def buffer_bytes(*roots: object) -> int:
    """Bytes of all torch tensors and Warp arrays that can be reached from ``roots``; what is shared counts once."""
    found: dict[int, int] = {}
    pending, seen = list(roots), set()
    while pending:
        item = pending.pop()
        if id(item) in seen or item is None or isinstance(item, str | bytes | int | float | type):
            continue
        seen.add(id(item))
        if isinstance(item, torch.Tensor):
            storage = item.untyped_storage()
            found[storage.data_ptr()] = max(found.get(storage.data_ptr(), 0), storage.nbytes())
        elif isinstance(item, wp.array):
            if item.ptr:
                found[item.ptr] = max(found.get(item.ptr, 0), item.capacity)
        elif isinstance(item, Mapping):
            pending.extend(item.values())
        elif isinstance(item, list | tuple | set | frozenset):
            pending.extend(item)
        else:
            pending.extend(_children(item))
    return sum(found.values())


def resident_bytes(peak: bool = False) -> int:
    """Bytes of this process in memory, now or at most; the most so far on systems without /proc."""
    if not _STATUS.is_file():
        import resource

        return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    key = "VmHWM:" if peak else "VmRSS:"
    line = next(line for line in _STATUS.read_text().splitlines() if line.startswith(key))
    return 1024 * int(line.split()[1])


def _children(item: object) -> list[object]:
    """What a dataclass, a Warp struct or mesh, or an object of the package holds."""
    if dataclasses.is_dataclass(item):
        return [getattr(item, field.name) for field in dataclasses.fields(item)]
    if isinstance(item, wp.Mesh):
        return [item.points, item.indices, item.velocities]
    is_struct = any(base.__name__ == "StructInstance" for base in type(item).__mro__)
    if is_struct or type(item).__module__.startswith("omniperception."):
        return list(getattr(item, "__dict__", {}).values())
    return []
