"""Benchmark scenes as plain data, from which every method builds its own scene."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from benchmarks.harness.meshes import Mesh, join, tessellate
from benchmarks.harness.rotations import matrices, quat_about, quat_multiply, random_unit, unit_vectors

MOTIONS = ("smooth", "jump", "static")
KINDS = ("box", "cylinder", "sphere", "capsule")
AREA = 8.0
"""Obstacles stand in a square of twice this side around the sensor, metres."""
CLEARANCE = 0.8
"""No obstacle's centre comes nearer to the sensor's axis than its own size and this, metres."""
SPEED = 1.5
"""Obstacles of a smooth scene move on circles at this speed, m/s."""
GO2_MOUNT_RPY = (0.0, -2.8782, 3.14)
"""Orientation of the Mid-360 in the Go2's head, upside down and tilted, roll-pitch-yaw about fixed axes, rad."""
SPINNING_FOV = (-0.43, 0.035)
"""Lowest and highest channel of a 64-channel car sensor, rad."""


@dataclass(frozen=True)
class Scan:
    """Which rays a sensor emits in each frame: every ``stride``-th row of a table, from a row that time decides.

    Attributes:
        elevation, azimuth: The table, rad, (M,) float64.
        points_per_second: Rate of the table's rows.
        num_lasers: Lasers that fire in turn.
        rows_per_shot: Consecutive rows that fire at one instant.
        num_rays: Rays kept per frame, R.
        stride: Rows from one kept ray to the next.
        period_s: Seconds per frame; frame f ends at ``(f + 1) * period_s``.
        phase_rows: Rows by which each environment's device is ahead, (num_envs,) int64.
    """

    elevation: np.ndarray
    azimuth: np.ndarray
    points_per_second: float
    num_lasers: int
    rows_per_shot: int
    num_rays: int
    stride: int
    period_s: float
    phase_rows: np.ndarray

    @cached_property
    def table(self) -> np.ndarray:
        """Unit directions of the table's rows, (M, 3) float32."""
        return unit_vectors(self.elevation, self.azimuth).astype(np.float32)

    def directions_s(self, frame: int) -> np.ndarray:
        """Unit ray directions of one frame in the sensor frame, (num_envs, R, 3) float32."""
        first = np.round(frame * self.period_s * self.points_per_second).astype(np.int64) + self.phase_rows
        rows = (first[:, None] + np.arange(self.num_rays) * self.stride) % len(self.elevation)
        return self.table[rows]


@dataclass(frozen=True)
class Terrain:
    """A rough square ground that all environments share, centred on the origin.

    Attributes:
        heights: Height of the grid's corners, x along the first axis, metres, (rows + 1, cols + 1) float32.
        cell: Side of a cell, metres.
    """

    heights: np.ndarray
    cell: float

    @property
    def vertices(self) -> np.ndarray:
        """(V, 3) float32, metres."""
        axes = [(np.arange(n) - (n - 1) / 2.0) * self.cell for n in self.heights.shape]
        x, y = np.meshgrid(*axes, indexing="ij")
        return np.stack([x, y, self.heights], axis=-1).reshape(-1, 3).astype(np.float32)

    @property
    def faces(self) -> np.ndarray:
        """Two triangles per cell, counter-clockwise from above, (F, 3) int32."""
        rows, cols = self.heights.shape
        corner = np.arange(rows * cols, dtype=np.int32).reshape(rows, cols)
        a, b = corner[:-1, :-1].ravel(), corner[1:, :-1].ravel()
        c, d = corner[1:, 1:].ravel(), corner[:-1, 1:].ravel()
        return np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])

    @property
    def size(self) -> tuple[float, float]:
        """Half extents along x and y, metres."""
        rows, cols = self.heights.shape
        return (rows - 1) * self.cell / 2.0, (cols - 1) * self.cell / 2.0


