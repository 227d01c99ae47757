"""Draws what a LiDAR sees: its pattern after 0.1, 0.5 and 1 s, and a scan of a demonstration room.

    scan lidar=avia rays=20000 lidar.max_range=30
    scan lidar=mid360,avia,os0_128,vlp16        # each of them, and comparison.png
    scan mesh=hall.stl scale=0.001 at=12,3,0    # in a mesh of your own, in coordinates of a map too
    scan mesh=world.xml                         # a robot or a world: URDF, MJCF, USD (extra `newton`)
    scan lidar=mid360 viewer=web                # the scan lab: in the browser, among people, with sliders

The room holds people, thin rods, a shelf without legs, a rock, rubble and the robot, which carries the sensor. Writes
pattern.png, scan.png and the points; the pictures need the extra `plots`, meshes other than .stl, .obj and .ply
`meshes`, other files of points than .ply and .npz `clouds`.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from omnilidar import DEVICES, TriangleMesh
from omnilidar.mesh_files import AXES, read_mesh, unit_hint
from omniperception import build, config
from omniperception.commands.scan.pictures import draw_comparison, summary, take_scan, write_scan
from omniperception.commands.scan.room import DemoScene, demo_scene, mesh_scene
from omniperception.env.config import EnvConfig
from omniperception.env.sensing import SensorConfig
from omniperception.scene import RobotConfig
from omniperception.viewer import serve_lab
from omniperception.viewer.options import PAGE, PageArguments
from omnirobot.common.cli import Command, argument, refuse_arguments

NO_TASK = ("~experiment", "perception=none", "observations=walk", "rewards=walk")
"""A sensor is looked at, no task is run."""
BESIDE = 1000.0
"""How far (m) beside a mesh a robot may stand."""
WALKERS = 4
"""People who walk about in the scan lab."""


@dataclass(frozen=True, kw_only=True)
class Arguments(PageArguments):
    """The command's own arguments."""

    lidar: tuple[str, ...] = argument(("mid360",), "presets of conf/lidar")
    out: Path | None = argument(None, "folder; null: outputs/view_scan/<lidar>")
    seed: int = argument(0, "seed of the moment at which the scan starts, and of random choices", least=0)
    rays: int | None = argument(None, "how many of the points are kept; null: all", least=1)
    seconds: float | None = argument(None, "how long the sensor measures; null: one frame of the preset", positive=True)
    colour: str = argument("class", "of the points in the file", choices=("class", "height"))
    cloud: str = argument("ply", "format of the points' file", choices=("ply", "pcd", "las", "npz", "mcap"))
    mesh: Path | None = argument(None, "file of a mesh in place of the demonstration room; null: the room")
    scale: float = argument(1.0, "metres to which a unit of the mesh corresponds", positive=True)
    up: str | None = argument(
        None, "axis of the mesh that points up; null: as its format says, or z", choices=tuple(AXES)
    )
    at: tuple[float, ...] = argument((0.0, 0.0, 0.0), "where in the mesh the robot's feet stand (m, z up)")
    viewer: str = argument("none", "web: the scan lab in the browser", choices=("none", "web"))


def main(arguments: Arguments, overrides: list[str]) -> None:
    """Scans the room with each sensor and writes pictures and clouds."""
    if "none" in arguments.lidar:
        raise config.ConfigError("lidar=none has nothing to view; give a sensor, such as lidar=mid360")
    of_preset = "lidar.num_rays" in _given(overrides)
    if arguments.rays is not None and of_preset:
        raise config.ConfigError(
            f"rays={arguments.rays} and lidar.num_rays= are two words for one thing; give one of them"
        )
    out, scans = arguments.out or Path("outputs/view_scan"), []
    if arguments.viewer == "web":
        refuse_arguments(arguments, ("seed", "seconds", "colour", "cloud"), "the lab of viewer=web does not read it")
        return _serve(arguments, out, overrides)
    refuse_arguments(arguments, PAGE, f"viewer={arguments.viewer} has no page")
    for name in arguments.lidar:
        env = _task(name, overrides)
        assert env.lidar is not None  # only lidar=none has none
        demo = _surroundings(arguments, env.robot)
        rays = env.lidar.num_rays if of_preset else arguments.rays
        folder = out if arguments.out and len(arguments.lidar) == 1 else out / name
        folder.mkdir(parents=True, exist_ok=True)  # refused before anything is compiled
        scans.append(take_scan(name, env.lidar, demo, arguments.seconds, rays, arguments.seed))
        if demo.mesh is not None and demo.mesh.encloses(scans[-1].sensor_w):
            print(f"{name}: the sensor is inside {arguments.mesh}, a closed surface, and sees it from within")
        write_scan(scans[-1], env.lidar, demo, folder, arguments.colour, arguments.cloud)
        files = ("pattern.png", "scan.png", f"scan.{arguments.cloud}")
        print(f"{summary(scans[-1])}\nwritten: {', '.join(str(folder / file) for file in files)}", flush=True)
    if len(scans) > 1:
        draw_comparison(scans, demo, out / "comparison.png")
        print(f"written: {out / 'comparison.png'}")


