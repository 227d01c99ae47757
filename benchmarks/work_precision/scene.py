"""Obstacles and a robot as smooth functions of time, and what a LiDAR would truly measure among them, in float64."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import torch

from benchmarks.harness.reference import compile_model, mujoco_ranges
from benchmarks.harness.rotations import matrices, quat_about, quat_multiply, unit_vectors
from omnilidar import LidarConfig
from omniperception.scene import ObstaclesConfig
from omniperception.scene.part_shapes import PartShapes, footprint_radius

GROUND, OBSTACLE = 0, 1
"""Classes of what is hit."""
SPREAD = (1.0, 4.5)
"""Obstacles' edges start at least so far from the robot's middle, and their centres at most, metres."""
WALK, TURN = 0.8, 0.5
"""The robot's speed, m/s, and its greatest yaw rate, rad/s."""
STEP_HZ, BOB, SWAY = 2.5, 0.01, 0.05
"""A trot: strides per second, rise and fall of the base, m, and its roll and pitch, rad."""
HEIGHT = 0.31
X, Y, Z = np.eye(3)


@dataclass(frozen=True)
class MovingScene:
    """A plane, S obstacles that go straight on and a robot that trots among them, in each of E environments.

    Attributes:
        kinds: Kind of each obstacle.
        sizes: MuJoCo's sizes, (S, 3).
        start, velocity: Centres at time 0, m, (E, S, 3), and what moves them, m/s, (E, S, 3).
        heading, spin: Orientation about the vertical at time 0, rad, and its rate, rad/s, (E, S).
        phase: Of the robot's trot and turns, rad, (E,).
        plane: There is a ground at z = 0.
    """

    kinds: tuple[str, ...]
    sizes: np.ndarray
    start: np.ndarray
    velocity: np.ndarray
    heading: np.ndarray
    spin: np.ndarray
    phase: np.ndarray
    plane: bool = True

    @property
    def num_envs(self) -> int:
        return len(self.start)

    def obstacles(self, time_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Positions (E, S, 3) and quaternions (E, S, 4)."""
        return self.start + time_s * self.velocity, quat_about(Z, self.heading + time_s * self.spin)

    def base(self, time_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Position (E, 3) and quaternion (E, 4) of the robot's base."""
        stride = 2.0 * math.pi * STEP_HZ * time_s + self.phase
        yaw = TURN * np.sin(2.0 * math.pi * 0.5 * time_s + self.phase) / math.pi
        pos = np.zeros((self.num_envs, 3))
        pos[:, 0] = WALK * time_s
        pos[:, 2] = HEIGHT + BOB * np.sin(2.0 * stride)
        tilt = quat_multiply(quat_about(Y, SWAY * np.sin(2.0 * stride)), quat_about(X, SWAY * np.sin(stride)))
        return pos, quat_multiply(quat_about(Z, yaw), tilt)

    def sensor(self, time_s: float, config: LidarConfig) -> tuple[np.ndarray, np.ndarray]:
        """Position (E, 3) and rotation matrix (E, 3, 3) of the sensor in the environment's frame."""
        pos, quat = self.base(time_s)
        turn = matrices(quat)
        return pos + turn @ np.asarray(config.mount_pos), turn @ matrices(np.asarray(config.quat))


def moving_scene(obstacles: ObstaclesConfig, num_envs: int, seed: int = 0) -> MovingScene:
    """Obstacles of a preset at random around the robot, moving at speeds drawn from their groups' ranges.

    Sizes are drawn once, the same in every environment.
    """
    rng, shapes = np.random.default_rng(seed), np.random.default_rng(0)
    groups = [obstacle.group for obstacle in obstacles.obstacles()]
    parts = [part for part in obstacles.parts() if groups[part.obstacle].poses is None]
    sizes = np.zeros((len(parts), 3))
    for size, part in zip(sizes, parts, strict=True):
        size[: len(part.size)] = shapes.uniform(*np.transpose(part.size))
    drawn = PartShapes([part.kind for part in parts], torch.float64, torch.device("cpu"))
    half = drawn.half_extents(torch.from_numpy(sizes)[None])
    radius, half_height = footprint_radius(drawn.outline(half))[0].numpy(), half[0, :, 2].numpy()
    shape = (num_envs, len(parts))
    azimuth, course = rng.uniform(-math.pi, math.pi, (2, *shape))
    nearest = SPREAD[0] + radius
    distance = np.sqrt(rng.uniform(nearest**2, SPREAD[1] ** 2, shape))
    height = np.broadcast_to(half_height, shape)
    speed = np.stack([rng.uniform(*groups[part.obstacle].speed, num_envs) for part in parts], axis=1)
    flat = np.zeros(shape)
    return MovingScene(
        kinds=tuple(part.kind for part in parts),
        sizes=sizes,
        start=np.stack([distance * np.cos(azimuth), distance * np.sin(azimuth), height], axis=-1),
        velocity=np.stack([speed * np.cos(course), speed * np.sin(course), flat], axis=-1),
        heading=rng.uniform(-math.pi, math.pi, shape),
        spin=np.where(speed > 0.0, rng.uniform(-1.0, 1.0, shape), 0.0),
        phase=rng.uniform(-math.pi, math.pi, num_envs),
    )


class Truth:
    """MuJoCo's rays in float64 through a scene at any time, one environment after the other."""

    def __init__(self, scene: MovingScene, config: LidarConfig) -> None:
        self.scene, self.config = scene, config
        self._model = compile_model(scene)
        self._data = mujoco.MjData(self._model)

    def scan(self, time_s: float, env: int, directions_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Ranges, m, ``inf`` where the sensor reports none, and whether an obstacle is hit, (N,) each.

        Args:
            time_s: Where everything is.
            env: The environment.
            directions_s: Unit directions in the sensor's frame, (N, 3).
        """
        model, data, config = self._model, self._data, self.config
        data.mocap_pos[:], data.mocap_quat[:] = (poses[env] for poses in self.scene.obstacles(time_s))
        mujoco.mj_kinematics(model, data)
        origin, turn = (poses[env] for poses in self.scene.sensor(time_s, config))
        ranges, geom = mujoco_ranges(model, data, origin, directions_s.astype(np.float64) @ turn.T)
        seen = (ranges >= config.min_range) & (ranges <= config.max_range)
        return np.where(seen, ranges, math.inf), seen & (geom > 0)

    def distorted(self, times: np.ndarray, env: int, directions_s: np.ndarray) -> np.ndarray:
        """Ranges of rays (N, 3) each of which leaves at a time of its own, s, (N,)."""
        return np.array([self.scan(t, env, d[None])[0][0] for t, d in zip(times, directions_s, strict=True)])

    def sectors(self, time_s: float, directions_s: Sequence[np.ndarray], num_sectors: int, cap: float) -> np.ndarray:
        """Horizontal distance from the base to the nearest obstacle that the rays hit, by sector, (E, num_sectors).

        ``directions_s`` are (N, 3) for each environment, in the sensor's frame; ``cap`` is the largest distance, m, and
        that of a sector without a hit. Sectors begin at -pi of the yaw-aligned frame.
        """
        distances = np.full((self.scene.num_envs, num_sectors), cap)
        base_pos, base_quat = self.scene.base(time_s)
        forward = matrices(base_quat)[:, :, 0]
        for env, directions in enumerate(directions_s):
            ranges, obstacle = self.scan(time_s, env, directions)
            origin, turn = (poses[env] for poses in self.scene.sensor(time_s, self.config))
            hits = origin + ranges[obstacle, None] * (directions[obstacle].astype(np.float64) @ turn.T)
            away = hits[:, :2] - base_pos[env, :2]
            bearing = np.arctan2(away[:, 1], away[:, 0]) - math.atan2(forward[env, 1], forward[env, 0])
            sector = np.floor(np.mod(bearing + math.pi, 2.0 * math.pi) * num_sectors / (2.0 * math.pi)).astype(int)
            np.minimum.at(distances[env], np.minimum(sector, num_sectors - 1), np.linalg.norm(away, axis=1))
        return distances


def dense_directions(elevation: Sequence[float], step_deg: float) -> np.ndarray:
    """Unit directions on a grid of elevation and azimuth, (N, 3) float64, the span of elevation (rad) inclusive."""
    low, high = elevation
    rows = math.ceil((high - low) / math.radians(step_deg)) + 1
    columns = math.ceil(360.0 / step_deg)
    theta, phi = np.meshgrid(np.linspace(low, high, rows), np.arange(columns) * 2.0 * math.pi / columns, indexing="ij")
    return unit_vectors(theta, phi).reshape(-1, 3)
