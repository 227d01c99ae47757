"""Sizes by environment: against mj_ray on a model compiled with each environment's sizes."""

import math

import mujoco
import numpy as np
import pytest
import torch
from lidar_helpers import CUBE, CUBE_FACES

from benchmarks.harness.reference import mujoco_ranges
from omnilidar import Lidar, LidarConfig, MujocoScene, RayScene, ScanPattern, Shape, ShapeKind, TriangleMesh

K = ShapeKind
KINDS = ("box", "sphere", "cylinder", "capsule", "ellipsoid")
GEOMS = tuple((kind, where) for where in ("moving", "moving", "fixed") for kind in KINDS)
READ = {"box": 3, "sphere": 1, "cylinder": 2, "capsule": 2, "ellipsoid": 3}
NUM_ENVS, NUM_RAYS = 3, 1500


def draw(seed, low, high):
    """Sizes (num_envs, geoms, 3), 0 where the kind of a geom reads none, and the poses of all geoms."""
    rng = np.random.default_rng(seed)
    sizes = rng.uniform(low, high, (NUM_ENVS, len(GEOMS), 3))
    sizes *= np.array([[k < READ[kind] for k in range(3)] for kind, _ in GEOMS])
    quat = rng.normal(size=(len(GEOMS), 4))
    return sizes, rng.uniform(-4, 4, (len(GEOMS), 3)), quat / np.linalg.norm(quat, axis=1, keepdims=True)


def compiled(sizes, pos, quat):
    """A model with these sizes (geoms, 3), and its data with the kinematic bodies in place."""
    spec = mujoco.MjSpec()
    for (kind, where), size, p, q in zip(GEOMS, sizes, pos, quat, strict=True):
        body = spec.worldbody.add_body(pos=p, quat=q, mocap=where == "moving")
        body.add_geom(type=getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}"), size=size)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def true_ranges(sizes, pos, quat, origins, directions, cutoff=math.inf):
    """What mj_ray measures in each environment, (num_envs, R), and which geom it hits."""
    seen = [
        mujoco_ranges(*compiled(sizes[env], pos, quat), origins[env].astype(float), directions[env].astype(float))
        for env in range(NUM_ENVS)
    ]
    ranges, ids = (np.stack(parts) for parts in zip(*seen, strict=True))
    return np.where(ranges < cutoff, ranges, math.inf), np.where(ranges < cutoff, ids, -1)


def scene_of(sizes, pos, quat, pose_dtype=torch.float64):
    """A scene that was built with sizes (geoms, 3)."""
    model, data = compiled(sizes, pos, quat)
    scene = MujocoScene(model, NUM_ENVS, num_threads=2, pose_dtype=pose_dtype)
    scene.copy_data(data)
    return scene


def rays_at(pos, seed):
    """Rays from the middle that aim next to the shapes."""
    rng = np.random.default_rng(seed)
    aims = pos[rng.integers(0, len(pos), (NUM_ENVS, NUM_RAYS))] + rng.normal(scale=0.5, size=(NUM_ENVS, NUM_RAYS, 3))
    origins = rng.uniform(-0.5, 0.5, (NUM_ENVS, NUM_RAYS, 3)).astype(np.float32)
    return origins, (aims / np.linalg.norm(aims, axis=-1, keepdims=True)).astype(np.float32)


def assert_same(ranges, shape_id, expected, geoms):
    """A few rays in a thousand may graze an edge and hit another."""
    same = shape_id.numpy() == geoms
    assert same.mean() > 0.997 and (geoms[same] >= 0).mean() > 0.3
    np.testing.assert_allclose(ranges.numpy()[same], expected[same], rtol=1e-5, atol=2e-5)


def scan(scene, origins, directions, max_range=50.0, segments=0):
    """The same directions from a sensor in each environment's origin."""
    d = torch.from_numpy(directions[0])
    elevation, azimuth = torch.asin(d[:, 2]), torch.atan2(d[:, 1], d[:, 0])
    pattern = ScanPattern(d, elevation, azimuth, NUM_RAYS / 0.1)
    config = LidarConfig(NUM_RAYS, 0.1, 0.0, max_range, motion_segments=segments)
    lidar = Lidar(config, pattern, scene, -1, outputs=("ranges", "shape_id"))
    lidar.phase_rows.zero_()
    return lidar


@pytest.mark.parametrize("before", [(0.02, 0.05), (0.1, 1.2)], ids=["grown", "any"])
@pytest.mark.parametrize("pose_dtype", [torch.float32, torch.float64])
def test_rays_hit_each_environments_own_sizes(before, pose_dtype):
    """Also of shapes that were built small, whose bounds would hide what they grow into."""
    small, pos, quat = draw(0, *before)
    sizes = draw(1, 0.1, 1.2)[0]
    scene = scene_of(small[0], pos, quat, pose_dtype)
    origins, directions = rays_at(pos, 2)
    first = scene.cast(origins, directions)
    scene.set_sizes(range(len(GEOMS)), sizes)
    hits = scene.cast(origins, directions)
    assert not torch.equal(first.ranges, hits.ranges)
    assert_same(hits.ranges, hits.shape_id, *true_ranges(sizes, pos, quat, origins, directions))


