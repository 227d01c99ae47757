"""What a robot's LiDAR sees of the robot, and a picture of it, in one pose."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import torch
from PIL import Image

from omnilidar import Lidar, RayScene
from omniperception.env.sensing import SensorConfig
from omniperception.evaluation.film.render import Renderer, View
from omniperception.scene import World
from omniperception.scene.rays import HitClass, RayShapes, ray_shapes
from omnirobot.common.errors import naming

FRAMES = 5
"""Frames of the sensor that are looked at, because its pattern need not repeat."""


@dataclass(frozen=True)
class Sight:
    """Hits of some frames.

    Attributes:
        rays: number of rays.
        own: share of rays that hit the robot, by geom, the most first.
        nearest: m, to the robot's nearest hit; infinite without one.
        points_w: (P, 3) m, hits on the ground and on the robot.
        on_robot: (P,) bool.
    """

    rays: int
    own: Mapping[str, float]
    nearest: float
    points_w: torch.Tensor
    on_robot: torch.Tensor


def look(world: World, data: mujoco.MjData, sensor: SensorConfig) -> Sight:
    """The sensor's hits in the pose of `data`, without noise."""
    shapes = ray_shapes(world, sensor.exclude_geoms, sensor.mount_body)
    scene = RayScene(shapes.shapes, 1, len(shapes.bodies))
    pos, quat = _poses(shapes, data)
    scene.body_pos.copy_(pos[None])
    scene.body_quat.copy_(quat[None])
    carrier = shapes.base if sensor.mount_body is None else shapes.bodies.index(world.model.body(sensor.mount_body).id)
    lidar = Lidar(
        sensor, sensor.scan_pattern(), scene, carrier, outputs=("true_ranges", "points_w", "shape_id", "class_id")
    )
    points, robots, counts, rays, nearest = [], [], np.zeros(len(shapes.shapes)), 0, float("inf")
    for k in range(FRAMES):
        frame = lidar.cast((k + 1) * sensor.period_s)
        assert frame.shape_id is not None and frame.points_w is not None
        assert frame.true_ranges is not None and frame.class_id is not None  # asked for
        hit, own = frame.shape_id[0] >= 0, frame.class_id[0] == HitClass.ROBOT
        rays += len(hit)
        counts += np.bincount(frame.shape_id[0, own].numpy(), minlength=len(counts))
        nearest = min([nearest, *frame.true_ranges[0, own].tolist()])
        points.append(frame.points_w[0, hit].clone())
        robots.append(own[hit])
    order = np.argsort(-counts)
    seen = {shapes.geom_names[k]: float(counts[k]) / rays for k in order if counts[k]}
    return Sight(rays, seen, nearest, torch.cat(points), torch.cat(robots))


def draw(
    world: World, data: mujoco.MjData, sight: Sight | None, path: Path, width: int = 800, height: int = 600
) -> None:
    """Writes a picture of the robot, from ahead and aside, with the LiDAR's points: those on the robot red."""
    shapes = ray_shapes(world)
    pos, quat = _poses(shapes, data)
    base = torch.from_numpy(data.body(world.robot.base).xpos.copy()).float()
    target = torch.tensor([base[0], base[1], 0.5 * base[2]])
    eye = target + max(2.2 * float(base[2]), 0.7) * torch.tensor([1.5, -1.3, 0.7])
    nothing = torch.zeros(0, 3), torch.zeros(0, dtype=torch.bool)
    points, on_robot = nothing if sight is None else (sight.points_w.float(), sight.on_robot)
    picture = Renderer(shapes, width, height, samples=2).render(View(eye, target, pos, quat, points, on_robot))
    path.parent.mkdir(parents=True, exist_ok=True)
    with naming(path):
        Image.fromarray(picture.numpy()).save(path)


def _poses(shapes: RayShapes, data: mujoco.MjData) -> tuple[torch.Tensor, torch.Tensor]:
    bodies = list(shapes.bodies)
    return torch.from_numpy(data.xpos[bodies]).float(), torch.from_numpy(data.xquat[bodies]).float()
