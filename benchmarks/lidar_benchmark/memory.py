"""Bytes of the buffers that a sensor and its scene hold."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import replace

import torch
import warp as wp

from .ours import Ours
from .scenes import BenchmarkScene


def buffer_bytes(*roots: object) -> int:
    """Bytes of all torch tensors and Warp arrays that can be reached from ``roots``; what is shared counts once."""
    found: dict[int, int] = {}
    _collect(list(roots), found, set())
    return sum(found.values())


def buffer_sizes(scene: BenchmarkScene, **features) -> tuple[int, int]:
    """Bytes that each further environment adds to our buffers, and bytes that all of them share.

    Shared are the scan's table, the shapes, and the trees of meshes.
    """
    sizes = []
    for num_envs in (1, 2):
        ours = Ours(repeat_environment(scene, num_envs), 1, "cpu", **features)
        sizes.append(buffer_bytes(ours.rays, ours.lidar))
    each = sizes[1] - sizes[0]
    return each, sizes[0] - each


def repeat_environment(scene: BenchmarkScene, num_envs: int) -> BenchmarkScene:
    """A scene's first environment several times."""
    first = scene.environments(0, 1)
    return replace(
        first,
        positions=first.positions.repeat(num_envs, axis=1),
        quats=first.quats.repeat(num_envs, axis=1),
        sensor_pos=first.sensor_pos.repeat(num_envs, axis=1),
        sensor_quat=first.sensor_quat.repeat(num_envs, axis=1),
        scan=replace(first.scan, phase_rows=first.scan.phase_rows.repeat(num_envs)),
    )


def _collect(pending: list[object], found: dict[int, int], seen: set[int]) -> None:
    while pending:
        item = pending.pop()
        if id(item) in seen or item is None or isinstance(item, (str, bytes, int, float, type)):
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
        elif isinstance(item, (list, tuple, set, frozenset)):
            pending.extend(item)
        else:
            pending.extend(_parts(item))


def _parts(item: object) -> list[object]:
    """What a dataclass, a Warp struct or mesh, or an object of this package holds."""
    if dataclasses.is_dataclass(item):
        return [getattr(item, field.name) for field in dataclasses.fields(item)]
    if isinstance(item, wp.Mesh):
        return [item.points, item.indices, item.velocities]
    is_struct = any(base.__name__ == "StructInstance" for base in type(item).__mro__)
    if is_struct or type(item).__module__.startswith("omniperception."):
        return list(getattr(item, "__dict__", {}).values())
    return []