@dataclass(frozen=True)
class BenchmarkScene:
    """What is seen, from where and along which rays, for F frames of E environments. Units are SI, (w, x, y, z).

    Attributes:
        kinds: Kind of each obstacle, (S,) names out of ``KINDS``.
        sizes: MuJoCo's sizes, zeros where a kind has fewer than three, metres, (S, 3) float32.
        positions, quats: Pose of each obstacle in its environment's frame, (F, E, S, 3) and (F, E, S, 4) float32.
        sensor_pos, sensor_quat: Pose of the sensor, (F, E, 3) and (F, E, 4) float32.
        scan: The rays in the sensor frame.
        max_range: Where rays end, metres.
        plane: Whether there is an infinite ground at z = 0.
        terrain: Ground of triangles, in place of the plane.
        moving: Whether obstacles and sensors have new poses in each frame; if not, all frames have the same.
    """

    kinds: tuple[str, ...]
    sizes: np.ndarray
    positions: np.ndarray
    quats: np.ndarray
    sensor_pos: np.ndarray
    sensor_quat: np.ndarray
    scan: Scan
    max_range: float = 30.0
    plane: bool = True
    terrain: Terrain | None = None
    moving: bool = True

    @property
    def num_frames(self) -> int:
        return self.sensor_pos.shape[0]

    @property
    def num_envs(self) -> int:
        return self.sensor_pos.shape[1]

    @property
    def num_rays(self) -> int:
        return self.scan.num_rays

    @property
    def num_bodies(self) -> int:
        return len(self.kinds)

    def directions_w(self, frame: int, dtype: type = np.float32) -> np.ndarray:
        """Unit ray directions in the environments' frames, rotated in float64, (E, R, 3)."""
        turn = matrices(self.sensor_quat[frame])
        return np.einsum("eij,erj->eri", turn, self.scan.directions_s(frame).astype(np.float64)).astype(dtype)

    def rays_w(self, dtype: type = np.float32) -> list[tuple[np.ndarray, np.ndarray]]:
        """Origins and directions of each frame in the environments' frames, (E, R, 3) each."""
        directions = [self.directions_w(frame).astype(dtype) for frame in range(self.num_frames)]
        return [
            (np.broadcast_to(o[:, None].astype(dtype), d.shape), d)
            for o, d in zip(self.sensor_pos, directions, strict=True)
        ]

    def environments(self, low: int, high: int) -> BenchmarkScene:
        """The same scene with environments ``low`` to ``high - 1`` only."""
        return self._of(lambda poses: poses[:, low:high], self.scan.phase_rows[low:high])

    def repeated(self, num_envs: int) -> BenchmarkScene:
        """The scene's first environment several times."""
        return self._of(lambda poses: poses[:, :1].repeat(num_envs, axis=1), self.scan.phase_rows[:1].repeat(num_envs))

    def _of(self, chosen: Callable[[np.ndarray], np.ndarray], phase_rows: np.ndarray) -> BenchmarkScene:
        names = ("positions", "quats", "sensor_pos", "sensor_quat")
        poses = {name: chosen(getattr(self, name)) for name in names}
        return replace(self, **poses, scan=replace(self.scan, phase_rows=phase_rows))


