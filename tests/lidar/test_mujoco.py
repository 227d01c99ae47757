"""A ray scene from a compiled MuJoCo model: every geom type, bodies, classes and poses."""

import mujoco
import numpy as np
import pytest
import torch

from benchmarks.harness.reference import mujoco_ranges
from omniperception.lidar import MujocoScene, RayScene, ShapeKind, geom_shapes

XML = """
<mujoco>
  <asset>
    <mesh name="wedge" vertex="0 0 0  1 0 0  0 1 0  0 0 1  1 0 1"/>
    <hfield name="hills" nrow="3" ncol="4" size="1 2 0.5 0.1" elevation="0 1 0 2  1 0 3 0  0 1 2 0"/>
    <material name="glass" rgba="1 1 1 0"/>
  </asset>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1"/>
    <geom name="mat" type="plane" size="1 2 1" pos="4 0 0.2"/>
    <geom name="window" type="box" size="1 1 1" pos="0 0 1" material="glass"/>
    <geom name="air" type="box" size="1 1 1" pos="0 0 1" rgba="1 1 1 0"/>
    <geom name="terrain" type="hfield" hfield="hills" pos="-4 0 0"/>
    <body name="shelf" pos="0 3 1" euler="0 0 30">
      <geom name="board" type="box" size="0.5 0.2 0.1" pos="0.2 0 0"/>
    </body>
    <body name="robot" pos="0 0 1">
      <freejoint/>
      <geom name="trunk" type="ellipsoid" size="0.3 0.2 0.1"/>
      <body name="leg" pos="0.4 0 0">
        <joint type="hinge"/>
        <geom name="thigh" type="capsule" size="0.05 0.2" pos="0 0 -0.2"/>
        <body name="foot" pos="0 0 -0.5"><geom name="sole" type="cylinder" size="0.1 0.02"/></body>
      </body>
    </body>
    <body name="target" mocap="true" pos="2 2 1">
      <geom name="ball" type="sphere" size="0.3"/>
      <body name="hat" pos="0 0 0.5"><geom name="brim" type="mesh" mesh="wedge"/></body>
    </body>
  </worldbody>
</mujoco>
"""
SEEN = ["floor", "mat", "terrain", "board", "trunk", "thigh", "sole", "ball", "brim"]


@pytest.fixture(scope="module")
def model():
    return mujoco.MjModel.from_xml_string(XML)


def random_data(model, seed):
    rng = np.random.default_rng(seed)
    data = mujoco.MjData(model)
    data.qpos[:] = rng.normal(size=model.nq) + np.eye(model.nq)[2] * 2.0
    data.mocap_pos[:], data.mocap_quat[:] = rng.uniform(2, 4, 3), rng.normal(size=4)
    mujoco.mj_forward(model, data)
    return data, rng


def names(model, ids):
    return [model.geom(k).name for k in ids]


def test_geoms_and_bodies_are_in_the_models_order(model):
    scene = MujocoScene(model)
    assert names(model, scene.geom_ids) == SEEN  # without what is fully transparent, as in mj_ray
    assert [model.body(k).name for k in scene.body_ids] == ["robot", "leg", "foot", "target", "hat"]
    kinds = ["PLANE", "PLANE", "HEIGHTFIELD", "BOX", "ELLIPSOID", "CAPSULE", "CYLINDER", "SPHERE", "MESH"]
    assert [shape.kind for shape in scene.shapes] == [ShapeKind[kind] for kind in kinds]
    assert [shape.body for shape in scene.shapes] == [-1, -1, -1, -1, 0, 1, 2, 3, 4]
    assert isinstance(scene, RayScene) and scene.body_pos.dtype == torch.float64


def test_classes_and_geoms_are_chosen_by_rule(model):
    found = geom_shapes(model, class_of=lambda k: int(model.geom_bodyid[k]), geoms=range(model.ngeom))
    assert [shape.class_id for shape in found.shapes] == model.geom_bodyid.tolist()
    assert names(model, found.geom_ids)[2:4] == ["window", "air"]
    few = geom_shapes(model, geoms=[model.geom("ball").id])
    assert [model.body(k).name for k in few.body_ids] == ["target"] and few.shapes[0].class_id == 0


@pytest.mark.parametrize("seed", [0, 1])
def test_rays_hit_what_mj_ray_hits(model, seed):
    data, rng = random_data(model, seed)
    scene = MujocoScene(model, num_envs=2)
    scene.copy_data(data)
    origins = rng.uniform((-5, -3, 0.1), (5, 5, 3), (1500, 3))
    aims = data.geom_xpos[rng.choice(scene.geom_ids, 1500)] + rng.normal(size=(1500, 3)) * 0.1
    directions = aims - origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    hits = scene.cast(*(torch.from_numpy(v).expand(2, -1, 3) for v in (origins, directions)))
    ranges, geoms = mujoco_ranges(model, data, origins, directions)
    for env in range(2):
        shape = hits.shape_id[env].numpy()
        np.testing.assert_array_equal(np.array([*scene.geom_ids, -1])[shape], geoms)
        np.testing.assert_allclose(hits.ranges[env].numpy(), ranges, rtol=1e-5, atol=1e-5)
    assert set(geoms) >= {*scene.geom_ids, -1}


def test_poses_of_environments_come_from_arrays(model):
    states = [random_data(model, seed)[0] for seed in range(3)]
    scene = MujocoScene(model, num_envs=3)
    xpos, xquat = np.stack([d.xpos for d in states]), np.stack([d.xquat for d in states])
    scene.copy_poses(xpos, torch.from_numpy(xquat))
    np.testing.assert_array_equal(scene.body_pos.numpy(), xpos[:, list(scene.body_ids)])
    np.testing.assert_array_equal(scene.body_quat.numpy(), xquat[:, list(scene.body_ids)])


def test_a_signed_distance_field_is_refused(model):
    copy = mujoco.MjModel.from_xml_string(XML)
    copy.geom_type[copy.geom("ball").id] = mujoco.mjtGeom.mjGEOM_SDF
    with pytest.raises(ValueError, match=r"\('ball'\) is of type sdf, which rays cannot hit: make it a mesh"):
        MujocoScene(copy)
