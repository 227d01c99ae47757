"""Coverage on cases with known answers, and the command that prints them."""

import math

import numpy as np
import pytest
import torch

from benchmarks.pattern_coverage import (
    angle_to_table,
    cell_share,
    command,
    compare,
    largest_gap_deg,
    overlap,
    selection_coverage,
    strategy_coverage,
)
from omniperception.lidar import ScanPattern, make_selection
from omniperception.lidar.patterns.cells import SphereCells


def circle(count=360, rate=360.0, start_deg=0.5):
    """Rays around the horizon, one turn per second."""
    azimuth = np.radians(start_deg + 360.0 / count * np.arange(count))
    return ScanPattern.from_angles(np.full(count, 1e-3), azimuth, rate)


def test_overlap_of_the_same_and_of_nothing():
    a, b = np.array([0.5, 0.5, 0.0]), np.array([0.0, 0.25, 0.75])
    assert overlap(a, a) == 1.0 and overlap(a, b) == 0.25 and overlap(a, np.array([0.0, 0.0, 1.0])) == 0.0


def test_shares_sum_to_one_and_lie_where_the_rays_are():
    cells = SphereCells(10.0)
    share = cell_share(circle(), 0.0, 0.25, cells)
    assert share.sum() == pytest.approx(1.0) and (share > 0).sum() == 9  # a quarter of 36 cells
    later = cell_share(circle(), 0.5, 0.25, cells)
    assert overlap(share, later) == 0.0


def test_a_quarter_of_a_turn_sees_a_quarter_of_the_field():
    pattern = circle()
    selection = make_selection(pattern, 0.25, 90)
    quarter, whole = selection_coverage(pattern, selection, 0.25, (0.25, 1.0), cell_deg=10.0)
    assert quarter.seen == pytest.approx(0.25) and whole.seen == 1.0
    assert quarter.gap_deg == pytest.approx(135.0, abs=6.0)  # to the middle of the other three quarters
    assert whole.gap_deg == pytest.approx(0.0, abs=0.1)


def test_half_the_rays_leave_gaps_of_their_spacing():
    pattern = circle()
    (row,) = selection_coverage(pattern, make_selection(pattern, 1.0, 36), 1.0, (1.0,), cell_deg=1.0)
    assert row.seen == pytest.approx(0.1) and row.gap_deg == pytest.approx(5.0, abs=0.01)


def test_largest_gap_is_the_farthest_direction():
    rays = torch.eye(3)
    corner = torch.full((1, 3), 1.0 / math.sqrt(3.0))
    assert largest_gap_deg(corner, rays) == pytest.approx(math.degrees(math.acos(1.0 / math.sqrt(3.0))), abs=1e-3)
    assert largest_gap_deg(torch.cat([corner, -corner]), rays) == pytest.approx(125.264, abs=1e-2)
    assert largest_gap_deg(rays, rays) == pytest.approx(0.0, abs=0.05)


def test_a_pattern_against_itself_and_against_its_turned_self():
    pattern, turned = circle(), circle(start_deg=5.5)
    for row in compare(pattern, pattern, (0.25, 1.0), cell_deg=10.0):
        assert row.overlap == pytest.approx(1.0) and row.seen_model == row.seen_table
    (row,) = compare(pattern, turned, (0.25,), cell_deg=10.0)
    assert row.overlap == pytest.approx(85.0 / 90.0, abs=1e-6)


def test_angle_between_equal_rows_and_the_nearest_rows():
    pattern, turned = circle(), circle(start_deg=1.5)
    assert angle_to_table(turned, pattern) == pytest.approx((1.0, 1.0), abs=1e-4)
    assert angle_to_table(turned, pattern, slack_rows=1) == pytest.approx((0.0, 0.0), abs=1e-4)


def test_every_strategy_is_measured_beside_all_points():
    coverage = strategy_coverage(circle(), period_s=0.5, num_rays=20, durations_s=(0.5,), cell_deg=5.0)
    assert list(coverage) == ["every_kth", "stratified", "all"]
    assert coverage["all"][0].seen == pytest.approx(0.5)
    assert all(0.0 < rows[0].seen <= 0.5 + 1e-9 for rows in coverage.values())


def test_the_command_prints_and_draws(capsys, tmp_path):
    command(["sensors=xt16", "num_rays=100", "cell_deg=10", f"out={tmp_path}"])
    printed = capsys.readouterr().out
    assert "100 rays every 0.1 s" in printed and printed.count("stratified") == 3
    assert (tmp_path / "patterns.png").stat().st_size > 10_000 and (tmp_path / "pattern_coverage.csv").is_file()
