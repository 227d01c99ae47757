"""Sector distances against hand-computed ones."""

import math

import pytest
import torch

from omniperception.lidar import quat_from_rpy, sector_distances
from omniperception.lidar import sectors as module

UPRIGHT = (1.0, 0.0, 0.0, 0.0)
OBSTACLE = 2


@pytest.fixture(params=[1, 32], autouse=True)
def lanes(request, monkeypatch):
    """With one lane, as on a CPU, and with many, as on a GPU."""
    monkeypatch.setitem(module.LANES, "cpu", request.param)


def sectors(points_s, classes, base_quat=UPRIGHT, mount_pos=(0.0, 0.0, 0.0), mount_quat=UPRIGHT, **options):
    points = torch.tensor(points_s, dtype=torch.float32).reshape(1, -1, 3)
    ranges = points.norm(dim=-1)
    class_id = torch.tensor(classes, dtype=torch.int32).reshape(1, -1)
    quat = torch.tensor([base_quat], dtype=torch.float32)
    options = {"obstacle_class": OBSTACLE, "max_distance": 5.0} | options
    return sector_distances(ranges, points / ranges[..., None], class_id, quat, mount_pos, mount_quat, **options)[0]


def ring(radius=lambda j: 1.0 + j / 36.0):
    angles = [-math.pi + (j + 0.5) * math.pi / 18.0 for j in range(36)]
    return [(radius(j) * math.cos(a), radius(j) * math.sin(a), 0.3) for j, a in enumerate(angles)]


def test_no_hit_gives_the_maximum_everywhere():
    assert sectors([(1.0, 0.0, 0.0)], [-1]).tolist() == [5.0] * 36
    assert sectors([(1.0, 0.0, 0.0)], [0]).tolist() == [5.0] * 36
    assert sectors([], []).tolist() == [5.0] * 36


def test_one_hit_fills_one_sector_with_its_horizontal_distance():
    distances = sectors([(3.0, 0.1, 4.0)], [OBSTACLE])
    assert distances[18] == pytest.approx(math.hypot(3.0, 0.1), rel=1e-5)  # azimuth 1.9 deg: [0, 10)
    assert (distances == 5.0).sum() == 35


def test_the_nearest_hit_of_a_sector_counts_and_other_classes_do_not():
    points = [(2.0, 0.1, 0.0), (1.5, 0.1, 0.0), (0.5, 0.1, 0.0), (1.8, 0.1, 0.0)]
    assert sectors(points, [OBSTACLE, OBSTACLE, 0, OBSTACLE])[18] == pytest.approx(math.hypot(1.5, 0.1), rel=1e-5)


def test_all_sectors():
    expected = torch.tensor([1.0 + j / 36.0 for j in range(36)])
    assert torch.allclose(sectors(ring(), [OBSTACLE] * 36), expected, atol=1e-5)


def test_a_hit_beyond_the_maximum_is_the_maximum():
    assert sectors([(9.0, 0.1, 0.0)], [OBSTACLE])[18] == 5.0


@pytest.mark.parametrize(
    ("azimuth_deg", "sector"), [(0.01, 2), (-0.01, 1), (89.99, 2), (90.01, 3), (-179.99, 0), (179.99, 3)]
)
def test_sector_borders(azimuth_deg, sector):
    a = math.radians(azimuth_deg)
    distances = sectors([(math.cos(a), math.sin(a), 0.0)], [OBSTACLE], num_sectors=4)
    assert [d < 5.0 for d in distances.tolist()] == [j == sector for j in range(4)]


def test_yaw_of_the_base_changes_nothing():
    for yaw in (0.3, 2.0, -3.1):
        turned = sectors(ring(), [OBSTACLE] * 36, base_quat=quat_from_rpy(0.0, 0.0, yaw))
        assert torch.allclose(turned, sectors(ring(), [OBSTACLE] * 36), atol=1e-5)


def test_turning_the_sensor_on_its_mount_shifts_the_sectors():
    turned = sectors(ring(), [OBSTACLE] * 36, mount_quat=quat_from_rpy(0.0, 0.0, math.radians(30.0)))
    assert torch.allclose(turned, sectors(ring(), [OBSTACLE] * 36).roll(3), atol=1e-5)


def test_pitch_is_levelled_and_the_mount_offset_counts():
    pitch = math.radians(60.0)  # nose down: the sensor, 1 m ahead in the base, is 0.5 m ahead on the level
    distances = sectors([(2.0, 0.01, 0.0)], [OBSTACLE], quat_from_rpy(0.0, pitch, 0.7), mount_pos=(1.0, 0.0, 0.0))
    assert distances[18] == pytest.approx(math.hypot(0.5 + 2.0 * math.cos(pitch), 0.01), rel=1e-5)


def test_wrong_arguments_are_refused():
    with pytest.raises(ValueError, match="num_sectors=0"):
        sectors([(1.0, 0.0, 0.0)], [OBSTACLE], num_sectors=0)
    with pytest.raises(ValueError, match="max_distance=0"):
        sectors([(1.0, 0.0, 0.0)], [OBSTACLE], max_distance=0.0)
