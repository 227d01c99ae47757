"""Which velocity explains what moved, against points that move at known velocities, and both ways of computing it."""

import math

import pytest
import torch

from omniperception.common.sectors import FAR
from omniperception.perception import MotionMatch

SECTORS, HISTORY = 36, 5
MATCH = MotionMatch(speeds=(0.75, 1.5), num_directions=12, width=0.4, period_s=0.1)
VELOCITIES = MATCH.velocities()


def sector_of(x, y):
    """Sector, and bearing from its middle (rad)."""
    turned = (math.atan2(y, x) + math.pi) * SECTORS / (2 * math.pi)
    return int(turned), (turned - int(turned) - 0.5) * 2 * math.pi / SECTORS


def seen(place, velocity):
    """(1, H, S) distances and (1, S) bearings of a point, and its sector in the newest frame."""
    distance, bearing = torch.full((1, HISTORY, SECTORS), FAR), torch.zeros(1, SECTORS)
    for k in range(HISTORY):
        age = 0.1 * (HISTORY - 1 - k)
        x, y = place[0] - velocity[0] * age, place[1] - velocity[1] * age
        sector, within = sector_of(x, y)
        distance[0, k, sector] = math.hypot(x, y)
    bearing[0, sector] = within
    return distance, bearing, sector


def test_ages_of_the_frames_count_where_they_are_known():
    """A point that comes at 1.5 m/s, seen at odd times: only with them does its velocity fit."""
    ages = [0.55, 0.37, 0.2, 0.05, 0.0]
    place = (2.0, 0.17)  # the middle of a sector, nearly
    distance, bearing = torch.full((1, HISTORY, SECTORS), FAR), torch.zeros(1, SECTORS)
    middle = math.radians(5.0)
    for k, age in enumerate(ages):
        x, y = place[0] + 1.5 * age * math.cos(middle), place[1] + 1.5 * age * math.sin(middle)
        distance[0, k, sector_of(x, y)[0]] = math.hypot(x, y)
    sector, bearing[0, sector_of(*place)[0]] = sector_of(*place)
    coming = next(k for k, v in enumerate(VELOCITIES.tolist()) if v == pytest.approx([-1.5, 0.0], abs=1e-5))
    known = MATCH(distance, bearing, VELOCITIES, torch.tensor([ages[:-1]]))[0].unflatten(0, (HISTORY - 1, -1))
    assert known[:, coming, sector].min() > 0.95
    unknown = MATCH(distance, bearing, VELOCITIES)[0].unflatten(0, (HISTORY - 1, -1))
    assert unknown[:, coming, sector].min() < 0.6


@pytest.mark.parametrize("place", [(2.0, 0.4), (-1.2, 1.9), (0.3, -2.6)])
@pytest.mark.parametrize("index", [0, 3, 13, 20])
def test_the_velocity_of_a_point_fits_all_frames(place, index):
    away, around = MATCH.velocities()[index]
    middle = -math.pi + (sector_of(*place)[0] + 0.5) * 2 * math.pi / SECTORS
    velocity = (
        away * math.cos(middle) - around * math.sin(middle),
        away * math.sin(middle) + around * math.cos(middle),
    )
    distance, bearing, sector = seen(place, velocity)
    scores = MATCH(distance, bearing, VELOCITIES)[0].unflatten(0, (HISTORY - 1, -1))
    fits = scores[:, :, sector].sum(0)
    assert fits[index].item() > HISTORY - 1 - 0.05
    assert fits[index] == fits.max()
    assert (scores[:, :, [s for s in range(SECTORS) if s != sector]] == 0).all()


def test_a_match_fades_with_distance():
    distance, bearing = torch.full((1, 2, SECTORS), FAR), torch.zeros(1, SECTORS)
    distance[0, 1, 18], distance[0, 0, 18] = 2.0, 2.1
    assert MATCH(distance, bearing, VELOCITIES)[0, 0, 18].item() == pytest.approx(1 - 0.1 / 0.4, abs=1e-5)
    distance[0, 0, 18] = 2.4
    assert MATCH(distance, bearing, VELOCITIES)[0, 0, 18].item() == pytest.approx(0.0, abs=1e-5)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"width": 0.0}, r"match\.width=0\.0 must be positive"),
        ({"num_directions": 0}, r"match\.num_directions=0 must be at least 1"),
        ({"speeds": ()}, r"match\.speeds=\[\] must be at least one"),
        ({"speeds": (1.0, -1.0)}, r"match\.speeds=\[1\.0, -1\.0\] must be at least one, all positive"),
    ],
)
def test_what_makes_no_sense_is_refused(given, message):
    with pytest.raises(ValueError, match=message):
        MotionMatch(**{"speeds": (1.0,), "num_directions": 8, "width": 0.4, "period_s": 0.1} | given)
