"""A ray scene from a Newton model: every kind of shape, worlds, bodies, cloth; against Newton's own rays."""

import numpy as np
import pytest
import torch

from benchmarks.harness.reference import mujoco_ranges
from omnilidar import NewtonScene, RayScene, Shape, ShapeKind, TriangleMesh

newton = pytest.importorskip("newton")
wp = pytest.importorskip("warp")

WORLDS, PLANE_REACH = 3, 500.0
HEIGHTS = np.random.default_rng(2).uniform(-0.3, 0.8, (5, 7))


def at(x, y, z, roll=0.0, pitch=0.0, yaw=0.0):
    return wp.transform((x, y, z), wp.quat_rpy(float(roll), float(pitch), float(yaw)))


def robot_and_things(trunk=0.3):
    builder = newton.ModelBuilder()
    base = builder.add_body(label="robot/base", xform=at(0, 0, 1))
    builder.add_shape_box(base, hx=trunk, hy=0.2, hz=0.1)
    builder.add_shape_capsule(base, xform=at(0.4, 0, -0.2, 0.3, 0.2, 0.1), radius=0.05, half_height=0.2)
    ball = builder.add_body(label="robot/ball", xform=at(2, 1, 1))
    builder.add_shape_sphere(ball, radius=0.4)
    builder.add_shape_cylinder(ball, xform=at(0, 0, 0.8, 0.5), radius=0.2, half_height=0.3)
    builder.add_shape_ellipsoid(-1, xform=at(-2, 1, 1, 0.5), rx=0.5, ry=0.3, rz=0.2)
    box = newton.Mesh.create_box(0.3, 0.4, 0.5)
    builder.add_shape_mesh(-1, xform=at(-2, -2, 1, 0.5, 0.3), mesh=box, scale=(1.0, 2.0, 0.5))
    builder.add_shape_convex_hull(-1, xform=at(2, -2, 1, 0.5, 0.3, 0.4), mesh=box)
    return builder


def model_of(*worlds, ground=True):
    builder = newton.ModelBuilder()
    if ground:
        builder.add_ground_plane()
    for k, world in enumerate(worlds):
        builder.add_world(world, xform=at(1.0 * k, 2.0 * k, 0))
    return builder.finalize(device="cpu")


def random_rays(num_envs, count, low=0.1):
    rng = np.random.default_rng(1)
    origins = rng.uniform((-3, -3, low), (5, 6, 2.5), (num_envs, count, 3)).astype(np.float32)
    directions = rng.normal(size=origins.shape)
    return origins, (directions / np.linalg.norm(directions, axis=-1, keepdims=True)).astype(np.float32)


def newtons_ranges(model, origins, directions):
    """(num_envs, R) m, infinite for a miss, and Newton's id of what was hit, -1 for one."""
    flat = [wp.array(rays.reshape(-1, 3), dtype=wp.vec3) for rays in (origins, directions)]
    worlds = np.repeat(np.arange(len(origins), dtype=np.int32), origins.shape[1])
    dist, shape = wp.zeros(len(worlds), dtype=float), wp.zeros(len(worlds), dtype=wp.int32)
    newton.intersect_ray(
        model,
        ray_origins=flat[0],
        ray_directions=flat[1],
        ray_worlds=wp.array(worlds),
        out_dist=dist,
        out_shape_id=shape,
        fast_math=False,
    )
    ranges, shape = (out.numpy().reshape(origins.shape[:2]) for out in (dist, shape))
    return np.where(ranges < 0, np.inf, ranges), shape


@pytest.mark.parametrize("same", [True, False])
def test_rays_hit_what_newtons_hit(same):
    """Bodies anywhere, worlds with sizes of their own; planes end where Newton's rays do."""
    worlds = [robot_and_things(0.3 if same else 0.2 + 0.2 * k) for k in range(WORLDS)]
    model = model_of(*worlds)
    scene, state, rng = NewtonScene(model), model.state(), np.random.default_rng(0)
    poses = state.body_q.numpy()
    poses[:, :3] += 0.3 * rng.normal(size=(len(poses), 3))
    quat = rng.normal(size=(len(poses), 4))
    poses[:, 3:] = quat / np.linalg.norm(quat, axis=1, keepdims=True)
    state.body_q.assign(poses)
    scene.copy_state(state)
    model.bvh_refit_shapes(state)
    origins, directions = random_rays(WORLDS, 5000)
    hits = scene.cast(origins, directions, max_range=PLANE_REACH)
    wanted, shape = newtons_ranges(model, origins, directions)
    wanted[wanted > PLANE_REACH] = np.inf
    got, hit = hits.ranges.numpy(), np.isfinite(wanted)
    assert np.array_equal(np.isfinite(got), hit) and hit.mean() > 0.4
    assert np.abs(got - wanted)[hit].max() < 2e-4
    first, per_world = np.array(scene.shape_ids), model.shape_count // WORLDS
    ids = first[hits.shape_id.numpy()] + np.arange(WORLDS)[:, None] * per_world * (hits.shape_id.numpy() > 0)
    near_another = np.abs(got - wanted) > 1e-6
    assert np.array_equal(ids[hit & ~near_another], shape[hit & ~near_another])
    assert {int(k) for k in hits.shape_id.unique()} >= set(range(len(scene.shapes)))


