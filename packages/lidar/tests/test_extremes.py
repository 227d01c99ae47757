"""Extreme scenes and rays: every one has the result that the docstring of RayScene promises."""

import math

import numpy as np
import pytest
import torch
from lidar_helpers import CUBE, CUBE_FACES, cast, one

from omnilidar import HeightField, Lidar, LidarConfig, RayScene, Shape, ShapeKind, TriangleMesh, grid

K = ShapeKind
CUBE_MESH = TriangleMesh(CUBE, CUBE_FACES)
BLOCK = HeightField(2.0 * np.ones((4, 4)), 1.0, 1.0, base=0.5)
BODIES = [
    Shape(K.BOX, (1, 1, 1)),
    Shape(K.SPHERE, (1,)),
    Shape(K.CYLINDER, (1, 1)),
    Shape(K.CAPSULE, (1, 0.5)),
    Shape(K.ELLIPSOID, (1, 1, 1)),
    Shape(K.MESH, asset=CUBE_MESH),
    Shape(K.DEFORMABLE, asset=CUBE_MESH),
    Shape(K.HEIGHTFIELD, asset=BLOCK, pos=(0, 0, -1)),
]
EVERYTHING = [Shape(K.PLANE, pos=(0, 0, -4)), *BODIES]


def carried(shape, body=0):
    return Shape(shape.kind, shape.size, body, shape.pos, shape.quat, shape.class_id, shape.asset)


each_body = pytest.mark.parametrize("shape", BODIES, ids=lambda shape: shape.kind.name.lower())
every_shape = pytest.mark.parametrize("shape", EVERYTHING, ids=lambda shape: shape.kind.name.lower())


@pytest.mark.parametrize("away", [1e3, 1e6])
@every_shape
def test_far_from_the_origin_nothing_changes_in_float64(shape, away):
    rng = np.random.default_rng(0)
    origins, directions = rng.uniform(-3, 3, (500, 3)), rng.normal(size=(500, 3))
    place = away * np.array([0.6, -0.64, 0.48])
    near, far = (RayScene([carried(shape)], 1, 1, pose_dtype=torch.float64) for _ in range(2))
    far.body_pos[0, 0] = torch.from_numpy(place)
    here, there = cast(near, origins, directions).ranges, cast(far, origins + place, directions).ranges
    assert (here.isfinite() == there.isfinite()).all()
    torch.testing.assert_close(here, there, rtol=1e-5, atol=1e-5)


def test_far_from_the_origin_float32_costs_its_own_rounding():
    scene = RayScene([Shape(K.SPHERE, (0.5,), body=0)], 1, 1)
    scene.body_pos[0, 0] = torch.tensor([1000.3, 0, 0])
    rounding = abs(float(scene.body_pos[0, 0, 0].double()) - 1000.3)
    assert 0 < rounding < 6.2e-5
    ranges = cast(scene, (995.0, 0, 0), (1, 0, 0)).ranges
    assert float(ranges) == pytest.approx(float(scene.body_pos[0, 0, 0].double()) - 995.5, abs=1e-6)


@each_body
def test_a_sensor_inside_a_body_sees_its_far_side(shape):
    rng = np.random.default_rng(1)
    hits = cast(RayScene([shape], 1, 0), np.zeros((1000, 3)), rng.normal(size=(1000, 3)))
    assert (hits.shape_id == 0).all() and hits.ranges.min() > 0.49 and hits.ranges.max() < math.sqrt(3.0) + 1e-5


@each_body
def test_a_ray_that_starts_on_a_surface_hits_it_or_the_next_one(shape):
    scene = RayScene([shape], 1, 0)
    rng = np.random.default_rng(2)
    outward = rng.normal(size=(500, 3))
    outward[:, 2] = np.abs(outward[:, 2])  # under a height field's floor there is its base
    surface = cast(scene, np.zeros((500, 3)), outward).ranges[0].double().numpy()
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    points = outward * surface[:, None]
    away = cast(scene, points, outward).ranges[0]
    assert ((away == math.inf) | (away < 1e-5)).all()
    back = cast(scene, points, -outward).ranges[0].double().numpy()
    across = cast(scene, np.zeros((500, 3)), -outward).ranges[0].double().numpy() + surface
    assert ((back < 1e-5) | (np.abs(back - across) < 1e-4)).all()
    assert one([shape], (-1, 0, 0), (1, 0, 0)) in (0.0, 2.0)  # in exact numbers