def _task(name: str, overrides: list[str]) -> EnvConfig:
    """A sensor's preset on the robot."""
    return build.assemble(config.compose([*NO_TASK, f"lidar={name}", *overrides])).env


def _serve(arguments: Arguments, out: Path, overrides: list[str]) -> None:
    """The scan lab."""
    room = _surroundings(arguments, _task(arguments.lidar[0], overrides).robot, walkers=WALKERS)
    names = [name for name in config.presets("lidar", config.search_path(overrides)) if name != "none"]
    sensors = {name: partial(_device, name, arguments, overrides) for name in (*arguments.lidar, *names)}
    serve_lab(room, sensors, out, arguments.page)


def _device(name: str, arguments: Arguments, overrides: list[str]) -> SensorConfig:
    """A sensor as its maker sells it: whole frames as far as it reaches, where nothing else is asked for."""
    sensor = _task(name, overrides).lidar
    assert sensor is not None  # only lidar=none has none
    given = _given(overrides)
    if "lidar.num_rays" not in given:
        whole = sensor.scan_pattern().points_per_frame(sensor.period_s)
        sensor = replace(sensor, num_rays=min(arguments.rays or whole, whole))
    if "lidar.max_range" not in given and sensor.device is not None:
        sensor = replace(sensor, max_range=DEVICES[sensor.device].max_range)
    return sensor


def _given(overrides: list[str]) -> set[str]:
    """Keys and groups of overrides."""
    return {override.key_or_group for override in config.parse(overrides)}


def _surroundings(arguments: Arguments, robot: RobotConfig, walkers: int = 0) -> DemoScene:
    if arguments.mesh is None:
        refuse_arguments(arguments, ("at", "scale", "up"), "without mesh= there is no mesh to stand in")
        return demo_scene(robot, walkers=walkers)
    if len(arguments.at) != 3:
        raise config.ConfigError(f"at={','.join(map(str, arguments.at))} must be three numbers, x,y,z in metres")
    vertices, triangles = read_mesh(arguments.mesh, arguments.scale, arguments.up)
    at, low, high = np.array(arguments.at), vertices[triangles].min((0, 1)), vertices[triangles].max((0, 1))
    said = unit_hint(arguments.mesh, vertices[triangles], arguments.scale)
    beside = float(np.linalg.norm(np.maximum(low - at, at - high).clip(min=0.0)))
    if beside > BESIDE:
        spans = ", ".join(f"{axis} {a:.10g} to {b:.10g}" for axis, a, b in zip("xyz", low, high, strict=True))
        raise config.ConfigError(
            f"at={','.join(f'{x:.10g}' for x in at)} is {beside:.0f} m beside mesh={arguments.mesh}, {spans} m;"
            f" {said or 'name a place in it'}"
        )
    if said:
        print(f"warning: {said}", file=sys.stderr)
    origin = np.round(at, -4)
    if origin.any():
        print(f"pictures show coordinates less {','.join(f'{x:.10g}' for x in origin)} m")
    mesh = TriangleMesh(vertices - origin, triangles)
    if not len(mesh.triangles):
        raise config.ConfigError(f"mesh={arguments.mesh} holds no triangle with area")
    return mesh_scene(robot, mesh, (at - origin).tolist(), walkers, origin)


command = Command(
    main,
    Arguments,
    __doc__,
    "of the sensor's preset",
    (ImportError, FileNotFoundError, ValueError),
)