def test_a_height_field_is_hit_where_its_triangles_are():
    """Newton's own rays pass through it; its triangles are divided from (row, col) to (row + 1, col + 1)."""
    field = newton.Heightfield(HEIGHTS, 5, 7, hx=2.0, hy=1.5)
    builder = newton.ModelBuilder()
    builder.add_shape_heightfield(heightfield=field, xform=at(0.5, 0.2, 1.0, 0.3, 0.2, 0.4))
    scene = NewtonScene(builder.finalize(device="cpu"))
    x, y = np.meshgrid(np.linspace(-2.0, 2.0, 7), np.linspace(-1.5, 1.5, 5))
    vertices = np.stack((x, y, HEIGHTS), -1).reshape(-1, 3)
    corner = (np.arange(4)[:, None] * 7 + np.arange(6)).reshape(-1, 1)
    triangles = np.concatenate((corner + np.array([0, 1, 8]), corner + np.array([0, 8, 7])))
    pose = at(0.5, 0.2, 1.0, 0.3, 0.2, 0.4)
    quat = (pose.q[3], pose.q[0], pose.q[1], pose.q[2])
    reference = RayScene(
        [Shape(ShapeKind.MESH, (), -1, (0.5, 0.2, 1.0), quat, asset=TriangleMesh(vertices, triangles))], 1, 0
    )
    up = np.array(wp.quat_rotate(pose.q, wp.vec3(0.0, 0.0, 1.0)))
    origins, _ = random_rays(1, 4000)
    origins = np.float32(np.array([0.5, 0.2, 1.0]) + 4 * up + 0.4 * origins - 0.4 * origins.mean(1))
    aims = np.float32(np.array([0.5, 0.2, 1.0]) + np.random.default_rng(5).normal(size=origins.shape) * 0.8)
    got = scene.cast(origins, aims - origins).ranges
    wanted = reference.cast(origins, aims - origins).ranges
    over = wanted.isfinite()
    assert over.float().mean() > 0.5
    sides = (got[over] < wanted[over] - 1e-4).float().mean()  # the walls, which triangles do not have
    assert torch.isfinite(got[over]).all() and sides < 0.2
    surface = over & (got >= wanted - 1e-4)
    assert (got - wanted)[surface].abs().max() < 1e-4


def test_cloth_is_where_its_particles_are():
    one = newton.ModelBuilder()
    grid = np.stack(np.meshgrid(np.arange(4.0), np.arange(3.0), indexing="ij"), -1).reshape(-1, 2)
    corner = (np.arange(3)[:, None] * 3 + np.arange(2)).reshape(-1, 1)
    triangles = np.concatenate((corner + np.array([0, 3, 4]), corner + np.array([0, 4, 1])))
    vertices = [wp.vec3(x, y, 0.0) for x, y in grid]
    one.add_cloth_mesh(
        pos=wp.vec3(0, 0, 1), rot=wp.quat_identity(), scale=1.0, vel=wp.vec3(0), vertices=vertices,
        indices=triangles.flatten().tolist(), density=0.1,
    )  # fmt: skip
    model = model_of(one, one, ground=False)
    scene, state = NewtonScene(model), model.state()
    places = state.particle_q.numpy()
    places += np.random.default_rng(0).normal(size=places.shape).astype(np.float32) * 0.2
    state.particle_q.assign(places)
    scene.copy_state(state)
    for env, own in enumerate(places.reshape(2, -1, 3)):
        origins = np.float32(own.mean(0) + [0, 0, 3.0] + np.random.default_rng(4).normal(size=(2, 500, 3)) * 0.5)
        aims = np.float32(own.mean(0) + np.random.default_rng(3).normal(size=(2, 500, 3)))
        got = scene.cast(origins, aims - origins).ranges[env]
        mesh = RayScene([Shape(ShapeKind.MESH, asset=TriangleMesh(own, triangles))], 2, 0)
        wanted = mesh.cast(origins, aims - origins).ranges[env]
        hit = wanted.isfinite()
        assert torch.equal(got.isfinite(), hit) and hit.float().mean() > 0.3
        assert (got - wanted)[hit].abs().max() < 1e-5


def test_bodies_and_shapes_have_the_names_and_classes_of_the_model():
    model = model_of(*[robot_and_things()] * 2)
    scene = NewtonScene(model, class_of=lambda k: k)
    assert scene.num_envs == 2 and [shape.class_id for shape in scene.shapes] == list(scene.shape_ids)
    assert scene.body_names == ("robot/base", "robot/ball")
    assert scene.link("ball") == 1 and len(scene.shapes_of(scene.link("robot/base"))) == 2
    with pytest.raises(ValueError, match=r"link 'leg' must be one of the bodies robot/base, robot/ball"):
        scene.link("leg")


