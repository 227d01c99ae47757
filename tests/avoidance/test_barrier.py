"""The barrier behind a navigation policy: what it allows, by hand and beside the exact nearest velocity."""

from itertools import combinations

import numpy as np
import pytest
import torch

from omniperception.avoidance.navigation import NUM_SECTORS, navigation_inputs, within_barrier
from omniperception.avoidance.sector_motion import sector_bearings
from omniperception.avoidance.velocity_risk import VelocityRisk

RISK = VelocityRisk(1.8, 3, 36, [0.4], 0.25, 0.15, 2.0, 8.0, 0.05)
AHEAD = 18  # the sector just left of ahead
BEARINGS = sector_bearings(NUM_SECTORS)


def allowed(wanted, **obstacles):
    """What is left of a velocity among obstacles sector=(distance, v_x, v_y)."""
    sectors = torch.zeros(1, NUM_SECTORS, 3)
    sectors[..., 0] = torch.inf
    for name, obstacle in obstacles.items():
        sectors[0, int(name.removeprefix("at"))] = torch.tensor(obstacle)
    zero = torch.zeros(1, 3)
    inputs = navigation_inputs(sectors, zero, zero, zero, RISK, RISK.candidates())
    return within_barrier(torch.tensor([wanted]), inputs, 2.0, 0.25)[0]


def test_without_an_obstacle_within_reach_nothing_changes():
    for obstacles in ({}, {"at18": (4.5, -3.0, 0.0)}):
        assert allowed([1.7, -0.4, 0.9], **obstacles).tolist() == pytest.approx([1.7, -0.4, 0.9])


@pytest.mark.parametrize(
    "obstacle, most",
    [((1.0, 0.0, 0.0), 1.5), ((0.25, 0.0, 0.0), 0.0), ((0.2, 0.0, 0.0), -0.1), ((1.0, -1.0, 0.0), 0.5)],
)
def test_the_speed_towards_an_obstacle(obstacle, most):
    """2 times the gap beyond 0.25 m, plus the obstacle's own; what goes past it stays, and so does the yaw rate."""
    bearing = BEARINGS[AHEAD]
    own = float(torch.tensor(obstacle[1:]) @ bearing)
    limit = 2.0 * (obstacle[0] - 0.25) + own
    assert limit == pytest.approx(most, abs=0.01)
    aside = torch.stack((-bearing[1], bearing[0]))
    wanted = [*(1.8 * bearing + 0.6 * aside).tolist(), 0.7]
    left = allowed(wanted, at18=obstacle)
    assert float(left[:2] @ bearing) == pytest.approx(limit, abs=1e-5)
    assert float(left[:2] @ aside) == pytest.approx(0.6, abs=1e-5) and float(left[2]) == pytest.approx(0.7)
    slow = [*(min(limit, 0.0) - 0.1) * bearing, 0.0]
    assert allowed([float(v) for v in slow], at18=obstacle)[:2].tolist() == pytest.approx([float(v) for v in slow[:2]])


def nearest_allowed(wanted, bearings, most):
    """The velocity nearest to (2,) `wanted` with bearings @ v <= most: it is `wanted`, lies on a line or where two
    cross; None where there is none."""
    candidates = [wanted, *(wanted - (b @ wanted - m) * b for b, m in zip(bearings, most, strict=True))]
    for i, j in combinations(range(len(most)), 2):
        candidates.append(np.linalg.solve(bearings[[i, j]], most[[i, j]]))
    fitting = [v for v in candidates if (bearings @ v <= most + 1e-9).all()]
    return min(fitting, key=lambda v: np.linalg.norm(v - wanted)) if fitting else None


@pytest.mark.parametrize("count", [1, 3])
def test_beside_the_nearest_velocity_that_is_allowed(count):
    """Of one obstacle it is that one; of three it violates nothing by more than 0.1 m/s, and is nearly as near."""
    random, compared = np.random.default_rng(0), 0
    for _ in range(40):
        sectors = random.choice(NUM_SECTORS, count, replace=False)
        distance, speed = random.uniform(0.4, 2.5, count), random.uniform(-0.4, 0.8, (count, 2))
        wanted = random.uniform(-1.5, 1.5, 2)
        obstacles = {f"at{s}": (float(d), *map(float, v)) for s, d, v in zip(sectors, distance, speed, strict=True)}
        found = allowed([*map(float, wanted), 0.0], **obstacles)[:2].numpy()
        bearings = BEARINGS[sectors].double().numpy()
        most = 2.0 * (distance - 0.25) + (speed * bearings).sum(1)
        best = nearest_allowed(wanted, bearings, most)
        if best is None:
            continue
        compared += 1
        if count == 1:
            assert found == pytest.approx(best, abs=1e-5)
        else:
            assert (bearings @ found - most).max() < 0.1
            assert np.linalg.norm(found - wanted) < np.linalg.norm(best - wanted) + 0.3
    assert compared > 20