@every_shape
@pytest.mark.parametrize("direction", [(0, 0, 0), (math.nan, 0, 1), (math.inf, 0, 0), (-0.0, 0.0, -0.0)])
def test_no_direction_is_a_miss(shape, direction):
    hits = cast(RayScene([shape], 1, 0), (0, 0, 3), direction, normals=True)
    assert float(hits.ranges) == math.inf and int(hits.shape_id) == -1 and not hits.normals_w.any()


@every_shape
def test_no_origin_is_a_miss_and_harms_no_other_ray(shape):
    origins = [(math.nan, 0, 3), (0.1, 0, 3), (0, -math.inf, 0), (0.1, 0, 3)]
    ranges = cast(RayScene([shape], 1, 0), origins, [(0, 0, -1)] * 4).ranges[0].tolist()
    assert ranges[0] == ranges[2] == math.inf and ranges[1] == ranges[3] < 8.0


@pytest.mark.parametrize("length", [1e-30, 1e-6, 1e6, 1e30])
def test_a_direction_of_any_other_length_is_one(length):
    scene = RayScene([Shape(K.SPHERE, (1.0,))], 1, 0)
    for dtype in (torch.float32, torch.float64):
        rays = [torch.tensor([[v]], dtype=dtype) for v in ((-3.0, 0.0, 0.0), (length, 0.0, 0.0))]
        assert float(scene.cast(*rays).ranges) == 2.0


@pytest.mark.parametrize(
    ("field", "value"),
    [
        *(
            (field, [0.0, value, 0.0, 0.0])
            for field in ("body_pos", "body_quat")
            for value in (math.nan, math.inf, -math.inf)
        ),
        *(("body_quat", [norm, 0.0, 0.0, 0.0]) for norm in (0.0, 1e-9, 0.99e-6, 1.01e6, 1e30)),
        *(("body_pos", [0.0, value, 0.0, 0.0]) for value in (1.01e15, -1e30)),
    ],
)
@every_shape
def test_a_body_without_a_pose_is_not_there(shape, field, value):
    scene = RayScene([carried(shape), Shape(K.SPHERE, (0.5,), pos=(0, 0, -50))], num_envs=2, num_bodies=1)
    pose = getattr(scene, field)
    pose[1, 0] = torch.tensor(value)[: pose.shape[-1]]
    hits = cast(scene, [[(0.1, 0, 3)]] * 2, [[(0, 0, -1)]] * 2)
    assert hits.shape_id.flatten().tolist() == [0, 1]
    assert scene.broken_poses().tolist() == [[False], [True]]


@pytest.mark.parametrize("norm", [1.01e-6, 1e-3, 1 - 1e-3, 1 + 1e-3, 1e3, 0.99e6])
def test_a_quaternion_of_another_norm_is_normalised(norm):
    scene = RayScene([carried(BODIES[0])], num_envs=2, num_bodies=1)
    quat = torch.tensor([0.9, 0.1, -0.2, 0.3])
    scene.body_quat[0], scene.body_quat[1] = quat, quat / quat.norm() * norm
    rays = np.random.default_rng(0).normal(size=(1, 300, 3)).repeat(2, 0)
    ranges = cast(scene, np.zeros((2, 300, 3)), rays).ranges
    torch.testing.assert_close(ranges[0], ranges[1], rtol=1e-6, atol=0)
    assert not scene.broken_poses().any()


def test_grazing_rays():
    """1e-6 rad towards and away from flat faces: a hit far away, a miss, and nothing in between."""
    angle = 1e-6
    towards, away = (math.cos(angle), 0, -math.sin(angle)), (math.cos(angle), 0, math.sin(angle))
    assert one([Shape(K.PLANE)], (0, 0, 1), towards) == pytest.approx(1 / angle, rel=1e-5)
    assert one([Shape(K.PLANE)], (0, 0, 1), away) == math.inf
    slab = [Shape(K.BOX, (50, 50, 1), pos=(0, 0, -1)), Shape(K.CYLINDER, (50, 1), pos=(0, 0, -1))]
    slab += [Shape(K.HEIGHTFIELD, asset=HeightField(np.ones((6, 6)), 50, 50), pos=(0, 0, -1))]
    slab += [Shape(K.MESH, asset=TriangleMesh(CUBE_MESH.vertices * (50, 50, 1), CUBE_MESH.triangles), pos=(0, 0, -1))]
    for shape in slab:
        assert one([shape], (-10, 0, 1e-5), towards) == pytest.approx(10, abs=0.1)
        assert one([shape], (-10, 0, 1e-4), towards) == math.inf  # past the far end
        assert one([shape], (-10, 0, 1e-5), away) == math.inf


