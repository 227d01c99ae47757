"""The LiDAR: frames, phase, mounting, ranges, and parity with general rays through the same scene."""

import dataclasses
import math

import pytest
import torch

from omniperception.lidar import Lidar, LidarConfig, RayScene, Shape, ShapeKind, grid, mid360, quat_from_rpy

K = ShapeKind


@pytest.fixture(scope="module")
def pattern():
    return mid360()


def clock(num_envs, time):
    return torch.full((num_envs,), time, dtype=torch.float64)


def rotate(quat, vectors):
    w, xyz = quat[..., :1], quat[..., 1:].expand(vectors.shape)
    across = 2.0 * torch.linalg.cross(xyz, vectors)
    return vectors + w * across + torch.linalg.cross(xyz, across)


def crowd(num_envs, seed=0, num_threads=2):
    """A plane, a carrier and one body of each closed kind per environment, in random poses."""
    closed = [K.BOX, K.SPHERE, K.CYLINDER, K.CAPSULE, K.ELLIPSOID] * 3
    sizes = {
        K.BOX: (0.3, 0.2, 0.5),
        K.SPHERE: (0.4,),
        K.CYLINDER: (0.2, 0.6),
        K.CAPSULE: (0.1, 0.5),
        K.ELLIPSOID: (0.2, 0.4, 0.6),
    }
    shapes = [Shape(K.PLANE)] + [Shape(k, sizes[k], body=1 + i, class_id=1 + i % 3) for i, k in enumerate(closed)]
    scene = RayScene(shapes, num_envs, 1 + len(closed), num_threads=num_threads)
    generator = torch.Generator().manual_seed(seed)
    scene.body_pos[:] = 6.0 * torch.rand(scene.body_pos.shape, generator=generator) - 3.0
    scene.body_pos[..., 2].abs_()
    quat = torch.randn(scene.body_quat.shape, generator=generator)
    scene.body_quat[:] = quat / quat.norm(dim=-1, keepdim=True)
    return scene


def test_scan_meets_what_general_rays_meet(pattern):
    config = LidarConfig(2000, 0.1, 0.05, 5.0, mount_pos=(0.3, 0.0, -0.05), mount_rpy=(0.0, -2.8782, 3.14))
    scene = crowd(6)
    lidar = Lidar(config, pattern, scene, mount_body=0, exclude_shapes=(2,))
    frame = lidar.cast(clock(6, 3.7))
    quat = scene.body_quat[:, :1]
    mount = torch.tensor(config.quat).expand(6, 1, 4)
    directions = rotate(quat, rotate(mount, frame.directions_s))
    origins = scene.body_pos[:, :1] + rotate(quat, torch.tensor(config.mount_pos).expand(6, 1, 3))
    hits = scene.cast(origins.expand_as(directions).contiguous(), directions, 5.0, exclude_shapes=(2,))
    expected = torch.where(hits.ranges >= 0.05, hits.ranges, math.inf)
    same = (frame.shape_id == torch.where(hits.ranges >= 0.05, hits.shape_id, -1)).float().mean()
    close = torch.isclose(frame.ranges, expected, rtol=1e-4, atol=1e-4).float().mean()
    assert same > 0.998 and close > 0.998
    assert 0.2 < torch.isfinite(frame.ranges).float().mean() < 1.0
    classes = torch.tensor([shape.class_id for shape in scene.shapes] + [-1], dtype=torch.int32)
    assert torch.equal(frame.class_id, classes[frame.shape_id.long()])


def test_frame_reports_its_rows(pattern):
    lidar = Lidar(LidarConfig(100), pattern, RayScene([], 3, 1, num_threads=2), 0, seed=5)
    frame = lidar.cast(clock(3, 0.7))
    rows = frame.row.long()
    assert ((rows[:, 1] - rows[:, 0]) % 800_000 == 199).all()
    assert rows[:, 0].unique().numel() == 3  # each environment has a phase of its own
    assert torch.equal(rows[:, 0], (120_000 + lidar.phase_rows) % 800_000)
    assert torch.equal(frame.directions_s, pattern.directions_s[rows])
    assert torch.equal(frame.elevation, pattern.elevation[rows])
    assert torch.equal(frame.azimuth, pattern.azimuth[rows])


def test_scan_moves_on_with_time_and_repeats(pattern):
    lidar = Lidar(LidarConfig(100), pattern, RayScene([], 1, 0), -1)
    first, second, again, late = (lidar.cast(clock(1, t)).row.clone() for t in (0.1, 0.2, 4.1, 1_000_000.1))
    assert not torch.equal(first, second)
    assert torch.equal(first, again) and torch.equal(first, late)


def test_every_output_is_rewritten_after_a_hit(pattern):
    scene = RayScene([Shape(K.SPHERE, (1.0,), body=0, class_id=4)], 2, 1)
    lidar = Lidar(LidarConfig(500), pattern, scene, -1)
    frame = lidar.cast(clock(2, 0.1))  # the sensor is inside the sphere
    assert torch.allclose(frame.ranges, torch.ones(2, 500), atol=1e-5) and (frame.class_id == 4).all()
    scene.body_pos[1, 0, 2] = -1000.0
    frame = lidar.cast(clock(2, 0.1))
    assert torch.isfinite(frame.ranges[0]).all()
    assert (frame.ranges[1] == math.inf).all()
    assert (frame.shape_id[1] == -1).all() and (frame.class_id[1] == -1).all()


