"""Scenes that no training sees: the same arrangement with obstacles of other kinds and sizes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

from omniperception.scene.obstacle_group import COMPOUND, ApproachConfig, ObstacleGroup
from omniperception.scene.obstacles import ObstaclesConfig

SMALLER, LARGER = (0.75, 1.0), (1.0, 1.3)
"""Factors on the low end of a range of sizes, and on its high end: what is drawn lies outside of the range itself."""
VARIANTS = 3
"""Meshes of fixed sizes for each that takes part; which ones is drawn in each episode."""
_ELONGATED = 3.0
"""Ratio of a box's sides seen from above from which on it becomes a wedge, below a hexagonal prism."""

Sizes = tuple[tuple[float, float], ...]


def held_out(config: ObstaclesConfig) -> ObstaclesConfig:
    """The scene with held-out obstacles in place of its own, as many, placed and moving by the same rules.

    Half of a group (of an odd number the larger half) is of another kind: cylinders become capsules (flat ones
    hexagonal prisms), boxes wedges and hexagonal prisms, spheres rocks; the other half keeps its kind. Either half is
    divided into smaller ones, with sizes in [0.75 low, low] of the group's ranges [low, high], and larger ones, in
    [high, 1.3 high]. Capsules, meshes and compounds keep their kind, which no training scene has. A range of `present`
    keeps its ends, and each part draws a number of its own. Groups with fixed poses, which are the bounds of a scene,
    and layouts stay as they are; a layout's worlds differ by `split`.
    """
    groups: dict[str, ObstacleGroup] = {}
    for index, (name, group) in enumerate(config.groups.items()):
        groups |= {name: group} if group.has_poses else _others(name, group, index % 2 == 0, config.clearance)
    return replace(config, groups=groups)


def _others(name: str, group: ObstacleGroup, larger_first: bool, clearance: float) -> Mapping[str, ObstacleGroup]:
    """Held-out groups in place of one; of an odd number of obstacles there is one larger one more, or one smaller."""
    new = (group.count + 1) // 2 if group.kind in ("box", "cylinder", "sphere") else 0
    if group.files:
        raise ValueError(
            f"obstacles: {name} has files={list(group.files)}, of which there are no held-out ones; use split=dev"
        )
    if group.kind == COMPOUND and any(part.kind == "mesh" for part in group.parts_of(0).values()):
        raise ValueError(
            f"obstacles: {name} has a mesh among its parts, whose size cannot vary, so there are no held-out ones; use"
            " split=dev"
        )
    sorts = []
    for count, changes in ((new, True), (group.count - new, False)):
        first, larger_now = (count + 1) // 2, larger_first == changes
        sorts += [(first, changes, larger_now), (count - first, changes, not larger_now)]
    found, present = {}, _present([number for number, _, _ in sorts], group.present)
    for (number, changes, larger), bounds in zip(sorts, present, strict=True):
        if number:
            other = _one(replace(group, count=number, present=bounds), changes, larger)
            kind = other.file or other.kind
            found[f"{name}_{'larger' if larger else 'smaller'}_{kind}"] = _kept_off(other, clearance)
    return found


def _present(counts: Sequence[int], present: Sequence[int] | None) -> list[tuple[int, int] | None]:
    """Ranges of how many take part of parts of a group with these counts, whose ends add up to those of the group's."""
    if present is None:
        return [None] * len(counts)
    highs = _apportioned(present[1], counts)
    return list(zip(_apportioned(present[0], highs), highs, strict=True))


def _apportioned(total: int, weights: Sequence[int]) -> list[int]:
    """Whole numbers nearly in proportion to weights whose sum is at least `total`; none is above its weight."""
    whole = max(sum(weights), 1)
    ends = [(2 * total * sum(weights[:k]) + whole) // (2 * whole) for k in range(len(weights) + 1)]
    return [end - begin for begin, end in pairwise(ends)]


def _one(group: ObstacleGroup, changes: bool, larger: bool) -> ObstacleGroup:
    """Obstacles in the place of a group's."""
    count, present = group.count, group.present
    if group.kind == COMPOUND:
        return replace(group, scale=_stretched((group.scale,), larger)[0])
    size = _stretched(group.sizes_of(0) if group.file and not group.size else group.size, larger)
    if not changes:
        return replace(group, size=size)
    kind, file, size = _other_kind(group.kind, size)
    if file is not None:
        present = present or (count, count)
        count *= VARIANTS
    return replace(group, kind=kind, file=file, size=size, count=count, present=present)


def _stretched(ranges: Sequence[Sequence[float]], larger: bool) -> Sizes:
    """Ranges beyond their high ends, or below their low ends."""
    if larger:
        return tuple((LARGER[0] * high, LARGER[1] * high) for _, high in ranges)
    return tuple((SMALLER[0] * low, SMALLER[1] * low) for low, _ in ranges)


def _other_kind(kind: str, size: Sizes) -> tuple[str, str | None, Sizes]:
    """Another kind that fills about the same space: kind, file and sizes."""
    if kind == "sphere":
        return "mesh", "rock", size * 3
    if kind == "cylinder":
        (r_low, r_high), (h_low, h_high) = size
        if h_low > r_low and h_high > r_high:
            return "capsule", None, (size[0], (h_low - r_low, h_high - r_high))
        return "mesh", "hexagon", (size[0], size[0], size[1])
    x, y = size[0][1], size[1][1]
    return "mesh", "wedge" if max(x, y) > _ELONGATED * min(x, y) else "hexagon", size


def _kept_off(group: ObstacleGroup, clearance: float) -> ObstacleGroup:
    """The group, whose larger obstacles do not come into being on the robot either."""
    if group.approach is None:
        return group
    least = clearance + group.largest_radius
    low, high = (max(bound, least) for bound in group.approach.distance)
    return replace(group, approach=ApproachConfig(group.approach.within, (low, high)))
