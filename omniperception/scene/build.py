"""Builds the physics model of one environment from the descriptions of robot, terrain and obstacles."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import mujoco

from omniperception.scene.obstacles import ObstaclesConfig
from omniperception.scene.robot import RobotConfig
from omniperception.scene.terrain import GROUND, TerrainConfig
from omniperception.scene.tiled_terrain import TiledTerrainConfig

FOOT_FORCE, LINK_FORCE, OBSTACLE_CONTACT = "foot_force", "link_force", "obstacle_contact"
"""Contact sensors that exist only when something reads them."""

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
        sensors: the contact sensors built in; a subset of FOOT_FORCE, LINK_FORCE, OBSTACLE_CONTACT.
    """

    model: mujoco.MjModel
    robot: RobotConfig
    terrain: TerrainConfig | TiledTerrainConfig
    obstacles: ObstaclesConfig
    sensors: frozenset[str]

    @property
    def base_body(self) -> int:
        return self.model.body(self.robot.base).id

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
    """Compiles one environment: the robot meets the ground and the obstacles, nothing else meets anything."""
    spec = robot.spec()
    for geom in spec.geoms:
        geom.contype, geom.conaffinity, geom.condim = 0, 1, 3
    terrain.add_to(spec)
    obstacles.add_to(spec)
    _add_contact_sensors(spec, robot, obstacles, frozenset(sensors))
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    return World(spec.compile(), robot, terrain, obstacles, frozenset(sensors))


def _add_contact_sensors(
    spec: mujoco.MjSpec, robot: RobotConfig, obstacles: ObstaclesConfig, kinds: frozenset[str]
) -> None:
    geoms = {
        FOOT_FORCE: (robot.foot_geoms, _FORCE),
        LINK_FORCE: (robot.penalized_geoms, _FORCE),
        OBSTACLE_CONTACT: (obstacles.geom_names(), _FOUND),
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
