"""Scan tables: validation, and which rows a frame holds at any time, against exact arithmetic."""

import itertools
import math
from fractions import Fraction

import numpy as np
import pytest
import torch
from lidar_helpers import select_rows

from omnilidar import ScanPattern, grid, vlp16, xt32

RATE = 200_000


def seconds(*values):
    return torch.tensor(values, dtype=torch.float64)


def tiny(points_per_second=10.0, **fields):
    return ScanPattern.from_angles(np.zeros(6), np.arange(6.0), points_per_second, **fields)


def test_directions_agree_with_the_angles(pattern):
    for each in (pattern, grid(7, 5, 90.0), xt32()):
        x, y, z = each.directions_s.double().T
        assert torch.allclose(torch.asin(z), each.elevation.double(), atol=1e-6)
        turn = torch.atan2(y, x) - each.azimuth.double()
        assert torch.allclose(torch.cos(turn), torch.ones(len(turn), dtype=torch.float64), atol=1e-6)


def test_angles_and_directions_make_the_same_pattern():
    elevation, azimuth = np.array([0.3, -1.2, math.pi / 2.0]), np.array([1.0, -0.5, 0.0])
    given = ScanPattern.from_angles(elevation, azimuth, 3.0)
    again = ScanPattern.from_directions(given.directions_s.numpy(), 3.0)
    assert torch.allclose(again.elevation, given.elevation, atol=1e-3)  # float32 at the zenith
    assert torch.allclose(again.azimuth[:2], torch.tensor([1.0, 2.0 * math.pi - 0.5]), atol=1e-6)
    assert given.duration_s == 1.0


def test_azimuths_stay_below_a_turn_also_after_rounding():
    azimuth = ScanPattern.from_angles(np.zeros(3), np.array([-1e-12, 2.0 * math.pi, 7.0]), 1.0).azimuth
    assert azimuth.tolist() == pytest.approx([0.0, 0.0, 7.0 - 2.0 * math.pi], abs=1e-6)


def test_a_frame_holds_every_kth_point_of_its_period_of_all_lasers(pattern):
    rows = select_rows(pattern, seconds(0.1, 0.2), 0.1, 1000)
    assert rows.shape == (2, 1000) and rows.dtype == torch.int64
    assert rows[0].tolist() == list(range(0, 19_000, 19))  # 20 would keep one laser of the four
    assert rows[1].tolist() == list(range(20_000, 39_000, 19))
    assert select_rows(pattern, seconds(0.1), 0.1, 3000)[0].tolist() == list(range(0, 15_000, 5))
    assert torch.bincount(rows[0] % 4).tolist() == [250, 250, 250, 250]


@pytest.mark.parametrize("late", [0, 1_000, 1_000_000])
def test_rows_are_exact_also_late(pattern, late):
    frames = range(1, 200)
    times = seconds(*(late + frame * 0.1 for frame in frames))
    expected = [(late * RATE + (frame - 1) * RATE // 10) % 800_000 for frame in frames]
    assert select_rows(pattern, times, 0.1, 100)[:, 0].tolist() == expected


@pytest.mark.parametrize("make", [vlp16, xt32], ids=["vlp16", "xt32"])
@pytest.mark.parametrize("step_s", [Fraction(1, 50), Fraction(7, 1000), Fraction(1, 3)])
def test_a_rate_that_is_no_multiple_of_the_step_loses_and_repeats_no_point(make, step_s):
    """In exact arithmetic: 289,352 points/s are 5787.04 per 20 ms, frames of 5787 and 5788 points one after another."""
    pattern = make()
    rate = Fraction(16, 55_296) * 10**9 if make is vlp16 else Fraction(640_000)
    steps = range(1, 400)
    first = pattern.first_rows(seconds(*(float(k * step_s) for k in steps)), float(step_s)).tolist()
    exact = [math.ceil((k - 1) * step_s * rate) for k in steps]
    assert first == [row % pattern.num_rows for row in exact]
    points = pattern.points_per_frame(float(step_s))
    assert {b - a for a, b in itertools.pairwise(exact)} <= {points, points + 1}


def test_a_pause_a_reset_and_a_replay_see_what_belongs_to_their_time(pattern):
    phase = torch.tensor([0, 799_999])
    assert select_rows(pattern, seconds(0.1, 0.1), 0.1, 10, phase)[:, :2].tolist() == [[0, 1999], [799_999, 1998]]
    straight = {t: select_rows(pattern, seconds(t, t), 0.1, 50, phase) for t in (0.1, 0.2, 0.3, 0.4)}
    for t in (0.4, 0.1, 0.1, 0.3):  # backwards, twice, after a gap: nothing is remembered
        assert torch.equal(select_rows(pattern, seconds(t, t), 0.1, 50, phase), straight[t])
    mixed = select_rows(pattern, seconds(0.1, 0.3), 0.1, 50, phase)  # environment 0 was reset
    assert torch.equal(mixed[0], straight[0.1][0]) and torch.equal(mixed[1], straight[0.3][1])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ScanPattern(torch.ones(2, 3), torch.zeros(2), torch.zeros(2), 10.0), "unit vectors"),
        (lambda: ScanPattern(torch.eye(3) * math.nan, torch.zeros(3), torch.zeros(3), 1.0), "directions_s must be fin"),
        (lambda: tiny(rows_per_shot=4), "rows_per_shot=4 must divide the 6 rows"),
        (lambda: tiny(origins_s=torch.zeros(5, 3)), r"origins_s must be finite \(6, 3\), got \(5, 3\)"),
    ],
)
def test_wrong_patterns_are_refused_in_one_line(make, message):
    with pytest.raises(ValueError, match=message) as error:
        make()
    assert "\n" not in str(error.value)