def test_what_does_not_fit_is_said():
    lone = newton.ModelBuilder()
    lone.add_shape_sphere(-1, radius=0.2)
    with pytest.raises(ValueError, match="world 1 has other shapes than world 0"):
        NewtonScene(model_of(robot_and_things(), lone))
    cone = newton.ModelBuilder()
    cone.add_shape_cone(-1, radius=0.2, half_height=0.3, label="hat")
    model = model_of(cone)
    with pytest.raises(ValueError, match=r"shape \d \('.*hat'\) is of type cone, which rays cannot hit"):
        NewtonScene(model)
    assert len(NewtonScene(model, shapes=[0]).shapes) == 1


def test_a_model_without_worlds_is_one_environment():
    builder = newton.ModelBuilder()
    builder.add_shape_sphere(builder.add_body(xform=at(2, 0, 1)), radius=0.5)
    scene = NewtonScene(builder.finalize(device="cpu"))
    assert scene.num_envs == 1
    assert float(scene.cast(np.array([[[0, 0, 1.0]]]), np.array([[[1.0, 0, 0]]])).ranges) == pytest.approx(1.5)


MODEL = """
<mujoco><worldbody>
  <geom type="plane" size="0 0 1"/><geom type="box" size="0.5 0.4 1" pos="3 1 1" euler="0 0 30"/>
  <body pos="2 -1 1.5" euler="20 30 0"><freejoint/><geom type="capsule" size="0.2 0.4"/></body>
  <geom type="cylinder" size="0.3 0.5" pos="-2 0 0.5"/><geom type="sphere" size="0.4" pos="0 2 1"/>
</worldbody></mujoco>
"""


HILLS = """
<mujoco><asset>
  <hfield name="hills" nrow="3" ncol="4" size="1 2 0.8 0.1" elevation="0 1 0 2  1 0 3 0  0 1 2 0"/>
</asset><worldbody><geom type="hfield" hfield="hills" pos="1 4 0.4" euler="20 10 30"/></worldbody></mujoco>
"""


def ranges_of_file(path, xml, origins, directions):
    """Of the mesh that a file becomes, and by mj_ray; inf for a miss or beyond 15 m."""
    import mujoco

    path.write_text(xml)
    scene = RayScene([Shape(ShapeKind.MESH, asset=TriangleMesh.from_file(path))], 1, 0)
    got = scene.cast(origins[None], directions[None], max_range=15.0).ranges.numpy()[0]
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    wanted, _ = mujoco_ranges(model, data, origins, directions)
    return got, np.where(wanted > 15.0, np.inf, wanted)


def test_a_file_of_a_world_becomes_the_mesh_of_what_mj_ray_hits(tmp_path):
    """But for the polygons of what is round."""
    origins, directions = (rays[0].astype(np.float64) for rays in random_rays(1, 400, low=0.3))
    got, wanted = ranges_of_file(tmp_path / "world.xml", MODEL, origins, directions)
    both = np.isfinite(got) & np.isfinite(wanted)
    assert both.mean() > 0.3 and (np.isfinite(got) == np.isfinite(wanted)).mean() > 0.99
    assert np.quantile(np.abs(got[both] - wanted[both]), 0.97) < 0.02


def test_a_file_with_a_height_field_becomes_its_upper_side(tmp_path):
    """Of MuJoCo's, which is a solid, seen from above."""
    origins = np.random.default_rng(4).uniform((0.6, 3.0, 4.0), (1.4, 5.0, 4.0), (300, 3))
    got, wanted = ranges_of_file(tmp_path / "hills.xml", HILLS, origins, np.tile((0.0, 0.0, -1.0), (300, 1)))
    np.testing.assert_allclose(got, wanted, atol=1e-5)
    assert np.isfinite(got).all() and got.std() > 0.1


def test_a_file_that_is_no_model_is_one_line(tmp_path):
    (tmp_path / "broken.urdf").write_text("<robot>")
    with pytest.raises(ValueError, match=r"model .*broken.urdf cannot be read by Newton: ") as refused:
        TriangleMesh.from_file(tmp_path / "broken.urdf")
    assert "\n" not in str(refused.value)


USD = """#usda 1.0
(
    metersPerUnit = 1
    upAxis = "Z"
)
def Cube "Block" ( prepend apiSchemas = ["PhysicsCollisionAPI"] )
{
    double size = 1
    double3 xformOp:translate = (2, 0, 0.5)
    uniform token[] xformOpOrder = ["xformOp:translate"]
}
"""


def test_usd_is_read_where_its_importers_are(tmp_path):
    path = tmp_path / "block.usda"
    path.write_text(USD)
    try:
        import newton_usd_schemas  # noqa: F401
        import pxr  # noqa: F401
    except ImportError:
        with pytest.raises(ImportError, match=r"needs more of Newton: pip install 'newton\[importers\]'"):
            TriangleMesh.from_file(path)
    else:
        vertices = TriangleMesh.from_file(path).vertices
        np.testing.assert_allclose([vertices.min(0), vertices.max(0)], [[1.5, -0.5, 0.0], [2.5, 0.5, 1.0]], atol=1e-6)
