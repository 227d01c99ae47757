"""Builds the physics model of one environment from the descriptions of robot, terrain and obstacles."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property

import mujoco

from omniperception.scene.obstacles import ObstaclesConfig
from omniperception.scene.robot import RobotConfig
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
    terrain: TerrainConfig | TiledTerrainConfig
    obstacles: ObstaclesConfig
    sensors: frozenset[str]

    @property
    def base_body(self) -> int:
        return self.model.body(self.robot.base).id

    @cached_property
    def joint_order(self) -> tuple[int, ...] | None:
        """For each of `robot.joints` its place among the model's joints after the base; None where the orders agree."""
        order = tuple(int(self.model.joint(name).qposadr[0]) - 7 for name in self.robot.joints)
        return None if order == tuple(range(len(order))) else order

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
    terrain: TerrainConfig | TiledTerrainConfig,
    obstacles: ObstaclesConfig,
    sensors: Collection[str] = (),
) -> World:
    """Compiles one environment: the robot touches the ground and the obstacles, nothing else touches anything.

    Raises:
        ValueError: the preset names a part that the robot does not have, or the base does not float.
    """
    spec = robot.spec()
    _check_geoms(spec, robot)
    for geom in spec.geoms:
        geom.contype, geom.conaffinity, geom.condim = 0, 1, 3
    terrain.add_to(spec)
    obstacles.add_to(spec)
    _add_contact_sensors(spec, robot, obstacles, frozenset(sensors))
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    model = spec.compile()
    _check_joints(model, robot)
    return World(model, robot, terrain, obstacles, frozenset(sensors))


def _check_geoms(spec: mujoco.MjSpec, robot: RobotConfig) -> None:
    known = [geom.name for geom in spec.geoms]
    for key in ("foot_geoms", "penalized_geoms"):
        unknown = sorted(set(getattr(robot, key)) - set(known))
        if unknown:
            raise ValueError(f"robot.{key} names {', '.join(unknown)}; known: {', '.join(filter(None, known))}")


def _check_joints(model: mujoco.MjModel, robot: RobotConfig) -> None:
    """Base at qpos[0:7] and every other joint in the list, one number each: what states are made of."""
    types = {model.joint(k).name: model.jnt_type[k] for k in range(model.njnt)}
    floating = [model.body(model.jnt_bodyid[k]).name for k in range(model.njnt) if model.jnt_type[k] == _FREE]
    if floating != [robot.base] or model.jnt_type[0] != _FREE:
        raise ValueError(
            f"robot.base={robot.base} must be the first body of {robot.mjcf} with a joint, and the only one with a free"
            f" joint; bodies with a free joint: {', '.join(floating) or 'none'}"
        )
    missing = [name for name, kind in types.items() if kind != _FREE and name not in robot.joints]
    if missing:
        raise ValueError(f"robot.joints must name every joint of {robot.mjcf}; missing: {', '.join(missing)}")
    balls = [name for name in robot.joints if types[name] == mujoco.mjtJoint.mjJNT_BALL]
    if balls:
        raise ValueError(f"robot.joints names {', '.join(balls)}: joints must be hinges or slides, not balls")


def _add_contact_sensors(
    spec: mujoco.MjSpec, robot: RobotConfig, obstacles: ObstaclesConfig, kinds: frozenset[str]
) -> None:
    geoms = {
        FOOT_FORCE: (robot.foot_geoms, _FORCE),
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
