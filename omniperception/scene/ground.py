"""The height field that physics and rays share, as the environments see it: heights, tiles, origins."""

from __future__ import annotations

import math

import mujoco
import torch
import warp as wp

from omnilidar.launch import launch_over_envs, view
from omniperception.scene import ground_kernels as kernels
from omniperception.scene.height_field import EDGE
from omniperception.scene.map_terrain import MapTerrainConfig
from omniperception.scene.terrain import GROUND
from omniperception.scene.tiled_terrain import TiledTerrainConfig

_LOOKUPS_PER_THREAD = 4096
"""Heights per thread: looking up this many takes about 40 microseconds, which outweighs waking another thread."""
_REAL = {torch.float32: (wp.float32, wp.vec2), torch.float64: (wp.float64, wp.vec2d)}


class Ground:
    """Where each environment starts, and height of the ground in that environment's frame.

    The origin of an environment's frame is the middle of its tile, or one of a map's places to start, at the height of
    the ground there. A map has a row for each place and one column. The surface is
    the one that MuJoCo collides and rays hit: two triangles to a cell, divided from (row, col) to (row + 1, col + 1).

    Attributes:
        level: (num_envs,) int64 row of each environment's tile, 0 the easiest.
        column: (num_envs,) int64 column of its tile; environments are spread evenly over them.
        kinds: names of the kinds of tiles, by column.
    """

    def __init__(
        self,
        config: TiledTerrainConfig | MapTerrainConfig,
        model: mujoco.MjModel,
        pos_w: torch.Tensor,
        num_threads: int | None = None,
    ) -> None:
        """
        Args:
            config: the terrain that is in the model.
            model: the compiled model.
            pos_w: (num_envs, 3), the simulator's own position (m) of the ground's body; written here.
            num_threads: CPU threads that look up heights; None for all.
        """
        self.config, self.kinds, self._num_threads = config, config.column_kinds(), num_threads
        geom = model.geom(GROUND)
        field = int(geom.dataid[0])
        self._rows, self._cols = int(model.hfield_nrow[field]), int(model.hfield_ncol[field])
        first, scale = int(model.hfield_adr[field]), float(model.hfield_size[field, 2])
        data = torch.as_tensor(model.hfield_data[first : first + self._rows * self._cols]).double()
        device = pos_w.device
        self._heights = (data * scale + float(geom.pos[2])).float().to(device)
        self._half = torch.tensor(model.hfield_size[field, :2], dtype=pos_w.dtype, device=device)
        self._last = torch.tensor([self._cols - 2, self._rows - 2], device=device)
        self._pos_w, self._starts = pos_w, torch.as_tensor(config.starts(), device=device)
        num_envs = pos_w.shape[0]
        self.level = torch.zeros(num_envs, dtype=torch.int64, device=device)
        self.column = torch.arange(num_envs, device=device) * config.columns // num_envs
        self._middle = torch.zeros(num_envs, 2, dtype=torch.int64, device=device)
        self._middle_height = torch.zeros(num_envs, device=device)
        self._all_envs = torch.arange(num_envs, device=device)
        self._surface = self._as_struct()
        self.move(self._all_envs, self.level.clone())

    def move(self, env_ids: torch.Tensor, level: torch.Tensor) -> None:
        """Puts environments `env_ids` (n,) on the tiles of levels (n,) in their columns."""
        self.level[env_ids] = level
        middle = self._starts[self.column[env_ids], level]
        height = self._heights[middle[:, 1] * self._cols + middle[:, 0]]
        self._middle[env_ids] = middle
        self._middle_height[env_ids] = height
        self._pos_w[env_ids, :2] = self._half - middle * self.config.cell
        self._pos_w[env_ids, 2] = -height.to(self._pos_w.dtype)

    def height(self, xy_w: torch.Tensor, env_ids: torch.Tensor | None = None) -> torch.Tensor:
        """Heights (n, ...) in m of the ground below points (n, ..., 2) in the frames of `env_ids` (n,), or of all.

        Beyond its edge the terrain goes on as high as at the edge.
        """
        if not xy_w.numel():
            return xy_w.new_zeros(xy_w.shape[:-1])
        points = xy_w.reshape(len(xy_w), -1, 2)
        heights = points.new_empty(points.shape[:2])
        real, vec2 = _REAL[xy_w.dtype]
        ids = self._all_envs if env_ids is None else env_ids.contiguous()
        arrays = [view(ids, wp.int64), view(points, vec2), view(heights, real)]
        self.launch(kernels.heights_kernel(real), arrays, *points.shape[:2])
        return heights.reshape(xy_w.shape[:-1])

    def lift(self, path: torch.Tensor, above: torch.Tensor, there: torch.Tensor, elsewhere: float) -> None:
        """Puts bodies along a path onto the ground, in place.

        Args:
            path: (num_envs, T, B, 3) float64 or float32, m, in the environments' frames; its heights are written.
            above: (num_envs, B) likewise, m, of each body above the ground below it.
            there: (num_envs, B) bool, which bodies are there.
            elsewhere: height (m) of the others.
        """
        real, vec3 = (wp.float32, wp.vec3) if path.dtype == torch.float32 else (wp.float64, wp.vec3d)
        arrays = [view(above, real), view(there, wp.bool), elsewhere, view(path, vec3)]
        self.launch(kernels.lift_kernel(real), arrays, len(path), path.shape[1] * path.shape[2])

    def launch(self, kernel: wp.Kernel, inputs: list, num_envs: int, lookups: int) -> None:
        """Runs `kernel(env_offset, surface, *inputs)` of `ground_kernels` with `lookups` heights per environment."""
        threads = self._num_threads if num_envs * lookups > _LOOKUPS_PER_THREAD else 1
        launch_over_envs(kernel, num_envs, [self._surface, *inputs], self._heights.device, num_threads=threads)

    def highest(self, xy_w: torch.Tensor, radius: float, env_ids: torch.Tensor) -> torch.Tensor:
        """Heights (n,) in m of the highest grid point within a square of 2 `radius` (m) and the cells around it.

        Nothing of the surface within `radius` of the points (n, 2) is higher.
        """
        reach = math.ceil(radius / self.config.cell) + 1
        step = torch.arange(-reach, reach + 1, device=xy_w.device)
        window = torch.stack(torch.meshgrid(step, step, indexing="xy"), -1).flatten(0, 1)
        index = (xy_w / self.config.cell).round().long() + self._middle[env_ids]
        index = (index[:, None] + window).clamp(min=0).minimum(self._last + 1)
        highest = self._heights[index[..., 1] * self._cols + index[..., 0]].amax(1)
        return highest - self._middle_height[env_ids]

    def outside(self, xy_w: torch.Tensor) -> torch.Tensor:
        """(num_envs,) bool: which points (num_envs, 2) lie within EDGE of the terrain's outer edge, or beyond."""
        from_centre = (xy_w - self._pos_w[:, :2]).abs()
        return (from_centre > self._half - EDGE).any(1)

    def mean_level(self) -> float:
        return float(self.level.float().mean())

    def mean_level_by_kind(self) -> dict[str, float]:
        """Mean level of the environments in the columns of each kind that has any."""
        num_envs = self.column.bincount(minlength=len(self.kinds)).tolist()
        levels = self.column.bincount(self.level.double(), len(self.kinds)).tolist()
        sums = {kind: [0, 0.0] for kind in self.kinds}
        for kind, count, level in zip(self.kinds, num_envs, levels, strict=True):
            sums[kind] = [sums[kind][0] + count, sums[kind][1] + level]
        return {kind: level / count for kind, (count, level) in sums.items() if count}

    def state_dict(self) -> dict:
        """State that `load_state_dict` needs; the ground's position belongs to the simulator's state."""
        return {"level": self.level.clone()}

    def load_state_dict(self, state: dict) -> None:
        self.move(torch.arange(len(self.level), device=self.level.device), state["level"].to(self.level.device))

    def _as_struct(self) -> kernels.Surface:
        surface = kernels.Surface()
        surface.heights, surface.level = view(self._heights, wp.float32), view(self._middle_height, wp.float32)
        surface.middle = view(self._middle, wp.int64)
        surface.rows, surface.cols, surface.cell = self._rows, self._cols, wp.float64(self.config.cell)
        return surface
