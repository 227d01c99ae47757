"""A ray scene from a compiled MuJoCo model: every geom type, bodies, classes and poses."""

import mujoco
import numpy as np
import pytest
import torch

from benchmarks.harness.reference import mujoco_ranges
from omnilidar import MujocoScene, RayScene, ShapeKind, geom_shapes

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


def worlds_of(model, count):
    """Simulations that differ, rays, and the ranges that mj_ray finds in each."""
    datas = [random_data(model, seed)[0] for seed in range(count)]
    rng = np.random.default_rng(9)
    origins, directions = rng.uniform((-5, -5, 0.3), (5, 5, 3), (count, 500, 3)), rng.normal(size=(count, 500, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    return datas, origins, directions


def check_against_mj_ray(scene, models, datas, origins, directions):
    """Hits, misses and ranges up to 50 m, where poses went through float32."""
    got = scene.cast(origins.astype(np.float32), directions.astype(np.float32), max_range=50.0).ranges.numpy()
    worlds = zip(models, datas, origins, directions, strict=True)
    wanted = np.stack([mujoco_ranges(*world)[0] for world in worlds])
    wanted[(wanted < 0) | (wanted > 50.0)] = np.inf
    assert np.isfinite(wanted).mean() > 0.4
    np.testing.assert_allclose(got, wanted, rtol=0.0, atol=2e-5)


def test_worlds_of_mujoco_warp_are_environments_with_sizes_of_their_own(model):
    """Against mj_ray in a model of each world."""
    mjw = pytest.importorskip("mujoco_warp")
    wp = pytest.importorskip("warp")
    datas, origins, directions = worlds_of(model, 3)
    batch = mjw.make_data(model, nworld=3)
    for name in ("xpos", "xquat"):
        getattr(batch, name).assign(np.stack([getattr(data, name) for data in datas]).astype(np.float32))
    sizes = np.repeat(model.geom_size[None], 3, 0) * np.array([1.0, 1.3, 0.8])[:, None, None]
    others = [mujoco.MjModel.from_xml_string(XML) for _ in datas]
    primitives = [k for k in range(model.ngeom) if int(model.geom_type[k]) in range(2, 7)]
    for own, size in zip(others, sizes, strict=True):
        own.geom_size[primitives] = size[primitives]
        own.geom_rbound[primitives], own.geom_aabb[primitives, 3:] = 5.0, 5.0
    scene = MujocoScene(model, num_envs=3)
    scene.copy_data(batch)
    scene.copy_sizes(wp.array(sizes.astype(np.float32), dtype=wp.vec3))
    check_against_mj_ray(scene, others, datas, origins, directions)
    with pytest.raises(ValueError, match=r"geom_size must be \(11, 3\) or \(3, 11, 3\), got \(2, 11, 3\)"):
        scene.copy_sizes(sizes[:2])


def test_a_batch_of_mjx_is_read_as_it_is(model):
    mjx = pytest.importorskip("mujoco.mjx")
    jax = pytest.importorskip("jax")
    simple = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><geom type='plane' size='0 0 1'/><body pos='0 0 1'><freejoint/><geom size='0.3'/></body>"
        "</worldbody></mujoco>"
    )
    heights = np.array([1.0, 2.0, 3.0])
    qpos = np.tile(simple.qpos0, (3, 1))
    qpos[:, 2] = heights
    on_device, data = mjx.put_model(simple), mjx.make_data(simple)
    batch = jax.vmap(lambda q: mjx.kinematics(on_device, data.replace(qpos=q)))(qpos)
    scene = MujocoScene(simple, num_envs=3)
    scene.copy_data(batch)
    start = np.broadcast_to(np.array([0.0, 0.0, 10.0]), (3, 1, 3))
    hits = scene.cast(start, np.broadcast_to(np.array([0.0, 0.0, -1.0]), (3, 1, 3)), max_range=20.0)
    assert np.allclose(hits.ranges.numpy()[:, 0], 10.0 - heights - 0.3, atol=1e-5)


def test_a_state_tensor_of_isaac_gyms_layout_goes_in_as_it_is(model):
    """A row of 13 for each body of each environment, (x, y, z, w), environments beside each other."""
    datas, origins, directions = worlds_of(model, 3)
    state = torch.zeros(3 * model.nbody, 13)
    spread = torch.tensor([[0.0, 0.0, 0.0], [20.0, 0.0, 0.0], [0.0, 20.0, 0.0]])
    for env, rows in enumerate(state.view(3, model.nbody, 13)):
        rows[:, :3] = torch.from_numpy(datas[env].xpos) + spread[env]
        rows[:, 3:7] = torch.from_numpy(datas[env].xquat)[:, [1, 2, 3, 0]]
    found = geom_shapes(model)
    scene = RayScene(found.shapes, 3, len(found.body_ids))
    bodies = state.view(3, -1, 13)[:, list(found.body_ids)]
    scene.set_poses(bodies[..., :3] - spread[:, None], bodies[..., 3:7], order="xyzw")
    check_against_mj_ray(scene, [model] * 3, datas, origins, directions)


def test_a_signed_distance_field_is_refused(model):
    copy = mujoco.MjModel.from_xml_string(XML)
    copy.geom_type[copy.geom("ball").id] = mujoco.mjtGeom.mjGEOM_SDF
    with pytest.raises(ValueError, match=r"\('ball'\) is of type sdf, which rays cannot hit: make it a mesh"):
        MujocoScene(copy)


def rock(points, faces, collides=True):
    """A model of one mesh; without faces MuJoCo makes it the convex hull of its points."""
    spec, shell = mujoco.MjSpec(), mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    mesh = spec.add_mesh(name="rock", uservert=points.ravel(), userface=np.ravel(faces).astype(int))
    mesh.inertia = shell if len(faces) else mesh.inertia
    geom = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="rock", quat=(0.9, 0.3, 0.1, 0.3))
    geom.contype = geom.conaffinity = int(collides)
    return spec.compile()