def test_rays_along_edges_and_faces():
    for shape in (BODIES[0], BODIES[5], BODIES[6], BODIES[7]):
        for origin, direction in (((-3, 1, 1), (1, 0, 0)), ((-3, 1, 0.3), (1, 0, 0)), ((0.2, -3, -1), (0, 1, 0))):
            reached = one([shape], origin, direction)
            assert reached == math.inf or 2.0 - 1e-5 <= reached <= 4.0 + 1e-5  # a point of it, or none


def test_all_misses_and_all_hits_at_the_minimum_range():
    pattern = grid(16, 8, 60.0)
    config = LidarConfig(num_rays=128, period_s=1 / 30, min_range=0.5, max_range=9.0)
    scene = RayScene([Shape(K.SPHERE, (1.0,), body=0)], 2, 1)
    lidar = Lidar(config, pattern, scene, mount_body=-1)
    time_s = torch.zeros(2, dtype=torch.float64)
    scene.body_pos[1, 0, 2] = 100.0
    frame = lidar.cast(time_s)
    assert (frame.ranges[0] == 1.0).all() and (frame.ranges[1] == math.inf).all()
    scene.body_pos[1, 0, 2] = math.nan
    assert (lidar.cast(time_s).ranges[1] == math.inf).all()
    nearest = Lidar(LidarConfig(128, 1 / 30, 1.0, 9.0), pattern, scene, mount_body=0)
    scene.body_pos[1, 0, 2] = 0.0
    assert (nearest.cast(time_s).ranges == 1.0).all()
    scene.body_quat[1, 0] = 0.0
    assert (nearest.cast(time_s).ranges[1] == math.inf).all()  # the sensor's own body has no pose


@pytest.mark.parametrize("num_bodies", [1, 10_000])
def test_many_bodies(num_bodies):
    rng = np.random.default_rng(0)
    shapes = [Shape(K.SPHERE, (0.05,), body=k) for k in range(num_bodies)]
    scene = RayScene(shapes, num_envs=1, num_bodies=num_bodies)
    centres = rng.uniform(-4, 4, (num_bodies, 3)).astype(np.float32)
    scene.body_pos[0] = torch.from_numpy(centres)
    directions = rng.normal(size=(300, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    hits = cast(scene, np.zeros((300, 3)), directions)
    ahead = directions @ centres.T.astype(np.float64)
    half = np.sqrt(np.maximum(0.05**2 - ((centres**2).sum(1) - ahead**2), -1e-30 + 0j)).real
    met = ((centres.astype(np.float64) ** 2).sum(1) - ahead**2 < 0.05**2) & (ahead + half > 0)
    entry = np.where(met, np.where(ahead - half >= 0, ahead - half, ahead + half), math.inf)
    np.testing.assert_allclose(hits.ranges[0].numpy(), entry.min(1), atol=1e-4)
    nearest = np.where(np.isfinite(entry.min(1)), entry.argmin(1), -1)
    assert (hits.shape_id[0].numpy() == nearest).mean() > 0.99


def test_an_environment_with_a_broken_pose_leaves_the_others_bit_identical():
    shapes = [carried(shape, k) for k, shape in enumerate(EVERYTHING)]
    results = []
    for wrong in (0.0, math.nan):
        scene = RayScene(shapes, num_envs=3, num_bodies=len(shapes))
        scene.body_pos[:] = 3.0 * torch.rand(scene.body_pos.shape, generator=torch.Generator().manual_seed(0))
        scene.body_pos[1] += wrong
        rays = np.random.default_rng(1).normal(size=(3, 400, 3))
        results.append(cast(scene, np.zeros((3, 400, 3)), rays, normals=True))
    for field in ("ranges", "shape_id", "normals_w"):
        before, after = (getattr(hits, field)[[0, 2]] for hits in results)
        assert torch.equal(before, after)
    assert results[1].ranges[1].isinf().all()
