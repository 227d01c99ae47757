"""What a frame reports: hand-computed values, agreement with general rays, and that the unasked is absent."""

import math
from dataclasses import replace

import pytest
import torch
from lidar_helpers import closed_shapes, random_quats, rotate

from omnilidar import (
    OUTPUTS,
    GaussianNoise,
    Lidar,
    LidarConfig,
    RayScene,
    Shape,
    ShapeKind,
    grid,
    height_scanner,
)

K = ShapeKind
NOW = torch.full((3,), 0.7, dtype=torch.float64)
MOUNT = {"mount_pos": (0.3, -0.1, 0.2), "mount_rpy": (0.4, -0.9, 2.0)}


@pytest.fixture(scope="module")
def room():
    """A plane, a big box around everything, and one body of each closed kind, in random poses; the sensor's is 0."""
    shapes = [Shape(K.PLANE, class_id=4), Shape(K.BOX, (9.0, 9.0, 9.0), class_id=2)]
    shapes += [replace(shape, class_id=i) for i, shape in enumerate(closed_shapes(4, 1))]
    scene = RayScene(shapes, 3, 5, num_threads=2)
    generator = torch.Generator().manual_seed(0)
    scene.body_pos[:] = 4.0 * torch.rand(scene.body_pos.shape, generator=generator) - 2.0
    scene.body_pos[..., 2] = 1.0
    scene.body_quat[:] = random_quats(generator, 3, 5)
    return scene


