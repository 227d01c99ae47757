"""A robot's LiDAR with the robot as the meshes that it is drawn with, and as the primitives that it collides with.

    python -m benchmarks.robot_meshes robot=g1
    python -m benchmarks.robot_meshes robot=go1 num_envs=64,512 rays=2000 obstacles=moving

What is cast are frames of the robot's own LiDAR, poses of all bodies new in each. Ratio: time with meshes over time
with primitives, both timed in turn in one process. Errors: of both against mj_ray in float64 on the same geoms, and
what primitives see otherwise than meshes do.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import torch

from benchmarks.harness.reference import mujoco_ranges
from benchmarks.harness.rotations import matrices
from benchmarks.harness.table import Table, about, report
from benchmarks.harness.timing import paired_ratio, paired_timings
from omnilidar import Lidar, LidarFrame, RayScene
from omniperception import build, config
from omniperception.commands.robot_check import NO_TASK
from omniperception.env.sensing import SensorConfig
from omniperception.scene import World, build_world
from omniperception.scene.rays import HitClass, RayShapes, ray_shapes
from omnirobot.common.cli import Command, argument

POSES = 4
"""Sets of poses that frames take in turn."""
SWAY = 0.3
"""Joints are up to so much (rad) off the default pose, bodies of obstacles within so many times 10 m."""
OUTPUTS = ("true_ranges", "directions_s", "shape_id", "class_id")


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """The command line."""

    robot: str = argument("g1", "preset of conf/robot")
    lidar: str = argument("mid360", "preset of conf/lidar; where it sits inside a mesh it sees nothing")
    obstacles: str = argument("moving", "preset of conf/obstacles")
    groups: tuple[int, ...] = argument((2,), "geom groups of the robot's file that hold the meshes")
    num_envs: tuple[int, ...] = argument((64, 256, 512), "environments", least=1)
    rays: int = argument(1000, "rays of a frame", least=1)
    threads: int = argument(1, "CPU threads", least=1)
    rounds: int = argument(7, "rounds in which each form is timed once", least=1)
    out: Path = argument(Path("outputs/robot_meshes"), "folder of the tables")


@dataclass
class Form:
    """A robot in one form: what rays hit, its sensor, and poses of its bodies."""

    world: World
    shapes: RayShapes
    sensor: SensorConfig
    states: list[mujoco.MjData]
    seconds: float

    @classmethod
    def of(cls, given: Arguments, groups: tuple[int, ...] | None, overrides: Sequence[str]) -> Form:
        """The robot as geoms of some groups; None: as it collides."""
        wanted = [] if groups is None else [f"+robot.ray_groups=[{','.join(map(str, groups))}]"]
        task = [*NO_TASK, f"robot={given.robot}", f"lidar={given.lidar}", f"obstacles={given.obstacles}"]
        env = build.assemble(config.compose([*task, f"lidar.num_rays={given.rays}", *wanted, *overrides])).env
        begin = time.perf_counter()
        world = build_world(env.robot, env.terrain, env.obstacles)
        shapes = ray_shapes(world, env.lidar.exclude_geoms, env.lidar.mount_body)
        for shape in shapes.shapes:
            getattr(shape.asset, "tree", None)  # is built when it is asked for
        seconds = time.perf_counter() - begin
        return cls(world, shapes, env.lidar, _states(world, POSES), seconds)

    def caster(self, num_envs: int, threads: int = 1) -> Callable[[int], LidarFrame]:
        """Casts a frame in many environments, the robot in the next of the poses."""
        bodies = list(self.shapes.bodies)
        scene = RayScene(self.shapes.shapes, num_envs, len(bodies), num_threads=threads)
        body = self.sensor.mount_body
        carrier = self.shapes.base if body is None else bodies.index(self.world.model.body(body).id)
        lidar = Lidar(self.sensor, self.sensor.scan_pattern(), scene, carrier, outputs=OUTPUTS)
        poses = [
            tuple(torch.from_numpy(value[bodies]).float().expand(num_envs, -1, -1) for value in (data.xpos, data.xquat))
            for data in self.states
        ]

        def cast(k: int) -> LidarFrame:
            scene.set_poses(*poses[k % POSES])
            return lidar.cast(0.1 * (k + 1))

        return cast

    def seen(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Ranges, those by mj_ray of the geoms that rays can hit, and whether the robot is hit, (R,) of all poses."""
        cast, columns = self.caster(1), []
        for k, data in enumerate(self.states):
            frame = cast(k)
            true = self._true_ranges(data, frame.directions_s[0].numpy().astype(np.float64))
            own = (frame.class_id[0] == HitClass.ROBOT).numpy()
            columns.append((frame.true_ranges[0].numpy().astype(np.float64), true, own))
        return tuple(np.concatenate(column) for column in zip(*columns, strict=True))

    def _true_ranges(self, data: mujoco.MjData, directions_s: np.ndarray) -> np.ndarray:
        """(R,) ranges from the sensor, infinite beyond its range."""
        model, sensor, kept = self.world.model, self.sensor, set(self.shapes.geom_names)
        carrier = self.world.base_body if sensor.mount_body is None else model.body(sensor.mount_body).id
        for k in range(model.ngeom):
            model.geom_group[k] = 0 if model.geom(k).name in kept else 5
        turn = data.xmat[carrier].reshape(3, 3)
        origin = data.xpos[carrier] + turn @ np.array(sensor.mount_pos, np.float64)
        rays = directions_s @ (turn @ matrices(np.array(sensor.quat))).T
        ranges, _ = mujoco_ranges(model, data, origin, rays, np.array([1, 0, 0, 0, 0, 0], np.uint8))
        return np.where(ranges > sensor.max_range, np.inf, ranges)


