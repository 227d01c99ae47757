"""How a robot stands on a plane, and where its joints get to, in the physics of training."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import mujoco
import numpy as np

from omniperception.scene import ObstaclesConfig, RobotConfig, TerrainConfig, World, build_world
from omniperception.sim import SimConfig
from omniperception.sim.mujoco import apply_options

GAP = 0.01
"""Height (m) from which the robot is let down."""
MAX_TILT = 0.12
"""A robot that is inclined by more than this (rad) does not stand, ..."""
MIN_HEIGHT = 0.75
"""... nor one whose base is lower than this share of its height in the default pose, ..."""
MAX_SPEED = 0.1
"""... nor one whose base still moves faster than this (m/s)."""
NEAR = 0.05
"""A joint reaches its limit where it comes within this (rad or m)."""


@dataclass(frozen=True)
class Stance:
    """A robot that has held its default pose for a while.

    Attributes:
        height: of the base (m).
        tilt: of the base (rad).
        speed: of the base (m/s).
        drift: horizontal displacement of the base (m).
        sag: by joint, angle beyond the target (rad).
        contacts: by pair of geoms, force along the normal (N).
        saturated: joints whose torque is at its limit.
        steady: whether it stands.
    """

    height: float
    tilt: float
    speed: float
    drift: float
    sag: Mapping[str, float]
    contacts: Mapping[tuple[str, str], float]
    saturated: tuple[str, ...]
    steady: bool


def flat_world(robot: RobotConfig) -> World:
    """The robot alone on a plane, with the physics of training."""
    world = build_world(robot, TerrainConfig(), ObstaclesConfig())
    apply_options(world.model, SimConfig())
    return world


def stand(world: World, seconds: float = 2.0) -> tuple[Stance, mujoco.MjData]:
    """Lets the robot down in its default pose and has the gains hold it."""
    model, robot = world.model, world.robot
    data = _in_default_pose(world, robot.base_height + GAP)
    mujoco.mj_step(model, data, nstep=round(seconds / model.opt.timestep))
    mujoco.mj_forward(model, data)
    up = float(data.body(robot.base).xmat.reshape(3, 3)[2, 2])
    height, tilt, speed = float(data.qpos[2]), math.acos(np.clip(up, -1, 1)), float(np.linalg.norm(data.qvel[:3]))
    angles = {name: float(data.joint(name).qpos[0]) for name in robot.joints}
    limits = np.array(robot.by_joint("torque_limits"))
    saturated = np.abs(data.actuator_force) > 0.99 * limits
    found = Stance(
        height=height,
        tilt=tilt,
        speed=speed,
        drift=float(np.linalg.norm(data.qpos[:2])),
        sag={name: angle - robot.default_joint_pos[name] for name, angle in angles.items()},
        contacts=contacts(model, data),
        saturated=tuple(name for name, full in zip(robot.joints, saturated, strict=True) if full),
        steady=tilt < MAX_TILT and height > MIN_HEIGHT * robot.base_height and speed < MAX_SPEED,
    )
    return found, data


def contacts(model: mujoco.MjModel, data: mujoco.MjData) -> dict[tuple[str, str], float]:
    """Force (N) along the normal by pair of geoms in contact."""
    found: dict[tuple[str, str], float] = {}
    force = np.zeros(6)
    for k in range(data.ncon):
        mujoco.mj_contactForce(model, data, k, force)
        first, second = sorted(model.geom(int(geom)).name for geom in data.contact[k].geom)
        found[first, second] = found.get((first, second), 0.0) + float(force[0])
    return found


def reached_limits(world: World, seconds: float = 1.0) -> dict[str, tuple[float, float]]:
    """By joint with limits, the lowest and the highest angle (rad) to which its gains drive it, one after another.

    The base is in the air without gravity and all other joints hold the default pose, so that what stops a joint short
    is the robot itself, or a gain or torque limit that is too small.
    """
    model, robot = world.model, world.robot
    gravity = model.opt.gravity.copy()
    model.opt.gravity[:] = 0
    found = {}
    for k, name in enumerate(robot.joints):
        if not model.joint(name).limited[0]:
            continue
        ends = []
        for limit in model.joint(name).range.tolist():
            data = _in_default_pose(world, 10.0)
            data.ctrl[k] = limit
            for _ in range(round(seconds / model.opt.timestep)):
                mujoco.mj_step(model, data)
                data.qpos[:7], data.qvel[:6] = (0, 0, 10, 1, 0, 0, 0), 0  # the base is held
            ends.append(float(data.joint(name).qpos[0]))
        found[name] = (ends[0], ends[1])
    model.opt.gravity[:] = gravity
    return found


def _in_default_pose(world: World, height: float) -> mujoco.MjData:
    data = mujoco.MjData(world.model)
    data.qpos[:] = world.rest_positions
    data.qpos[:7] = 0, 0, height, 1, 0, 0, 0
    data.ctrl[:] = world.robot.by_joint("default_joint_pos")
    return data