def obstacle_scene(
    scan: Scan,
    num_bodies: int = 40,
    num_frames: int = 8,
    motion: str = "smooth",
    seed: int = 0,
    mount_rpy: tuple[float, float, float] = GO2_MOUNT_RPY,
) -> BenchmarkScene:
    """A plane and mixed obstacles around each sensor.

    Args:
        scan: The rays; its phases say how many environments there are.
        num_bodies: Obstacles per environment, of the four kinds in turn. Their density stays that of 40 in the
            square of side 2 ``AREA``: more of them take more space.
        num_frames: Frames after which poses repeat.
        motion: "static"; "smooth": obstacles move on circles at ``SPEED`` and turn; "jump": every obstacle is
            somewhere else in each frame.
        seed: Seed of the scene.
        mount_rpy: Orientation of the sensor in its carrier, rad.
    """
    if motion not in MOTIONS:
        raise ValueError(f"motion={motion!r} must be one of {MOTIONS}")
    rng = np.random.default_rng(seed)
    num_envs, frames = len(scan.phase_rows), num_frames
    kinds = tuple(KINDS[k % len(KINDS)] for k in range(num_bodies))
    sizes = np.array([_size(kind, rng) for kind in kinds], dtype=np.float64).reshape(-1, 3)
    draws = frames if motion == "jump" else 1
    half = AREA * max(1.0, np.sqrt(num_bodies / 40.0))
    centres = _stand(rng, (draws, num_envs), kinds, sizes, half)
    angles = rng.uniform(0.0, 2.0 * np.pi, (draws, num_envs, num_bodies))
    axes = np.where(_is_upright(kinds)[:, None], [0.0, 0.0, 1.0], random_unit(rng, num_bodies, 3))
    turn = 2.0 * np.pi * np.arange(1 if motion == "static" else frames) / frames
    if motion == "smooth":
        radius = SPEED * scan.period_s * frames / (2.0 * np.pi)
        phase = turn[:, None, None] + rng.uniform(0.0, 2.0 * np.pi, (num_envs, num_bodies))
        centres = centres + radius * np.stack([np.cos(phase), np.sin(phase), np.zeros_like(phase)], axis=-1)
        angles = angles + turn[:, None, None]
    poses = (centres, quat_about(axes, angles), *_sensor_poses(rng, num_envs, turn, mount_rpy))
    return BenchmarkScene(
        kinds, sizes.astype(np.float32), *(_frames(pose, frames) for pose in poses), scan, moving=motion != "static"
    )


def terrain_scene(
    scan: Scan, cells: int = 200, cell: float = 0.1, num_frames: int = 8, seed: int = 0
) -> BenchmarkScene:
    """Sensors standing still at random places of a rough ground of ``2 cells^2`` triangles; nothing else."""
    rng = np.random.default_rng(seed)
    num_envs = len(scan.phase_rows)
    terrain = Terrain(rough_heights(cells, cell, rng), cell)
    spots = rng.integers(cells // 5, cells - cells // 5 + 1, (num_envs, 2))
    ground = terrain.heights[spots[:, 0], spots[:, 1]]
    place = (spots - cells / 2.0) * cell
    sensor_pos, sensor_quat = _sensor_poses(rng, num_envs, np.zeros(1), GO2_MOUNT_RPY)
    sensor_pos[0, :, :2] += place
    sensor_pos[0, :, 2] += ground + 0.2
    poses = (np.zeros((1, num_envs, 0, 3)), np.zeros((1, num_envs, 0, 4)), sensor_pos, sensor_quat)
    return BenchmarkScene(
        (),
        np.zeros((0, 3), np.float32),
        *(_frames(pose, num_frames) for pose in poses),
        scan,
        plane=False,
        terrain=terrain,
        moving=False,
    )


def rough_heights(cells: int, cell: float, rng: np.random.Generator) -> np.ndarray:
    """Hills of several wavelengths with steps and gravel on them, metres, (cells + 1, cells + 1) float32."""
    x, y = np.meshgrid(*[(np.arange(cells + 1) - cells / 2.0) * cell] * 2, indexing="ij")
    heights = np.zeros_like(x)
    for wavelength, height in ((12.0, 0.5), (5.0, 0.25), (2.0, 0.1), (0.8, 0.04)):
        angle, phase = rng.uniform(0.0, 2.0 * np.pi, 2)
        heights += height * np.sin(2.0 * np.pi / wavelength * (np.cos(angle) * x + np.sin(angle) * y) + phase)
    heights += np.where((np.floor(x / 1.5) + np.floor(y / 1.5)) % 2 == 0, 0.12, 0.0)
    return (heights + rng.uniform(0.0, 0.03, x.shape)).astype(np.float32)


def spinning_scan(num_envs: int, channels: int = 64, columns: int = 1800) -> Scan:
    """All rays of one turn of an evenly spaced spinning sensor; 64 x 1800 are the paper's 115,200."""
    elevation, azimuth = np.meshgrid(
        np.linspace(*SPINNING_FOV, channels), np.arange(columns) * 2.0 * np.pi / columns, indexing="ij"
    )
    rays = channels * columns
    phase_rows = np.zeros(num_envs, dtype=np.int64)
    return Scan(elevation.ravel(), azimuth.ravel(), 10.0 * rays, 1, 1, rays, 1, 0.1, phase_rows)


def environment_mesh(scene: BenchmarkScene, frame: int, env: int) -> Mesh:
    """All triangles of one environment's obstacles and ground, for methods that know nothing else."""
    parts = [tessellate(kind, size) for kind, size in zip(scene.kinds, scene.sizes, strict=True)]
    turn = matrices(scene.quats[frame, env])
    placed = [(v @ turn[k].T + scene.positions[frame, env, k], f) for k, (v, f) in enumerate(parts)]
    return join([*placed, *ground_mesh(scene)])


def ground_mesh(scene: BenchmarkScene) -> list[Mesh]:
    """The terrain, or the plane as a square that reaches beyond every ray; empty without either."""
    if scene.terrain is not None:
        return [(scene.terrain.vertices, scene.terrain.faces)]
    if not scene.plane:
        return []
    corners = 2.0 * scene.max_range * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    return [(corners, np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32))]


