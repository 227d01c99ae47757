"""Obstacles at fixed or generated poses, and which obstacles take part in an episode."""

from __future__ import annotations

import torch

from omniperception.common.random import EnvRandom
from omniperception.scene.layouts import CorridorLayout, MazeLayout
from omniperception.scene.obstacles import ObstaclesConfig

LAYOUT_SEEDS = {"dev": 1, "test": 2}
"""Seeds of the layouts' worlds, by split."""


class Poses:
    """Obstacles at fixed poses, or as the worlds of layouts have them.

    Attributes:
        which: (O,) bool, those with fixed poses or in a layout.
        fixed: (O,) bool, those with fixed poses.
        any: whether there are some.
        world: (num_envs, L) int64, which world of each of the L layouts an environment has.
        routes: (W, R, 2) m, paths through the worlds; None: they have none.
        areas: (W, 4) x_low, x_high, y_low, y_high in m of the worlds of a layout of corridors; None without one.
    """

    def __init__(self, config: ObstaclesConfig, random: EnvRandom, like: torch.Tensor) -> None:
        """`like` has the precision and the device of positions. The layouts' worlds are made here."""
        obstacles = config.obstacles()
        self._random = random
        self.fixed = torch.tensor([o.pose is not None for o in obstacles], dtype=torch.bool, device=like.device)
        self.which = torch.tensor([o.group.has_poses for o in obstacles], dtype=torch.bool, device=like.device)
        self.any = any(o.group.has_poses for o in obstacles)
        poses = like.new_tensor([o.pose or (0.0, 0.0, 0.0) for o in obstacles])
        poses[:, 2] = torch.deg2rad(poses[:, 2])
        self._pose = poses
        self._layouts: list[tuple[int, torch.Tensor, slice, slice]] = []
        names, part_names = [own.name for own in obstacles], config.geom_names()
        self.areas: torch.Tensor | None = None
        self.routes: torch.Tensor | None = None
        self._area_of = 0  # the layout that has areas
        for name, group in config.groups.items():
            layout, seed = group.layout, LAYOUT_SEEDS[config.split]
            if layout is None:
                continue
            if isinstance(layout, CorridorLayout):
                self._area_of = len(self._layouts)
                self.areas = like.new_tensor(layout.areas(seed, layout.worlds))
            if isinstance(layout, MazeLayout) and config.route_end is not None:
                self.routes = like.new_tensor(layout.routes(seed, layout.worlds))
            table, count = like.new_tensor(layout.table(seed, layout.worlds)), group.count
            own, part = (among.index(f"obstacle_{name}_0") for among in (names, part_names))
            self._layouts.append((layout.worlds, table, slice(own, own + count), slice(part, part + count)))
        self.world = torch.zeros(len(like), len(self._layouts), dtype=torch.int64, device=like.device)

    def draw(self, env_ids: torch.Tensor, size: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Poses (n, O, 3), x and y in m and yaw in rad, of environments (n,), and which of them there are (n, O).

        The sizes (n, P, 3) of what layouts have are written into `size`.
        """
        pose = self._pose.expand(len(env_ids), -1, -1)
        there = self.which.expand(len(env_ids), -1)
        if not self._layouts:
            return pose, there
        pose, there = pose.clone(), there.clone()
        u = self._random.uniform(env_ids, (len(self._layouts),))
        for k, (worlds, table, own, parts) in enumerate(self._layouts):
            self.world[env_ids, k] = (u[:, k] * worlds).long()
            rows = table[self.world[env_ids, k]]
            there[:, own] = rows[..., 0].isfinite()
            pose[:, own] = rows[..., :3].nan_to_num(0.0)
            size[:, parts] = torch.where(there[:, own, None], rows[..., 3:], size[:, parts])
        return pose, there

    def areas_of(self, env_ids: torch.Tensor) -> torch.Tensor | None:
        """(n, 4) the areas of the worlds that environments (n,) have; None where worlds have none."""
        return None if self.areas is None else self.areas[self.world[env_ids, self._area_of]]


class Presence:
    """Who of the groups with `present` takes part in an episode."""

    def __init__(self, config: ObstaclesConfig, random: EnvRandom) -> None:
        self._random, self._groups, first = random, [], 0
        for group in config.groups.values():
            if group.present is not None:
                low, high = group.present
                self._groups.append((slice(first, first + group.count), low, high))
            first += group.count
        self._count = first

    def draw(self, env_ids: torch.Tensor) -> torch.Tensor | None:
        """(n, O) bool for environments (n,); None where all always take part."""
        if not self._groups:
            return None
        u = self._random.uniform(env_ids, (self._count + len(self._groups),))
        there = torch.ones(len(env_ids), self._count, dtype=torch.bool, device=u.device)
        for k, (own, low, high) in enumerate(self._groups):
            number = low + (u[:, self._count + k] * (high - low + 1)).long()
            rank = u[:, own].argsort(1).argsort(1)
            there[:, own] = rank < number[:, None]
        return there
