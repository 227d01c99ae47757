"""Obstacles from files: articulated things against MuJoCo's kinematics of their files, rays against mj_ray."""

import mujoco
import numpy as np
import pytest
import torch
from fields import make_field
from mj_rays import assert_rays_are_those_of_mj_ray

from omniperception.scene import ObstacleGroup, ObstaclesConfig, thing_file
from omniperception.scene.meshes import compiled, mesh_points

DOOR = """
<mujoco>
  <compiler angle="degree"/>
  <asset><mesh name="knob" vertex="0 0 0  0.1 0 0  0 0.06 0  0 0 0.2  0.1 0.06 0.2"/></asset>
  <worldbody>
    <body name="door" pos="0 0 0">
      <freejoint/>
      <geom name="post" type="cylinder" size="0.05 1" pos="-0.5 0 1"/>
      <geom name="paint" type="box" size="1 1 1" contype="0" conaffinity="0"/>
      <body name="leaf" pos="-0.45 0.02 0" euler="0 0 20">
        <joint name="hinge" axis="0 0 -1" range="-10 80"/>
        <geom type="box" size="0.4 0.02 0.9" pos="0.4 0 0.95"/>
        <geom name="grip" type="capsule" fromto="0.7 0.05 1 0.7 0.15 1" size="0.02"/>
        <geom name="turned" type="mesh" mesh="knob" pos="0.7 0.1 0.5" euler="0 0 35"/>
      </body>
      <body name="flap" pos="0 0.3 1.5" euler="90 0 0">
        <joint name="flap" axis="1 0 0" range="0 60"/>
        <geom name="board" type="box" size="0.2 0.1 0.02" pos="0.05 0 -0.2"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
URDF = """
<robot name="cart">
  <link name="bed"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><origin xyz="0 0 0.3"/><geometry><box size="1 0.6 0.2"/></geometry></collision></link>
  <link name="lid"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><origin xyz="0.2 0 0"/><geometry><box size="0.4 0.5 0.04"/></geometry></collision></link>
  <joint name="lid" type="revolute"><parent link="bed"/><child link="lid"/><origin xyz="-0.5 0 0.5"/><axis xyz="0 1 0"/>
    <limit lower="-1.2" upper="0" effort="1" velocity="1"/></joint>