def _states(world: World, count: int) -> list[mujoco.MjData]:
    """Poses near the default one, the same for every form of a robot."""
    model, rng, found = world.model, np.random.default_rng(0), []
    for _ in range(count):
        data = mujoco.MjData(model)
        data.qpos[:] = world.rest_positions
        data.qpos[:7] = 0, 0, world.robot.base_height, 1, 0, 0, 0
        for name in world.robot.joints:
            data.joint(name).qpos += SWAY * rng.uniform(-1, 1)
        places = rng.uniform(-1, 1, (model.nmocap, 3))
        data.mocap_pos[:] = places * (10 * SWAY, 10 * SWAY, 0) + np.sign(places) * (1, 1, 0)
        mujoco.mj_forward(model, data)
        found.append(data)
    return found


def speed(given: Arguments, forms: dict[str, Form]) -> list[dict[str, object]]:
    """Time of a frame of both forms, and their ratio, by number of environments."""
    rows = []
    for num_envs in given.num_envs:
        casts = {name: form.caster(num_envs, given.threads) for name, form in forms.items()}
        times = paired_timings(casts, given.rounds)
        row: dict[str, object] = {"environments": num_envs}
        row |= {f"{name}, ms": 1e3 * times[name].median_cpu_s for name in forms}
        rows.append(row | {"meshes / primitives": str(paired_ratio(times["meshes"], times["primitives"], "cpu"))})
    return rows


def errors(forms: dict[str, Form]) -> list[dict[str, object]]:
    """Each form against mj_ray on the geoms that its rays can hit."""
    rows = []
    for name, form in forms.items():
        found, expected, own = form.seen()
        counted = ~(expected < form.sensor.min_range)  # nearer surfaces block a ray and return nothing
        if not counted.any():
            raise ValueError(f"lidar.mount: with {name} all rays end at once, inside of a geom; choose another mount")
        found, expected = found[counted], expected[counted]
        both = np.isfinite(found) & np.isfinite(expected)
        off = np.abs(found[both] - expected[both])
        wrong = (np.isfinite(found) != np.isfinite(expected)).sum() + (off > 1e-3).sum()
        rows.append(
            {"form": name, "shapes": len(form.shapes.shapes), "built in, s": form.seconds}
            | {"on the robot, %": 100.0 * own.sum() / len(found)}
            | {"other surface than mj_ray, %": 100.0 * wrong / len(found)}
            | {"largest error of the others, m": float(off[off <= 1e-3].max(initial=0.0))}
        )
    return rows


def differences(forms: dict[str, Form]) -> list[dict[str, object]]:
    """What the same rays see with primitives and with meshes."""
    (ranges, _, own), (others, _, others_own) = (forms[name].seen() for name in ("meshes", "primitives"))
    both = own & others_own
    off = np.abs(ranges[both] - others[both])
    return [
        {"robot in both, %": 100.0 * both.mean(), "in meshes alone, %": 100.0 * (own & ~others_own).mean()}
        | {"in primitives alone, %": 100.0 * (others_own & ~own).mean()}
        | {"median difference, m": float(np.median(off)) if len(off) else 0.0}
        | {"largest, m": float(off.max(initial=0.0))}
    ]


def main(given: Arguments, overrides: list[str]) -> None:
    """Measures, prints and writes."""
    torch.set_num_threads(given.threads)
    forms = {"primitives": Form.of(given, None, overrides), "meshes": Form.of(given, given.groups, overrides)}
    tables = [
        Table.of("speed", f"a frame of {given.rays} rays, CPU time", speed(given, forms)),
        Table.of("errors", "against mj_ray in float64", errors(forms)),
        Table.of("difference", "primitives beside meshes", differences(forms)),
    ]
    report(tables, about(given.threads), given.out)


command = Command(main, Arguments, __doc__, "of the robot and its sensor", (ValueError,))

if __name__ == "__main__":
    command()