def test_points_in_all_frames_describe_one_cloud(pattern, room):
    outputs = ("ranges", "valid", "points_s", "points_b", "points_w", "directions_s")
    config = LidarConfig(1000, max_range=5.0, **MOUNT)
    frame = Lidar(config, pattern, room, 0, noise=(GaussianNoise(0.05),), outputs=outputs).cast(NOW)
    hit = frame.valid
    assert 0.3 < hit.float().mean() < 1.0 and torch.equal(hit, frame.ranges.isfinite())
    for points in (frame.points_s, frame.points_b, frame.points_w):
        assert torch.equal(points.isfinite().all(-1), hit) and torch.equal(points.isnan().any(-1), ~hit)
    points_s = frame.ranges[..., None].double() * frame.directions_s.double()
    torch.testing.assert_close(frame.points_s[hit].double(), points_s[hit], rtol=1e-6, atol=1e-6)
    points_b = rotate(torch.tensor(config.quat), points_s) + torch.tensor(config.mount_pos)
    torch.testing.assert_close(frame.points_b[hit].double(), points_b[hit], rtol=1e-5, atol=1e-5)
    points_w = rotate(room.body_quat[:, :1].double(), points_b) + room.body_pos[:, :1]
    torch.testing.assert_close(frame.points_w[hit].double(), points_w[hit], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(("near", "far", "excluded"), [(0.0, 30.0, ()), (0.5, 5.0, (2,))])
def test_hits_normals_and_ids_are_those_of_general_rays(pattern, room, near, far, excluded):
    outputs = ("ranges", "normals_w", "shape_id", "class_id", "body_id", "directions_s", "incidence")
    config = LidarConfig(1000, min_range=near, max_range=far, **MOUNT)
    frame = Lidar(config, pattern, room, 0, excluded, outputs=outputs).cast(NOW)
    quat = room.body_quat[:, :1]
    directions = rotate(quat, rotate(torch.tensor(config.quat), frame.directions_s))
    origins = room.body_pos[:, :1] + rotate(quat, torch.tensor(config.mount_pos).expand(3, 1, 3))
    starts = origins.expand_as(directions).contiguous()
    hits = room.cast(starts, directions, far, normals=True, exclude_shapes=excluded)
    missed = hits.ranges < near
    same = frame.shape_id == torch.where(missed, -1, hits.shape_id)
    close = torch.isclose(frame.ranges, torch.where(missed, math.inf, hits.ranges), rtol=1e-4, atol=1e-4)
    assert same.float().mean() > 0.998 and close.float().mean() > 0.998
    hit = frame.shape_id >= 0
    assert hit.float().mean() > 0.3 and (far > 9.0 or not hit.all())
    close = torch.isclose(frame.normals_w, hits.normals_w, atol=1e-3).all(-1)
    assert close[same & hit].float().mean() > 0.998  # the others lie on an edge of a box or a cylinder
    shape = frame.shape_id[hit].long()
    for name, of_shapes in (("class_id", "class_id"), ("body_id", "body")):
        table = torch.tensor([getattr(s, of_shapes) for s in room.shapes], dtype=torch.int32)
        assert torch.equal(getattr(frame, name)[hit], table[shape]), name
    cosine = (directions.double() * frame.normals_w.double()).sum(-1).abs().clamp(max=1.0)
    torch.testing.assert_close(frame.incidence[hit].double(), cosine[hit].acos(), atol=2e-3, rtol=0.0)


def test_incidence_and_intensity_by_hand():
    """A ray 2 m above the ground, 60 degrees from the vertical, travels 4 m: intensity 0.5 * 0.5 * (8 / 4)^2."""
    config = LidarConfig(1, 1 / 30, 0.1, 50.0, (0.0, 0.0, 2.0), (0.0, math.radians(30.0), 0.0), reference_range=8.0)
    scene = RayScene([Shape(K.PLANE, class_id=3)], 3, 0)
    outputs = ("ranges", "incidence", "intensity", "normals_w", "body_id")
    lidar = Lidar(config, grid(1, 1, 10.0), scene, -1, outputs=outputs, reflectivity={3: 0.5})
    frame = lidar.cast(NOW)
    assert frame.ranges[0].item() == pytest.approx(4.0, rel=1e-5)
    assert frame.incidence[0].item() == pytest.approx(math.radians(60.0), rel=1e-5)
    assert frame.intensity[0].item() == pytest.approx(0.5 * 0.5 * 4.0, rel=1e-5)
    assert frame.normals_w[0, 0].tolist() == pytest.approx([0.0, 0.0, 1.0], abs=1e-6)
    assert frame.body_id[0].item() == -1
    facing = LidarConfig(1, 1 / 30, 0.1, 50.0, (0.0, 0.0, 2.0), (0.0, math.pi / 2, 0.0), reference_range=2.0)
    white = Lidar(facing, grid(1, 1, 10.0), scene, -1, outputs=("intensity",)).cast(NOW)
    assert white.intensity[0].item() == pytest.approx(1.0, rel=1e-5)


@pytest.mark.parametrize(("distance", "expected"), [(2.0, 25.0), (4.0, 6.25), (8.0, 1.5625)])
def test_intensity_falls_with_the_square_of_the_true_range(distance, expected):
    scene = RayScene([Shape(K.BOX, (0.1, 9.0, 9.0), pos=(distance + 0.1, 0.0, 0.0))], 3, 0)
    noise = (GaussianNoise(0.2),)
    lidar = Lidar(LidarConfig(1, 1 / 30), grid(1, 1, 10.0), scene, -1, noise=noise, outputs=("intensity",))
    assert lidar.cast(NOW).intensity[0].item() == pytest.approx(expected, rel=1e-5)


def test_an_inside_wall_is_as_bright_as_an_outside_one():
    """A ray that starts inside a shape hits the exit surface, whose outward normal points along the ray."""
    scene = RayScene([Shape(K.SPHERE, (5.0,))], 3, 0)
    outputs = ("incidence", "intensity", "normals_w", "directions_s")
    frame = Lidar(LidarConfig(9, 1 / 30), grid(3, 3, 90.0), scene, -1, outputs=outputs).cast(NOW)
    torch.testing.assert_close(frame.incidence, torch.zeros(3, 9), atol=1e-3, rtol=0.0)
    torch.testing.assert_close(frame.intensity, torch.full((3, 9), 4.0), rtol=1e-4, atol=0.0)
    torch.testing.assert_close(frame.normals_w, frame.directions_s, atol=1e-5, rtol=0.0)


@pytest.mark.parametrize("selection", ["every_kth", "stratified"])
@pytest.mark.parametrize("time", [0.7, 0.700003, 0.700013, 1_000_000.1])
def test_time_counts_from_the_frames_start(pattern, time, selection):
    """Rows are emitted every 5 us, four at one instant; the frame begins with the first row at or after its start."""
    outputs = ("time_s", "row")
    lidar = Lidar(LidarConfig(1000, selection=selection), pattern, RayScene([], 3, 0), -1, outputs=outputs)
    frame = lidar.cast(torch.full((3,), time, dtype=torch.float64))
    start = (time - 0.1) * 200_000
    first = math.ceil(start - 1e-3)
    phase_first = (first + lidar.phase_rows[:, None]) % pattern.num_rows
    emitted = first + (frame.row - phase_first) % pattern.num_rows
    assert (emitted >= first).all() and (emitted < first + 20_000).all() and (lidar.phase_rows % 4 == 0).all()
    expected = (emitted // 4 * 4 - first).double() / 200_000 + max(first - start, 0.0) / 200_000
    torch.testing.assert_close(frame.time_s.double(), expected, atol=3e-8, rtol=1e-6)


def test_a_height_scanner_measures_the_ground_below_its_points():
    """Rays that start beside the sensor: a box of height 0.3 m under a part of the grid, the plane elsewhere."""
    scene = RayScene([Shape(K.PLANE), Shape(K.BOX, (0.3, 0.25, 0.15), pos=(0.35, 0.0, 0.15), class_id=1)], 2, 1)
    scene.body_pos[:, 0] = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.2, 2.0]])
    pattern = height_scanner()
    outputs = ("ranges", "points_w", "class_id")
    lidar = Lidar(LidarConfig(pattern.num_rows, 0.02, 0.0, 20.0), pattern, scene, 0, outputs=outputs)
    frame = lidar.cast(0.02)
    points = frame.points_w
    on_box = ((points[..., 0] - 0.35).abs() < 0.29) & (points[..., 1].abs() < 0.24)
    off_box = ((points[..., 0] - 0.35).abs() > 0.31) | (points[..., 1].abs() > 0.26)
    assert (points[on_box][:, 2] - 0.3).abs().max() < 1e-6 and points[off_box][:, 2].abs().max() < 1e-6
    assert (frame.class_id[on_box] == 1).all() and on_box.sum() > 40
    xy = frame.points_w[1, :, :2] - frame.points_w[0, :, :2]
    torch.testing.assert_close(xy, torch.tensor([0.0, 0.2]).expand_as(xy), atol=1e-5, rtol=0.0)


@pytest.mark.parametrize("names", [("ranges",), ("points_w",), ("normals_w", "class_id"), ("time_s", "row", "azimuth")])
def test_only_what_is_asked_for_exists(pattern, room, names):
    """Outputs alone are what they are among all of them, and nothing else has memory."""
    config = LidarConfig(300, **MOUNT, max_range=5.0)
    noise = (GaussianNoise(0.05),)
    everything = Lidar(config, pattern, room, 0, noise=noise, outputs=OUTPUTS).cast(NOW)
    alone = Lidar(config, pattern, room, 0, noise=noise, outputs=names).cast(NOW)
    for name in names:
        assert torch.equal(getattr(alone, name).nan_to_num(-7.0), getattr(everything, name).nan_to_num(-7.0))
    assert {other for other in OUTPUTS if getattr(alone, other) is not None} == set(names)