</robot>
"""
FREQUENCY, N, DT = 0.4, 4, 0.01


@pytest.fixture
def files(tmp_path, monkeypatch):
    """A working directory with two articulated things and two meshes."""
    for cached in (thing_file.parts_of, compiled, mesh_points):  # by name, whatever the working directory
        cached.cache_clear()
    monkeypatch.chdir(tmp_path)
    (tmp_path / "door.xml").write_text(DOOR)
    (tmp_path / "cart.urdf").write_text(URDF)
    for name, (x, y, z) in {"ramp": (0.6, 0.4, 0.3), "slab": (0.2, 0.5, 0.9)}.items():
        corners = [(0, 0, 0), (x, 0, 0), (0, y, 0), (0, 0, z), (0, y, z)]
        sides = ((1, 3, 2), (4, 2, 5), (2, 3, 5), (1, 2, 4), (1, 4, 5), (1, 5, 3))
        lines = ["v {} {} {}".format(*corner) for corner in corners] + ["f {} {} {}".format(*side) for side in sides]
        (tmp_path / f"{name}.obj").write_text("\n".join(lines) + "\n")
    return tmp_path


def field_of(group):
    field = make_field(ObstaclesConfig({"own": group}), N, seed=3)
    field.reset(torch.arange(N), torch.full((N, 2), 50.0))
    return field


@pytest.mark.parametrize(("file", "parts"), [("door.xml", 5), ("cart.urdf", 2)])
def test_parts_are_where_mujoco_has_those_of_the_file(files, file, parts):
    group = ObstacleGroup("compound", 1, poses=[[2.0, 1.0, 50.0]], file=file, swing_frequency=FREQUENCY)
    field = field_of(group)
    cycle = field.articulation.cycle.clone()
    for _ in range(30):
        field.travel(DT, 1, torch.zeros(N, 2))
    model = mujoco.MjModel.from_xml_path(file)
    data, yaw = mujoco.MjData(model), np.radians(50.0)
    root = np.array([[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
    touched = [k for k in range(model.ngeom) if model.geom_contype[k]]
    assert field.pos_w.shape == (N, parts, 3) and len(touched) == parts
    moved = set()
    for env in range(N):
        phase = 2 * np.pi * (float(cycle[env, 0]) + 30 * DT * FREQUENCY)
        for joint in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE):
            low, high = model.jnt_range[joint]
            data.qpos[model.jnt_qposadr[joint]] = (low + high) / 2 + (high - low) / 2 * np.sin(phase)
            moved.add(round(float(data.qpos[model.jnt_qposadr[joint]]), 6))
        mujoco.mj_kinematics(model, data)
        for part, geom in enumerate(touched):
            middle, turn = data.geom_xpos[geom], data.geom_xmat[geom].reshape(3, 3)
            if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
                vertices = model.mesh_vert  # the file's only mesh
                middle = middle + turn @ (vertices.min(0) + vertices.max(0)) / 2
            at = root @ middle + [2.0, 1.0, 0.0]
            np.testing.assert_allclose(field.pos_w[env, part].numpy(), at, atol=1e-6)
            matrix = np.zeros(9)
            mujoco.mju_quat2Mat(matrix, field.quat_w[env, part].numpy())
            np.testing.assert_allclose(matrix.reshape(3, 3), root @ turn, atol=1e-6)
    assert len(moved) >= N  # every environment has its own swing


def test_rays_hit_them_as_mj_ray_does_and_each_environment_has_its_own(files, make_env):
    own = "+obstacles.groups={thing:{kind:compound,count:2,files:[door.xml,cart.urdf]},"
    own += "stone:{kind:mesh,count:4,files:[ramp.obj,slab.obj],present:[2,2]}}"
    env = make_env("perception=none", "lidar=none", "rewards=walk", "observations=walk", own, num_envs=6)
    env.step(torch.zeros(6, 12))
    active = env.obstacles.active[:, -4:]
    assert (active.sum(1) == 2).all() and len({tuple(row) for row in active.tolist()}) > 1
    half = env.obstacles.size[0, -4:]
    torch.testing.assert_close(half[0], half.new_tensor([0.3, 0.2, 0.15]))
    torch.testing.assert_close(half[1], half.new_tensor([0.1, 0.25, 0.45]))
    model, data = env.world.model, mujoco.MjData(env.world.model)
    data.qpos[:] = env.sim.qpos[0]
    data.mocap_pos[:], data.mocap_quat[:] = env.sim.mocap_pos[0], env.sim.mocap_quat[0]
    mujoco.mj_forward(model, data)
    rng, hit = np.random.default_rng(0), set()
    for pos in data.mocap_pos[data.mocap_pos[:, 2] > -1.0]:
        origins = pos + rng.normal(size=(300, 3)) * [1.5, 1.5, 0.3]
        origins[:, 2] = np.abs(origins[:, 2])
        towards = pos + rng.uniform(-0.3, 0.3, (300, 3)) - origins
        geoms = assert_rays_are_those_of_mj_ray(env.world, data, origins, towards)
        hit |= {model.geom(int(geom)).name for geom in geoms if geom >= 0}
    assert {"obstacle_thing_0_leaf_2", "obstacle_thing_0_turned", "obstacle_thing_1_lid_1"} <= hit


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (('type="box" size="0.2', 'type="ellipsoid" size="0.2'), "geom board of door.xml is of type ellipsoid"),
        (('axis="1 0 0" range="0 60"', 'type="slide" axis="1 0 0"'), "board of door.xml is moved by flap; expected"),
        ((' range="0 60"', ""), "hinge flap of door.xml has no range"),
        (("<worldbody>", "<worldbdy>"), "file=door.xml cannot be read"),
    ],
)
def test_what_is_wrong_with_a_file_is_said_in_one_line(files, change, message):
    assert change[0] in DOOR
    (files / "door.xml").write_text(DOOR.replace(*change))
    compiled.cache_clear()
    thing_file.parts_of.cache_clear()
    with pytest.raises(ValueError, match=message) as error:
        ObstacleGroup("compound", 1, file="door.xml")
    assert "\n" not in str(error.value)
