"""Builds the physics model of one environment from the descriptions of robot, terrain and obstacles."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np

from omniperception.scene.map_terrain import MapTerrainConfig
from omniperception.scene.obstacles import ObstaclesConfig
from omniperception.scene.robot import RobotConfig
from omniperception.scene.robot_file import ROUNDING, collides, compile_robot, drop_unseen
from omniperception.scene.terrain import GROUND, TerrainConfig
from omniperception.scene.tiled_terrain import TiledTerrainConfig

FOOT_FORCE, LINK_FORCE, OBSTACLE_CONTACT = "foot_force", "link_force", "obstacle_contact"
OBSTACLE_FORCE = "obstacle_force"
"""Contact sensors that exist only when something reads them."""

_FREE = mujoco.mjtJoint.mjJNT_FREE
_FOUND, _FORCE = 1, 2
_REDUCE_NET_FORCE = 3


@dataclass(frozen=True)
class World:
    """A compiled environment and the descriptions it came from.

    Attributes:
        model: the compiled MuJoCo model of one environment.
        robot: the robot preset.
        terrain: the ground preset.
        obstacles: the obstacle preset.
        sensors: the contact sensors built in; a subset of FOOT_FORCE, LINK_FORCE, OBSTACLE_CONTACT, OBSTACLE_FORCE.
    """

    model: mujoco.MjModel
    robot: RobotConfig
    terrain: TerrainConfig | TiledTerrainConfig | MapTerrainConfig
    obstacles: ObstaclesConfig
    sensors: frozenset[str]

    @property
    def base_body(self) -> int:
        return self.model.body(self.robot.base).id

    @cached_property
    def joint_columns(self) -> tuple[tuple[int, ...], tuple[int, ...]] | None:
        """Where the base and each of `robot.joints` stand in positions and in velocities; None where that is their
        order and there is nothing else."""
        joints = [self.model.joint(name) for name in self.robot.joints]
        positions = (*range(7), *(int(joint.qposadr[0]) for joint in joints))
        velocities = (*range(6), *(int(joint.dofadr[0]) for joint in joints))
        as_they_are = positions == tuple(range(self.model.nq)) and velocities == tuple(range(self.model.nv))
        return None if as_they_are else (positions, velocities)

    @cached_property
    def rest_positions(self) -> np.ndarray:
        """(nq,) positions with passive joints where the default pose has them, or else the file."""
        rest = self.model.qpos0.copy()
        for name, angle in self.robot.default_joint_pos.items():
            rest[self.model.joint(name).qposadr[0]] = angle
        return rest

    @property
    def ground_mocap(self) -> int | None:
        """Index of the kinematic body that carries the ground, before all obstacles; None for a plane."""
        body = int(self.model.geom(GROUND).bodyid[0])
        mocap = int(self.model.body_mocapid[body])
        return mocap if mocap >= 0 else None

    def sensor_slice(self, kind: str) -> slice:
        """Columns of MjData.sensordata that hold the sensors of one kind; empty when none were built."""
        addresses = [
            (self.model.sensor_adr[i], self.model.sensor_adr[i] + self.model.sensor_dim[i])
            for i in range(self.model.nsensor)
            if self.model.sensor(i).name.startswith(kind + ":")
        ]
        return slice(addresses[0][0], addresses[-1][1]) if addresses else slice(0, 0)


def build_world(
    robot: RobotConfig,
    terrain: TerrainConfig | TiledTerrainConfig | MapTerrainConfig,
    obstacles: ObstaclesConfig,
    sensors: Collection[str] = (),
) -> World:
    """Compiles one environment: the robot touches the ground and the obstacles, and itself where its preset says so.

    Of the robot those geoms touch something that can be touched according to its file (contype or conaffinity), with
    contacts of three dimensions (condim 3) that begin at distance 0 (margin and gap are 0). The ground decides the
    friction, whatever priority the file gives the robot's geoms.

    Raises:
        ValueError: the preset names a part that the robot does not have, or the base does not float.
    """
    spec = robot.spec()
    _check_geoms(spec, robot)
    _check_groups(spec, robot)
    drop_unseen(spec, robot.ray_groups)
    for geom in spec.geoms:
        geom.contype, geom.conaffinity, geom.condim = 0, int(collides(geom)), 3
        geom.priority, geom.margin, geom.gap = 0, 0.0, 0.0
    terrain.add_to(spec)
    obstacles.add_to(spec)
    _add_contact_sensors(spec, robot, obstacles, frozenset(sensors))
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    model = compile_robot(spec, robot.file)
    _check_joints(model, robot)
    return World(model, robot, terrain, obstacles, frozenset(sensors))


def _check_geoms(spec: mujoco.MjSpec, robot: RobotConfig) -> None:
    known = {geom.name: geom for geom in spec.geoms}
    named = {"foot_geoms": [name for foot in robot.feet for name in foot], "penalized_geoms": robot.penalized_geoms}
    for key, names in named.items():
        unknown = sorted(set(names) - known.keys())
        if unknown:
            raise ValueError(f"robot.{key} names {', '.join(unknown)}; known: {', '.join(known)}")
        untouchable = sorted(name for name in names if not collides(known[name]))
        if untouchable:
            raise ValueError(
                f"robot.{key} names {', '.join(untouchable)}, which nothing can touch (contype=0 conaffinity=0 in"
                f" {robot.file}); name geoms that collide"
            )


def _check_groups(spec: mujoco.MjSpec, robot: RobotConfig) -> None:
    there = sorted({geom.group for geom in spec.geoms})
    unknown = sorted(set(robot.ray_groups or ()) - set(there))
    if unknown:
        raise ValueError(
            f"robot.ray_groups names {', '.join(map(str, unknown))}, in which {robot.file} has no geom; groups there:"
            f" {', '.join(map(str, there))}"
        )


def _check_joints(model: mujoco.MjModel, robot: RobotConfig) -> None:
    """Base at qpos[0:7] and joints of one number each: what states are made of."""
    floating = [model.body(model.jnt_bodyid[k]).name for k in range(model.njnt) if model.jnt_type[k] == _FREE]
    if floating != [robot.base] or model.jnt_type[0] != _FREE:
        raise ValueError(
            f"robot.base={robot.base} must be the first body of {robot.file} with a joint, and the only one with a free"
            f" joint; bodies with a free joint: {', '.join(floating) or 'none'}"
        )
    known = [model.joint(k).name for k in range(1, model.njnt)]
    unknown = sorted(set(robot.default_joint_pos) - set(known))
    if unknown:
        raise ValueError(
            f"robot.default_joint_pos names {', '.join(unknown)}, which {robot.file} does not have; known:"
            f" {', '.join(known)}"
        )
    balls = [name for name in robot.default_joint_pos if model.joint(name).type[0] == mujoco.mjtJoint.mjJNT_BALL]
    if balls:
        raise ValueError(f"robot.joints names {', '.join(balls)}: joints must be hinges or slides, not balls")
    for name, angle in robot.default_joint_pos.items():
        low, high = model.joint(name).range
        if model.joint(name).limited[0] and not low - ROUNDING <= angle <= high + ROUNDING:
            raise ValueError(
                f"robot.default_joint_pos.{name}={angle:g} is outside its range in {robot.file}, {low:g} to {high:g}"
            )


def _add_contact_sensors(
    spec: mujoco.MjSpec, robot: RobotConfig, obstacles: ObstaclesConfig, kinds: frozenset[str]
) -> None:
    geoms = {
        FOOT_FORCE: (tuple(geom for foot in robot.feet for geom in foot), _FORCE),
        LINK_FORCE: (robot.penalized_geoms, _FORCE),
        OBSTACLE_CONTACT: (obstacles.geom_names(), _FOUND),
        OBSTACLE_FORCE: (obstacles.geom_names(), _FORCE),
    }
    unknown = kinds - set(geoms)
    if unknown:
        raise ValueError(f"unknown contact sensors {sorted(unknown)}; known: {sorted(geoms)}")
    for kind in sorted(kinds):
        names, data = geoms[kind]
        for name in names:
            spec.add_sensor(
                name=f"{kind}:{name}",
                type=mujoco.mjtSensor.mjSENS_CONTACT,
                objtype=mujoco.mjtObj.mjOBJ_GEOM,
                objname=name,
                intprm=[data, _REDUCE_NET_FORCE, 1],
            )