# --- poses ----------------------------------------------------------------------------------------------------


def _size(kind: str, rng: np.random.Generator) -> np.ndarray:
    if kind == "box":
        return rng.uniform((0.15, 0.15, 0.2), (0.5, 0.5, 0.8))
    if kind == "sphere":
        return np.array([rng.uniform(0.15, 0.4), 0.0, 0.0])
    return np.array([*rng.uniform((0.1, 0.2), (0.35, 0.9)), 0.0])


def _is_upright(kinds: Sequence[str]) -> np.ndarray:
    return np.array([kind in ("box", "cylinder") for kind in kinds], dtype=bool)


def _stand(
    rng: np.random.Generator, shape: tuple[int, int], kinds: Sequence[str], sizes: np.ndarray, half: float
) -> np.ndarray:
    """Obstacle centres, (*shape, S, 3): boxes and cylinders stand on the ground, spheres and capsules float."""
    reach = np.linalg.norm(sizes, axis=1) + CLEARANCE
    azimuth = rng.uniform(0.0, 2.0 * np.pi, (*shape, len(kinds)))
    edge = half / np.maximum(np.abs(np.cos(azimuth)), np.abs(np.sin(azimuth)))
    inner = np.minimum(reach, half)
    distance = np.sqrt(inner**2 + (edge**2 - inner**2) * rng.uniform(0.0, 1.0, azimuth.shape))
    upright = _is_upright(kinds)
    standing = np.where(np.array([kind == "box" for kind in kinds], dtype=bool), sizes[:, 2], sizes[:, 1])
    height = np.where(upright, standing, rng.uniform(0.3, 1.8, azimuth.shape))
    return np.stack([distance * np.cos(azimuth), distance * np.sin(azimuth), height], axis=-1)


def _sensor_poses(
    rng: np.random.Generator, num_envs: int, turn: np.ndarray, mount_rpy: tuple[float, float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Sensors about 0.35 m above the ground that sway as on a trotting robot; (F, E, 3) and (F, E, 4)."""
    yaw = rng.uniform(0.0, 2.0 * np.pi, num_envs) + 0.2 * np.sin(turn)[:, None]
    pitch = 0.05 * np.sin(turn)[:, None] * np.ones(num_envs)
    height = 0.35 + 0.02 * np.cos(turn)[:, None] * np.ones(num_envs)
    pos = np.stack([0.05 * np.cos(yaw), 0.05 * np.sin(yaw), height], axis=-1)
    carrier = quat_multiply(quat_about(np.array([0.0, 0.0, 1.0]), yaw), quat_about(np.array([0.0, 1.0, 0.0]), pitch))
    mount = [quat_about(np.eye(3)[k], np.array(mount_rpy[k])) for k in range(3)]
    quat = quat_multiply(carrier, quat_multiply(mount[2], quat_multiply(mount[1], mount[0])))
    return pos, quat


def _frames(poses: np.ndarray, num_frames: int) -> np.ndarray:
    """Poses of every frame, float32; what stands still is stored once."""
    return np.broadcast_to(poses.astype(np.float32), (num_frames, *poses.shape[1:]))
