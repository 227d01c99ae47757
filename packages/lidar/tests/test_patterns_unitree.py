"""Unitree's L1 and L2 against their SDKs' formula for the points of a packet, written out point by point."""

import math

import pytest
import torch

from omnilidar import unitree_l1, unitree_l2


@pytest.mark.parametrize(
    ("make", "sweeps", "count", "turns"), [(unitree_l1, 180.0, 120, 11.0), (unitree_l2, 216.0, 296, 5.55)]
)
def test_a_point_is_where_the_sdk_puts_it(make, sweeps, count, turns):
    """x = cos(theta) A - sin(theta) B, y = sin(theta) A + cos(theta) B, z = C; a unit without tilt has A = 0."""
    pattern = make()
    for row in (0, 7, count - 1, count, 37 * count + 61):
        sweep, point = divmod(row, count)
        alpha = math.pi * point / count
        theta = 2.0 * math.pi * turns * (sweep + 0.5 * point / count) / sweeps
        b, c = math.cos(alpha), math.sin(alpha)
        expected = torch.tensor([-math.sin(theta) * b, math.cos(theta) * b, c])
        torch.testing.assert_close(pattern.directions_s[row], expected, atol=1e-6, rtol=0.0)


@pytest.mark.parametrize("make", [unitree_l1, unitree_l2])
def test_the_table_closes_and_most_rays_look_up(make):
    """A half circle over the zenith at an even pace: a third of the rays above 60 degrees, where a sphere has 13 %."""
    pattern = make()
    assert (pattern.elevation > math.radians(60.0)).float().mean().item() == pytest.approx(1.0 / 3.0, abs=0.01)
    sweep = round(pattern.points_per_second / (180.0 if make is unitree_l1 else 216.0))
    step = torch.atan2(pattern.directions_s[sweep, 0], pattern.directions_s[sweep, 1])
    last = pattern.directions_s[-sweep]
    seam = torch.atan2(last[0], last[1])
    assert seam.item() == pytest.approx(-step.item(), abs=1e-4)