def test_a_hull_is_what_mj_ray_hits_of_the_convex_mesh_of_the_same_points():
    """Of a mesh that is open and has points in its inside."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(25, 3)) * (0.5, 0.3, 0.4)
    crumpled, convex = rock(points, rng.permutation(24).reshape(8, 3)), rock(points, [])
    origins = rng.uniform(-2, 2, (1500, 3))
    directions = rng.normal(size=(1500, 3)) * 0.6 - origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    data = mujoco.MjData(convex)
    mujoco.mj_kinematics(convex, data)
    expected, _ = mujoco_ranges(convex, data, origins, directions)
    rays = [torch.from_numpy(v)[None] for v in (origins, directions)]
    hits = RayScene(geom_shapes(crumpled, hulls=[0]).shapes, 1, 0).cast(*rays, normals=True)
    ranges = hits.ranges[0].numpy()
    grazing = np.isinf(ranges) != np.isinf(expected)
    assert grazing.mean() < 0.003 and 0.2 < np.isfinite(expected).mean() < 0.9
    np.testing.assert_allclose(ranges[~grazing], expected[~grazing], rtol=1e-5, atol=1e-5)
    seen = np.isfinite(ranges) & (np.linalg.norm(origins, axis=1) > 1.5)  # from outside, where it turns to the ray
    assert ((hits.normals_w[0].numpy() * directions).sum(1)[seen] < 0).all()
    assert not np.allclose(RayScene(geom_shapes(crumpled).shapes, 1, 0).cast(*rays).ranges[0].numpy(), ranges)


def test_a_mesh_that_nothing_can_touch_has_no_hull():
    crumpled = rock(np.random.default_rng(0).normal(size=(9, 3)), np.arange(9).reshape(3, 3), collides=False)
    with pytest.raises(ValueError, match=r"mesh 0 \('rock'\) has no convex hull"):
        geom_shapes(crumpled, hulls=[0])