def test_a_surface_nearer_than_the_minimum_blocks_and_returns_nothing(pattern):
    near, far = Shape(K.SPHERE, (0.09,)), Shape(K.SPHERE, (3.0,))
    lidar = Lidar(LidarConfig(50, min_range=0.1), pattern, RayScene([near, far], 1, 0), -1)
    frame = lidar.cast(clock(1, 0.1))
    assert (frame.ranges == math.inf).all() and (frame.shape_id == -1).all()
    excluding = Lidar(LidarConfig(50, min_range=0.1), pattern, lidar.scene, -1, exclude_shapes=(0,))
    assert torch.allclose(excluding.cast(clock(1, 0.1)).ranges, torch.full((1, 50), 3.0), atol=1e-5)


def test_maximum_range_is_a_miss():
    scene = RayScene([Shape(K.BOX, (0.5, 9.0, 9.0), pos=(5.5, 0.0, 0.0))], 1, 0)
    for max_range, expected in ((4.99, math.inf), (5.01, 5.0)):
        lidar = Lidar(LidarConfig(1, 1 / 30, 0.1, max_range), grid(1, 1, 10.0), scene, -1)
        assert float(lidar.cast(clock(1, 0.0)).ranges) == pytest.approx(expected, abs=1e-5)


def test_mounting_follows_the_body():
    scene = RayScene([Shape(K.PLANE)], 1, 1)
    scene.body_pos[0, 0, 2] = 2.0
    config = LidarConfig(1, 1 / 30, 0.1, 50.0, (0.0, 0.0, 0.5), (0.0, math.radians(30.0), 0.0))
    lidar = Lidar(config, grid(1, 1, 10.0), scene, 0)
    assert float(lidar.cast(clock(1, 0.0)).ranges) == pytest.approx(2.5 / math.sin(math.radians(30.0)), rel=1e-5)
    scene.body_quat[0, 0] = torch.tensor(quat_from_rpy(0.0, math.radians(60.0), 1.0))  # nose down by 60 more
    assert float(lidar.cast(clock(1, 0.0)).ranges) == pytest.approx(2.0 + 0.5 * math.cos(math.radians(60.0)), rel=1e-5)


@pytest.mark.parametrize("num_envs", [1, 3])
@pytest.mark.parametrize("num_rays", [1, 1777])
@pytest.mark.parametrize("shapes", [[], [Shape(K.SPHERE, (2.0,))]], ids=["empty", "one"])
def test_odd_counts_give_the_same_on_one_thread_and_two(pattern, num_envs, num_rays, shapes):
    frames = [
        Lidar(LidarConfig(num_rays), pattern, RayScene(shapes, num_envs, 0, num_threads=n), -1).cast(
            clock(num_envs, 0.3)
        )
        for n in (1, 2)
    ]
    for name in (field.name for field in dataclasses.fields(frames[0])):
        assert torch.equal(getattr(frames[0], name), getattr(frames[1], name)), name
    assert frames[0].ranges.shape == (num_envs, num_rays)


def test_threads_agree_on_a_crowd(pattern):
    frames = [
        Lidar(LidarConfig(3000), pattern, crowd(7, num_threads=n), 0, (1,)).cast(clock(7, 0.3)) for n in (1, 2, 5)
    ]
    assert torch.equal(frames[0].ranges, frames[1].ranges) and torch.equal(frames[0].ranges, frames[2].ranges)


def test_a_frame_allocates_nothing_new(pattern):
    lidar = Lidar(LidarConfig(10), pattern, crowd(2), 0)
    addresses = [getattr(lidar.frame, f.name).data_ptr() for f in dataclasses.fields(lidar.frame)]
    frame = lidar.cast(clock(2, 0.5))
    assert frame is lidar.frame and frame.ranges is frame.true_ranges
    assert addresses == [getattr(frame, f.name).data_ptr() for f in dataclasses.fields(frame)]


def test_mount_published_for_the_go2_looks_forward_and_down():
    quat = torch.tensor(quat_from_rpy(0.0, -2.8782, 3.14), dtype=torch.float64)
    up = rotate(quat, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    assert up[2] == pytest.approx(math.cos(2.8782), abs=1e-3) and up[0] == pytest.approx(math.sin(2.8782), abs=1e-3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num_rays": 0}, "lidar.num_rays=0"),
        ({"period_s": 0.0}, "lidar.period_s=0.0"),
        ({"min_range": -0.1}, "lidar.min_range=-0.1"),
        ({"max_range": -1}, "lidar.max_range=-1 must be > lidar.min_range=0.1"),
        ({"mount_pos": (0.0, 0.0)}, "lidar.mount_pos"),
        ({"mount_quat": (1.0, 1.0, 0.0, 0.0)}, "lidar.mount_quat"),
        ({"mount_quat": (1.0, 0.0, 0.0, 0.0), "mount_rpy": (0.0, 0.0, 0.0)}, "both given"),
    ],
)
def test_wrong_configs_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        LidarConfig(**options)


def test_wrong_sensors_are_refused(pattern):
    scene = RayScene([], 2, 1)
    with pytest.raises(ValueError, match="lidar.num_rays=30000 must be in 1..20000"):
        Lidar(LidarConfig(30_000), pattern, scene, 0)
    with pytest.raises(ValueError, match="lidar.mount_body=1"):
        Lidar(LidarConfig(10), pattern, scene, 1)
    with pytest.raises(ValueError, match="float64"):
        Lidar(LidarConfig(10), pattern, scene, 0).cast(torch.zeros(2))
