"""Robots of meshes: bodies touch their convex hulls, rays hit their triangles, and instances share one tree."""

import json
import sys
from dataclasses import asdict
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
import yaml

from benchmarks import robot_meshes
from omnilidar import RayScene
from omnilidar.mujoco import geom_shapes
from omniperception import build, config
from omniperception.commands.robot_check import NO_TASK
from omniperception.robots.stand import flat_world
from omniperception.scene import RobotConfig
from omniperception.scene.rays import ray_shapes

sys.path.insert(0, str(Path(__file__).parents[1]))
from own_robots import skip_if_not_fetched

CORNERS = [(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)]
"""Of an L, m: (1.4, 1.4) lies in its convex hull and not in it."""
MESHY = """
<mujoco model="meshy">
  <asset><mesh name="bracket" file="bracket.obj" scale="0.1 0.1 0.1"/></asset>
  <default>
    <default class="look"><geom type="mesh" mesh="bracket" contype="0" conaffinity="0" group="2" mass="0"/></default>
    <default class="touch"><geom type="mesh" mesh="bracket" group="3" mass="1"/></default>
  </default>
  <worldbody>
    <body name="base" pos="0 0 0.4">
      <freejoint/>
      <geom name="trunk" class="touch" pos="0 0 0.3"/>
      <geom name="shell" class="look" pos="-0.1 0.05 0" euler="20 30 40"/>
      <body name="left" pos="0 0.3 0">
        <joint name="left" axis="0 1 0" range="-1 1"/>
        <geom name="left_look" class="look"/>
        <geom name="left_foot" type="sphere" size="0.03" pos="0 0 -0.3" group="3" mass="0.5"/>
      </body>
      <body name="right" pos="0 -0.3 0">
        <joint name="right" axis="0 1 0" range="-1 1"/>
        <geom name="right_look" class="look" pos="0.02 0 0"/>
        <geom name="right_foot" type="sphere" size="0.03" pos="0 0 -0.3" group="3" mass="0.5"/>
      </body>
      <body name="probe">
        <joint name="probe" type="slide" axis="0 0 1" range="-2 2"/>
        <geom name="probe" type="sphere" size="0.005" pos="0.14 0.14 0.32" group="4" mass="0.1"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


def bracket() -> str:
    """An upright L-shaped prism, 0.5 m high, as OBJ."""
    lines = [f"v {x} {y} {z}" for z in (0.0, 0.5) for x, y in CORNERS]
    tops = [(1, k, k + 1) for k in range(2, 6)]  # the corner at the origin sees all others
    lines += [f"f {a} {c} {b}" for a, b, c in tops] + [f"f {a + 6} {b + 6} {c + 6}" for a, b, c in tops]
    for k in range(1, 7):
        after = k % 6 + 1
        lines += [f"f {k} {after} {after + 6}", f"f {k} {after + 6} {k + 6}"]
    return "\n".join(lines) + "\n"


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    """The robot of MESHY, rays hitting what it is drawn with and the trunk that it collides with."""
    folder = tmp_path_factory.mktemp("meshy")
    (folder / "bracket.obj").write_text(bracket())
    (folder / "meshy.xml").write_text(MESHY)
    joints = ("left", "right", "probe")
    return RobotConfig(
        file=str(folder / "meshy.xml"),
        base="base",
        joints=joints,
        default_joint_pos=dict.fromkeys(joints, 0.0),
        base_height=0.33,
        **dict.fromkeys(("kp", "kv", "torque_limits", "action_scale"), 1.0),
        foot_geoms=("left_foot", "right_foot"),
        penalized_geoms=("trunk",),
        footprint=(0.1, 0.3),
        footing=0.4,
        outline=(0.5, 0.5, 0.5),
        height=0.5,
        radius=0.4,
        min_base_height=0.1,
        ray_groups=(2,),
    )


def assert_rays_are_mj_rays(world, rng, poses, rays):
    """Rays from around the robot, at its geoms, against mj_ray on the geoms that rays can hit; returns geoms met."""
    model, shapes = world.model, ray_shapes(world)
    hidden = [k for k in range(model.ngeom) if model.geom(k).name not in shapes.geom_names]
    model.geom_group[hidden] = 5
    seen = [k for k in range(model.ngeom) if k not in hidden and model.geom(k).name != "ground"]
    scene = RayScene(shapes.shapes, 1, len(shapes.bodies), num_threads=1)
    groups, geom, met, agree, total = np.array([1, 1, 1, 1, 1, 0], np.uint8), np.zeros(1, np.int32), set(), 0, 0
    for _ in range(poses):
        data = mujoco.MjData(model)
        data.qpos[:7] = *rng.uniform(-0.3, 0.3, 2), rng.uniform(0.5, 1.0), *rng.normal(size=4)
        for k in range(1, model.njnt):
            data.qpos[model.jnt_qposadr[k]] = rng.uniform(*model.jnt_range[k])
        mujoco.mj_forward(model, data)
        bodies = list(shapes.bodies)
        scene.body_pos[0] = torch.tensor(data.xpos[bodies], dtype=torch.float32)
        scene.body_quat[0] = torch.tensor(data.xquat[bodies], dtype=torch.float32)
        origins = (data.qpos[:3] + rng.uniform(-1.5, 1.5, (rays, 3))).astype(np.float32)
        aims = data.geom_xpos[rng.choice(seen, rays)] + rng.normal(size=(rays, 3)) * 0.03
        directions = aims - origins
        directions = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)
        hits = scene.cast(torch.tensor(origins)[None], torch.tensor(directions)[None])
        rows = zip(origins, directions, hits.ranges[0].tolist(), hits.shape_id[0].tolist(), strict=True)
        for origin, direction, found, shape in rows:
            ray = (origin.astype(np.float64), direction.astype(np.float64))
            expected = mujoco.mj_ray(model, data, *ray, groups, 1, -1, geom)
            name = model.geom(int(geom[0])).name if geom[0] >= 0 else None
            total += 1
            if name == (shapes.geom_names[shape] if shape >= 0 else None):
                agree += 1
                assert found == pytest.approx(np.inf if name is None else expected, abs=1e-4)
            met |= {name}
    assert agree / total > 0.99  # the others graze an edge
    return met


def test_rays_hit_the_triangles_that_mj_ray_hits(robot):
    met = assert_rays_are_mj_rays(flat_world(robot), np.random.default_rng(0), poses=4, rays=150)
    assert {"shell", "left_look", "right_look"} <= met and not {"trunk", "probe", "left_foot"} & met


def test_bodies_touch_the_hull_and_rays_pass_through_the_notch(robot):
    """A small sphere in the notch of the L: inside its hull, 0.04 m from the nearest wall of it."""
    model = robot.compiled()
    data = mujoco.MjData(model)
    data.qpos[:] = model.qpos0
    mujoco.mj_forward(model, data)
    trunk, probe = model.geom("trunk").id, model.geom("probe").id
    assert mujoco.mj_geomDistance(model, data, trunk, probe, 1.0, None) < 0
    origin, down = data.geom_xpos[probe] + [0, 0, 0.2], np.array([0.0, 0.0, -1.0])
    geom, groups = np.zeros(1, np.int32), np.array([0, 0, 0, 1, 0, 0], np.uint8)
    assert mujoco.mj_ray(model, data, origin, down, groups, 1, -1, geom) == -1
    shapes = geom_shapes(model, geoms=[trunk])
    scene = RayScene(shapes.shapes, 1, 1, num_threads=1)
    scene.body_pos[0, 0], scene.body_quat[0, 0] = torch.from_numpy(data.body("base").xpos), torch.tensor([1.0, 0, 0, 0])
    beside = origin - [0.09, 0, 0]  # over the arm of the L
    both = torch.tensor(np.array([[origin, beside], [down, down]]), dtype=torch.float32)
    hits = scene.cast(both[:1], both[1:])
    assert not np.isfinite(hits.ranges[0, 0].item())
    expected = mujoco.mj_ray(model, data, beside, down, groups, 1, -1, geom)
    assert expected > 0 and hits.ranges[0, 1].item() == pytest.approx(expected, abs=1e-6)


def test_instances_share_one_tree(robot):
    shapes = ray_shapes(flat_world(robot))
    assets = [shape.asset for name, shape in zip(shapes.geom_names, shapes.shapes, strict=True) if "look" in name]
    assert len(assets) == 2 and assets[0] is assets[1]
    shell = shapes.shapes[shapes.geom_names.index("shell")].asset
    assert shell is assets[0]


def test_the_benchmark_compares_both_forms(robot, tmp_path, capsys):
    """Both forms see what mj_ray sees; a robot that is a mesh in both differs by its shell and legs."""
    preset = {**asdict(robot), "mounts": {"back": {"pos": [0.0, 0.0, 0.5]}}}
    (tmp_path / "robot").mkdir()
    (tmp_path / "robot" / "meshy.yaml").write_text("# A robot.\n" + yaml.safe_dump(json.loads(json.dumps(preset))))
    given = ("robot=meshy", "num_envs=2", "rays=100", "rounds=1", "obstacles=static", "lidar=vlp16", f"out={tmp_path}")
    robot_meshes.command([*given, "--config-dir", str(tmp_path)])
    printed = capsys.readouterr().out
    assert "meshes / primitives" in printed and "other surface than mj_ray" in printed
    rows = json.loads((tmp_path / "errors.json").read_text())["rows"]
    assert [row["form"] for row in rows] == ["primitives", "meshes"]
    for row in rows:
        assert row["other surface than mj_ray, %"] < 1.0 and row["largest error of the others, m"] < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("name", ["go1", "g1"])
def test_rays_hit_the_meshes_of_published_robots(name):
    skip_if_not_fetched(name)
    robot = build.assemble(config.compose([*NO_TASK, f"robot={name}", "+robot.ray_groups=[2]", "lidar=none"])).env.robot
    met = assert_rays_are_mj_rays(flat_world(robot), np.random.default_rng(1), poses=3, rays=300)
    assert len(met) > 10