@pytest.mark.parametrize("segments", [0, 2])
def test_a_sensor_that_was_recorded_before_sees_new_sizes(segments):
    small, pos, quat = draw(0, 0.02, 0.05)
    sizes, (origins, directions) = draw(1, 0.1, 1.2)[0], rays_at(pos, 2)
    origins[:], directions[:] = 0.0, directions[:1]
    scene = scene_of(small[0], pos, quat)
    lidar = scan(scene, origins, directions, 6.0, segments)
    lidar.cast(0.1)
    scene.set_sizes(range(len(GEOMS)), torch.from_numpy(sizes))
    for _ in range(segments - 1):
        lidar.record_poses()
    frame = lidar.cast(0.2)
    assert_same(frame.ranges, frame.shape_id, *true_ranges(sizes, pos, quat, origins, directions, 6.0))


@pytest.mark.parametrize("body", [-1, 0])
def test_what_was_hit_is_missed_once_it_has_shrunk(body):
    """Fixed shapes, too, which a sensor places once: what it has placed is placed again."""
    scene = RayScene([Shape(K.SPHERE, (0.5,), body=body, pos=(3.0, 0.4, 0.0))], 2, 1)
    forward = ScanPattern(torch.tensor([[1.0, 0.0, 0.0]]), torch.zeros(1), torch.zeros(1), 10.0)
    lidar = Lidar(LidarConfig(1, 0.1, 0.0, 20.0), forward, scene, -1)
    origin, direction = torch.zeros(2, 1, 3), torch.tensor([1.0, 0.0, 0.0]).expand(2, 1, 3)

    def seen():
        ranges = lidar.cast(0.0).ranges.flatten().tolist()
        assert ranges == pytest.approx(scene.cast(origin, direction).ranges.flatten().tolist(), rel=1e-5)
        return ranges

    assert seen() == pytest.approx([2.7, 2.7])
    scene.set_sizes([0], np.array([[[0.3, 0.0, 0.0]]]), torch.tensor([1]))
    assert seen() == pytest.approx([2.7, math.inf])
    scene.set_sizes([0], np.array([[2.9, 9.0, 9.0]]))  # the same for all; a sphere reads the first number only
    assert seen() == pytest.approx([3.0 - math.sqrt(2.9**2 - 0.4**2)] * 2, rel=1e-5)


def test_normals_are_those_of_the_new_size():
    """The side of a cylinder of radius 1 and half height 2 where, as it was built, its top would be."""
    scene = RayScene([Shape(K.CYLINDER, (2.0, 0.5), pos=(5.0, 0.0, 0.0))], 1, 0)
    scene.set_sizes([0], [[1.0, 2.0, 0.0]])
    hits = scene.cast(torch.tensor([[[0.0, 0.0, 0.5]]]), torch.tensor([[[1.0, 0.0, 0.0]]]), normals=True)
    assert hits.ranges.item() == pytest.approx(4.0) and hits.normals_w.flatten().tolist() == [-1.0, 0.0, 0.0]


def test_a_size_is_kept_in_float64():
    """A grazing hit is computed in float64: the way into a sphere of radius 1 + 1e-9 that passes its centre at 1."""
    scene = RayScene([Shape(K.SPHERE, (0.5,))], 1, 0, pose_dtype=torch.float64)
    scene.set_sizes([0], torch.tensor([[1.0 + 1e-6, 0.0, 0.0]], dtype=torch.float64))
    origin, direction = (torch.tensor([[x]], dtype=torch.float64) for x in ([-3.0, 1.0, 0.0], [1.0, 0.0, 0.0]))
    expected = 3.0 - math.sqrt((1.0 + 1e-6) ** 2 - 1.0)
    assert scene.cast(origin, direction).ranges.item() == pytest.approx(expected, abs=2e-5)
    assert scene.sizes([0]).flatten().tolist() == [1.0 + 1e-6, 0.0, 0.0]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([1], [[1.0, 1.0, 1.0]]), r"shapes\[1\] is a mesh"),
        (([2], [[1.0, math.nan, 0.0]]), "must be positive and finite"),
        (([2], [[1.0, 1.0]]), r"sizes \(1, 2\) must be \(2, 1, 3\) or \(1, 3\)"),
    ],
)
def test_wrong_sizes_are_refused(arguments, message):
    cube = TriangleMesh(CUBE, CUBE_FACES)
    scene = RayScene([Shape(K.PLANE), Shape(K.MESH, asset=cube), Shape(K.CYLINDER, (0.1, 0.2))], 2, 0)
    with pytest.raises(ValueError, match=message):
        scene.set_sizes(*arguments)
    assert scene.sizes([2])[1].flatten().tolist() == [0.1, 0.2, 0.0]
