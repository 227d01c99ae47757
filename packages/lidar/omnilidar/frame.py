"""One scan of every environment, as tensors; to and from files of points."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch

from .clouds import PointTable, read_points, table_of, write_points


@dataclass(frozen=True, repr=False)
class LidarFrame:
    """One scan of every environment. The tensors are the sensor's own and are overwritten by the next cast.

    A field that was not asked for is None: it is neither computed nor stored. Noise disturbs ``ranges``, and with it
    ``valid`` and the points; everything else describes the surface that the ray really hit.

    Attributes:
        ranges: Measured distance along each ray with noise, metres, ``inf`` for a miss, (num_envs, N).
        true_ranges: The same without noise; the very tensor ``ranges`` when no noise is configured.
        valid: Whether the ray measured a distance, (num_envs, N) bool.
        points_s: Measured points in the sensor's frame, metres, NaN for a miss, (num_envs, N, 3).
        points_b: The same in the frame of the body that carries the sensor, (num_envs, N, 3). With motion
            distortion, each point is in the sensor's and the body's frame at its own time, as a device reports it.
        points_w: The same in the environment's frame, from the sensor's pose at each point's time, (num_envs, N, 3).
        normals_w: Outward unit normal of the surface in the environment's frame, zero for a miss, (num_envs, N, 3).
        incidence: Angle between the ray and the surface's normal, rad in [0, pi/2], NaN for a miss, (num_envs, N).
        intensity: reflectivity * cos(incidence) * (reference_range / true range)^2, Lambert's law for a beam that the
            surface catches whole; 1 is a white wall seen perpendicularly at ``config.reference_range``, 0 a miss,
            (num_envs, N).
        body_id: Body that carries the shape that was hit, -1 for a fixed shape, -2 for a miss, (num_envs, N) int32.
        shape_id: Index of that shape, -1 for a miss, (num_envs, N) int32.
        class_id: Class of that shape, -1 for a miss, (num_envs, N) int32.
        time_s: When each ray was emitted after the frame's start at ``time_s - period_s``, s, (num_envs, N).
        directions_s: Unit direction of each ray in the sensor frame, (num_envs, N, 3).
        elevation: Angle theta of each ray in the sensor frame, rad, (num_envs, N).
        azimuth: Angle phi of each ray in the sensor frame, rad in [0, 2 pi), (num_envs, N).
        row: Row of the scan pattern, (num_envs, N) int32.
    """

    ranges: torch.Tensor | None = None
    true_ranges: torch.Tensor | None = None
    valid: torch.Tensor | None = None
    points_s: torch.Tensor | None = None
    points_b: torch.Tensor | None = None
    points_w: torch.Tensor | None = None
    normals_w: torch.Tensor | None = None
    incidence: torch.Tensor | None = None
    intensity: torch.Tensor | None = None
    body_id: torch.Tensor | None = None
    shape_id: torch.Tensor | None = None
    class_id: torch.Tensor | None = None
    time_s: torch.Tensor | None = None
    directions_s: torch.Tensor | None = None
    elevation: torch.Tensor | None = None
    azimuth: torch.Tensor | None = None
    row: torch.Tensor | None = None

    @property
    def num_envs(self) -> int:
        """Environments of which there is a scan."""
        return self._any().shape[0]

    @property
    def num_rays(self) -> int:
        """Rays of each environment."""
        return self._any().shape[1]

    def __repr__(self) -> str:
        given = [name for name in OUTPUTS if getattr(self, name) is not None]
        if not given:
            return "LidarFrame of nothing"
        size = (
            f"{self.num_envs:,} environment{'s' * (self.num_envs > 1)} x {self.num_rays:,} rays on {self._any().device}"
        )
        return f"LidarFrame: {size}{self._reach()}; {', '.join(given)}"

    def _any(self) -> torch.Tensor:
        return next(tensor for name in OUTPUTS if (tensor := getattr(self, name)) is not None)

    def _reach(self) -> str:
        """Share of the rays that hit, and how far, where that is known."""
        hit = self._hits()
        if hit is None:
            return ""
        share = f", {100.0 * hit.float().mean().item():.1f} % hit"
        if self.ranges is None or not hit.any():
            return share
        near, far = (f(self.ranges[hit]).item() for f in (torch.min, torch.max))
        return f"{share}, {near:.2f} to {far:.2f} m"

    def _hits(self) -> torch.Tensor | None:
        if self.valid is not None:
            return self.valid
        if self.ranges is not None:
            return self.ranges.isfinite()
        points = next((p for name in POINTS if (p := getattr(self, name)) is not None), None)
        return None if points is None else points[..., 0].isfinite()

    def save(self, path: str | Path, env: int = 0, points: str | None = None, time_s: float = 0.0) -> None:
        """Writes the scan of one environment, every field of it, one point per ray and misses as NaN.

        The suffix names the format: .pcd, .ply, .las, .npz or .mcap (a ROS 2 PointCloud2); see ``clouds.write_points``.
        x, y and z are the points in one frame; in another frame they are ``x_b`` and so on, normals are ``normal_x``,
        directions ``direction_x``, all else has its own name.

        Args:
            path: Where to.
            env: Which environment.
            points: Which field becomes x, y and z; None: the first of points_w, points_b and points_s that there is.
            time_s: When the frame ended, s.
        """
        write_points(path, self.table(env, points, time_s))

    def table(self, env: int = 0, points: str | None = None, time_s: float = 0.0) -> PointTable:
        """The scan of one environment as columns, see ``save``."""
        given = [name for name in POINTS if getattr(self, name) is not None]
        if points is None and given:
            points = given[0]
        if points not in given:
            known = ", ".join(given) or "none, so cast with outputs=('points_w', ...)"
            raise ValueError(f"points={points} must be one of the frame's points: {known}")
        if not 0 <= env < self.num_envs:
            raise ValueError(f"env={env} must be in 0..{self.num_envs - 1}")
        columns: dict[str, np.ndarray] = {}
        for name in (points, *(name for name in OUTPUTS if name != points)):
            tensor = getattr(self, name)
            if tensor is not None:
                values = tensor[env].detach().cpu().numpy()
                names = _columns(name, points)
                parts = values.T if len(names) > 1 else [values]
                columns.update(zip(names, parts, strict=True))
        return table_of(columns, points, time_s)

    @classmethod
    def load(cls, path: str | Path, index: int = 0, points: str | None = None) -> LidarFrame:
        """Reads what ``save`` wrote, one environment, on the CPU. ``clouds.read_points`` reads anybody's clouds.

        Args:
            path: The file.
            index: Which of its frames.
            points: Which field x, y and z are; None: the one that the file names.

        Raises:
            ValueError: The file does not name one, or holds columns that no frame has.
        """
        table = read_points(path, index)
        points = points or table.frame
        if points not in POINTS:
            raise ValueError(f"{path} does not say what x, y, z are; give points= one of {', '.join(POINTS)}")
        names = {name: columns for name in OUTPUTS if set(columns := _columns(name, points)) <= set(table.names)}
        unknown = sorted(set(table.names) - {column for columns in names.values() for column in columns})
        if unknown:
            raise ValueError(
                f"{path} has columns that no LidarFrame has ({', '.join(unknown)}); use clouds.read_points"
            )
        return cls(**{name: _tensor(name, [table.points[c] for c in columns]) for name, columns in names.items()})


OUTPUTS = tuple(field.name for field in fields(LidarFrame))
"""Outputs that a LiDAR can report, by the names of ``LidarFrame``'s fields."""

POINTS = ("points_w", "points_b", "points_s")
VECTORS = (*POINTS, "normals_w", "directions_s")
INTEGERS = ("body_id", "shape_id", "class_id", "row")

_STEMS = {"normals_w": "normal_{}", "directions_s": "direction_{}", **{name: "{}" + name[-2:] for name in POINTS}}


def _columns(name: str, points: str) -> tuple[str, ...]:
    """Columns of a file in which a field stands, when ``points`` are x, y and z."""
    if name not in VECTORS:
        return (name,)
    return tuple("xyz") if name == points else tuple(_STEMS[name].format(axis) for axis in "xyz")


def _tensor(name: str, columns: list[np.ndarray]) -> torch.Tensor:
    """(1, N) or (1, N, 3)."""
    values = np.stack(columns, axis=-1) if name in VECTORS else columns[0]
    kind = np.bool_ if name == "valid" else np.int32 if name in INTEGERS else np.float32
    return torch.from_numpy(values.astype(kind))[None]
