"""Scan patterns: the Mid-360, camera grids, and which rows a frame holds."""

import importlib.util
import math
from fractions import Fraction

import numpy as np
import pytest
import torch

from omniperception.lidar import ScanPattern, grid, mid360, select_rows

needs_table = pytest.mark.skipif(
    importlib.util.find_spec("mujoco_lidar") is None, reason="the extra 'tables' is not installed"
)
RATE = 200_000


@pytest.fixture(scope="module")
def model():
    return mid360()


def seconds(*values):
    return torch.tensor(values, dtype=torch.float64)


def test_mid360_model_has_the_devices_field_of_view(model):
    elevation = np.degrees(model.elevation.numpy())
    assert model.num_rows == 800_000 and model.points_per_second == RATE
    assert elevation.min() == pytest.approx(-7.21, abs=0.3) and elevation.max() == pytest.approx(52.16, abs=0.3)
    filled, _ = np.histogram(model.azimuth.numpy(), bins=360, range=(0.0, 2.0 * math.pi))
    assert filled.min() > 0.9 * filled.mean()
    assert model.azimuth.min() >= 0.0 and model.azimuth.max() <= np.float32(2.0 * math.pi)


def test_directions_agree_with_the_angles(model):
    for pattern in (model, grid(7, 5, 90.0)):
        x, y, z = pattern.directions_s.double().T
        assert torch.allclose(torch.asin(z), pattern.elevation.double(), atol=1e-6)
        turn = torch.atan2(y, x) - pattern.azimuth.double()
        assert torch.allclose(torch.cos(turn), torch.ones(len(turn), dtype=torch.float64), atol=1e-6)


@needs_table
def test_mid360_model_covers_what_the_table_covers(model):
    table = mid360("table")
    assert table.num_rows == model.num_rows and table.points_per_second == model.points_per_second
    histograms = [
        np.histogram(np.degrees(p.elevation.numpy()), bins=120, range=(-8.0, 53.0))[0] / p.num_rows
        for p in (model, table)
    ]
    assert np.minimum(*histograms).sum() > 0.97
    angle = torch.acos((model.directions_s.double() * table.directions_s.double()).sum(1).clamp(-1.0, 1.0))
    assert math.degrees(angle.mean()) < 0.1 and math.degrees(angle.max()) < 0.5


@needs_table
def test_a_frame_of_the_model_fills_the_sphere_like_the_table(model):
    def cells(pattern):
        ring = torch.floor(torch.rad2deg(pattern.elevation[:20_000]) / 2.0).long()
        column = torch.floor(torch.rad2deg(pattern.azimuth[:20_000]) / 2.0).long()
        return set((ring * 1000 + column).tolist())

    ours, theirs = cells(model), cells(mid360("table"))
    assert len(ours & theirs) / len(ours | theirs) > 0.95


def test_missing_table_names_the_extra(monkeypatch):
    def absent(name):
        raise ModuleNotFoundError(name)

    monkeypatch.setattr("omniperception.lidar.patterns.files", absent)
    with pytest.raises(ModuleNotFoundError, match=r"pip install omniperception\[tables\]"):
        mid360("table")
    with pytest.raises(ValueError, match="'model' or 'table'"):
        mid360("tabel")


def test_a_frame_holds_every_kth_point_of_its_period_of_all_lasers(model):
    rows = select_rows(model, seconds(0.1, 0.2), 0.1, 1000)
    assert rows.shape == (2, 1000) and rows.dtype == torch.int64
    assert rows[0].tolist() == list(range(0, 19_000, 19))  # 20 would keep one laser of the four
    assert rows[1].tolist() == list(range(20_000, 39_000, 19))
    assert select_rows(model, seconds(0.1), 0.1, 3000)[0].tolist() == list(range(0, 15_000, 5))
    assert torch.bincount(rows[0] % 4).tolist() == [250, 250, 250, 250]


def test_the_scan_repeats_after_four_seconds_and_not_before(model):
    rows = select_rows(model, seconds(1.0, 1.1, 5.0, 4.0, 0.0), 0.1, 500)
    assert not torch.equal(rows[0], rows[1])
    assert torch.equal(rows[0], rows[2])
    assert torch.equal(rows[3], rows[4]) and rows[4][0] == 780_000  # a frame at time 0 began before it


@pytest.mark.parametrize("late", [0, 1_000, 1_000_000])
def test_rows_are_exact_also_late(model, late):
    frames = range(1, 200)
    times = seconds(*(late + frame * 0.1 for frame in frames))
    expected = [(late * RATE + (frame - 1) * RATE // 10) % 800_000 for frame in frames]
    assert select_rows(model, times, 0.1, 100)[:, 0].tolist() == expected


def test_rows_between_ticks_are_those_of_exact_arithmetic(model):
    times = [0.123456, 17.00000251, 3.14159265]
    expected = [math.ceil((Fraction(t) - Fraction(1, 10)) * RATE) for t in times]
    assert model.first_rows(seconds(*times), 0.1).tolist() == [row % 800_000 for row in expected]


def test_phase_shifts_each_environment(model):
    rows = select_rows(model, seconds(0.1, 0.1), 0.1, 10, phase_rows=torch.tensor([0, 799_999]))
    assert rows[:, 0].tolist() == [0, 799_999] and rows[1, 1] == 1998


def test_more_rays_than_points_are_refused(model):
    with pytest.raises(ValueError, match=r"lidar.num_rays=20001 must be in 1..20000"):
        select_rows(model, seconds(0.1), 0.1, 20_001)


def test_grid_is_a_pinhole_camera():
    pattern = grid(3, 3, fov_deg=90.0)
    rays = pattern.directions_s.reshape(3, 3, 3)
    assert torch.allclose(rays[1, 1], torch.tensor([1.0, 0.0, 0.0]))
    pixel = 2.0 / 3.0  # at distance 1, 90 degrees span 2
    assert torch.allclose(rays[1, 0] / rays[1, 0, 0], torch.tensor([1.0, pixel, 0.0]))
    assert torch.allclose(rays[0, 2] / rays[0, 2, 0], torch.tensor([1.0, -pixel, pixel]))
    assert pattern.points_per_frame(1.0 / 30.0) == 9
    with pytest.raises(ValueError, match="fov_deg=180"):
        grid(3, 3, 180.0)


def test_a_pattern_must_be_unit_vectors():
    with pytest.raises(ValueError, match="unit vectors"):
        ScanPattern(torch.ones(2, 3), torch.zeros(2), torch.zeros(2), 10.0)
    with pytest.raises(ValueError, match="points_per_second"):
        ScanPattern(torch.eye(3), torch.zeros(3), torch.zeros(3), 0.0)
