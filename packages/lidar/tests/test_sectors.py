"""Sector distances against hand-computed ones."""

import math

import pytest
import torch

from omnilidar import SectorDistances, quat_from_rpy
from omnilidar import sectors as module

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
    pose = torch.zeros(1, 1, 3), torch.tensor([[base_quat]], dtype=torch.float32)
    options = {"obstacle_class": OBSTACLE, "max_distance": 5.0} | options
    rays = ranges, points / ranges[..., None], class_id
    return SectorDistances(*rays, *pose, 0, mount_pos, mount_quat, **options)()[0]


def ring(radius=lambda j: 1.0 + j / 36.0):
    angles = [-math.pi + (j + 0.5) * math.pi / 18.0 for j in range(36)]
    return [(radius(j) * math.cos(a), radius(j) * math.sin(a), 0.3) for j, a in enumerate(angles)]


@pytest.mark.parametrize(
    ("points", "classes", "expected"),
    [
        ([], [], 5.0),
        ([(1.0, 0.1, 0.0)], [-1], 5.0),
        ([(1.0, 0.1, 0.0)], [0], 5.0),
        ([(9.0, 0.1, 0.0)], [OBSTACLE], 5.0),
        ([(3.0, 0.1, 4.0)], [OBSTACLE], math.hypot(3.0, 0.1)),  # horizontal; azimuth 1.9 deg is in [0, 10)
        ([(2.0, 0.1, 0.0), (1.5, 0.1, 0.0), (0.5, 0.1, 0.0)], [OBSTACLE, OBSTACLE, 0], math.hypot(1.5, 0.1)),
    ],
)
def test_the_nearest_obstacle_of_a_sector_counts(points, classes, expected):
    distances = sectors(points, classes)
    assert distances[18].item() == pytest.approx(expected, rel=1e-5)
    assert (distances == 5.0).sum() == (36 if expected == 5.0 else 35)


def test_all_sectors():
    expected = torch.tensor([1.0 + j / 36.0 for j in range(36)])
    assert torch.allclose(sectors(ring(), [OBSTACLE] * 36), expected, atol=1e-5)


@pytest.mark.parametrize(
    ("azimuth_deg", "sector"), [(0.01, 2), (-0.01, 1), (89.99, 2), (90.01, 3), (-179.99, 0), (179.99, 3)]
)
def test_sector_borders(azimuth_deg, sector):
    a = math.radians(azimuth_deg)
    distances = sectors([(math.cos(a), math.sin(a), 0.0)], [OBSTACLE], num_sectors=4)
    assert [d < 5.0 for d in distances.tolist()] == [j == sector for j in range(4)]


@pytest.mark.parametrize(("base_yaw", "mount_yaw", "shift"), [(0.3, 0.0, 0), (2.0, 0.0, 0), (-3.1, math.pi / 6, 3)])
def test_yaw_of_the_base_changes_nothing_and_that_of_the_mount_shifts_the_sectors(base_yaw, mount_yaw, shift):
    base, mount = (quat_from_rpy(0.0, 0.0, yaw) for yaw in (base_yaw, mount_yaw))
    turned = sectors(ring(), [OBSTACLE] * 36, base_quat=base, mount_quat=mount)
    assert torch.allclose(turned, sectors(ring(), [OBSTACLE] * 36).roll(shift), atol=1e-5)


def test_pitch_is_levelled_and_the_mount_offset_counts():
    pitch = math.radians(60.0)  # nose down: the sensor, 1 m ahead in the base, is 0.5 m ahead on the level
    distances = sectors([(2.0, 0.01, 0.0)], [OBSTACLE], quat_from_rpy(0.0, pitch, 0.7), mount_pos=(1.0, 0.0, 0.0))
    assert distances[18] == pytest.approx(math.hypot(0.5 + 2.0 * math.cos(pitch), 0.01), rel=1e-5)


@pytest.mark.parametrize(
    ("name", "given"), [("directions_s", torch.zeros(2, 3, 3)), ("class_id", torch.zeros(2, 4, dtype=torch.int32))]
)
def test_other_numbers_of_rays_are_refused(name, given):
    right = {"directions_s": torch.zeros(2, 5, 3), "class_id": torch.zeros(2, 5, dtype=torch.int32)}
    with pytest.raises(ValueError, match=f"{name} must be"):
        SectorDistances(
            torch.ones(2, 5),
            *(right | {name: given}).values(),
            torch.zeros(2, 1, 3),
            torch.tensor([[UPRIGHT]] * 2),
            0,
            (0.0, 0.0, 0.0),
            UPRIGHT,
            obstacle_class=OBSTACLE,
            max_distance=5.0,
        )
