"""Proximities of what stands on the ground, in worlds whose closed forms are known, and the robot's own beside them."""

import math

import numpy as np
import pytest
import torch
from clouds import random_rays, sample
from worlds import LEVEL, PAPER, box, cloud, cylinder, plane

from omniperception.deploy.export import sampler_parameters
from omniperception.perception import Attitude, StandingSampler
from omnirobot.runtime.sampling import Attitude as RobotAttitude
from omnirobot.runtime.sampling import make_sampler

SECTORS, DECAY, EDGES = 36, 0.5, (0.0, 0.15, 0.4, 3.0)
SETTINGS = {"max_range": 6.0, "band_edges": EDGES, "decay": DECAY}


def sampler(**changes):
    return StandingSampler(SECTORS, **(SETTINGS | changes))


def sampled(rays):
    """(P, 3) of one cloud as `worlds.cloud` gives it."""
    ranges, directions, attitude = rays
    x, y, z = directions.unbind(-1)
    out = torch.full((1, 3 * SECTORS, 3), math.nan)
    angles = torch.atan2(z, torch.hypot(x, y)), torch.atan2(y, x) % (2 * math.pi)
    sampler()(ranges, directions, *angles, out, attitude)
    return out[0]


def cells(*surfaces, **given):
    """(bands, S, 3) of a world."""
    return sampled(cloud(*surfaces, **given)).unflatten(0, (3, SECTORS))


def places(cell):
    """(..., 2) m of cells (..., 3), nan where there is nothing."""
    distance = -DECAY * cell[..., 2].log()
    return torch.where(cell[..., 2:] > 0, cell[..., :2] / cell[..., 2:] * distance[..., None], math.nan)


def toward(x, y):
    return int((math.atan2(y, x) + math.pi) * SECTORS / (2 * math.pi))


@pytest.mark.parametrize("attitude", [LEVEL, (0.1, -0.1, 2.0)])
@pytest.mark.parametrize("gradient", [(0.0, 0.0), (0.2, 0.1)])
@pytest.mark.parametrize("given", [{}, PAPER])
def test_ground_noise_and_the_robot_itself_are_nothing(attitude, gradient, given):
    legs = [] if any(gradient) else [cylinder(x, y, 0.04, 0.3) for x in (-0.2, 0.19) for y in (-0.14, 0.14)]
    assert (cells(plane(gradient), *legs, attitude=attitude, **given)[..., 2] > 0).sum() <= 1  # of 108


@pytest.mark.parametrize("attitude", [LEVEL, (0.1, -0.1, 2.0)])
def test_a_box_lies_where_it_is_and_is_as_high_as_it_is(attitude):
    found = cells(plane(), box((1.0, -0.3, 0.0), (1.4, 0.3, 0.12)), attitude=attitude)
    there = [toward(1.0, y) for y in (-0.15, 0.0, 0.15)]
    np.testing.assert_allclose(places(found[0, there])[:, 0], 1.0, atol=0.06)  # one may be seen by its lid alone
    assert (found[1:] == 0).all()
    elsewhere = torch.ones(SECTORS, dtype=torch.bool)
    elsewhere[toward(1.0, -0.31) : toward(1.0, 0.31) + 1] = False
    assert (found[:, elsewhere] == 0).all()


def test_a_bar_is_in_the_band_of_its_height_above_the_ground():
    bar = cells(plane((0.0, 0.15)), box((1.2, -0.1, 0.25), (1.3, 0.1, 0.35)))[:, toward(1.2, 0.01)]
    assert bar[0, 2] == 0 and bar[2, 2] == 0
    assert abs(places(bar[1])[0] - 1.2) < 0.03


def test_each_cell_has_its_nearest():
    found = cells(plane(), cylinder(1.0, 0.0, 0.05, 1.0), box((2.0, -3.0, 0.0), (2.1, 3.0, 1.0)))
    ahead = places(found[:, toward(1.0, 0.01)])
    np.testing.assert_allclose(ahead[:, 0], 0.95, atol=0.03)  # in all bands
    np.testing.assert_allclose(places(found[:, toward(2.0, 1.0)])[:, 0], 2.0, atol=0.05)


def test_nothing_seen_is_nothing():
    nothing = cloud(lambda origin, rays: np.full(len(rays), np.inf))
    assert (sampled(nothing) == 0).all()


@pytest.mark.parametrize("attitude", [LEVEL, (0.1, -0.1, 2.0), (-0.2, 0.05, -1.0)])
@pytest.mark.parametrize("given", [{}, PAPER])
def test_a_robot_sees_the_same(attitude, given):
    bump, pole, wall = (
        box((0.8, -0.3, 0.0), (1.0, 0.1, 0.1)),
        cylinder(-0.5, 1.4, 0.05, 1.5),
        box((3, -3, 0), (4, 3, 1)),
    )
    rays = cloud(plane((0.05, -0.1)), bump, pole, wall, attitude=attitude, **given)
    ranges, directions, trained = rays
    points = torch.where(ranges[..., None].isfinite(), ranges[..., None] * directions, 0.0)[0].numpy()
    robot = RobotAttitude(trained.base_quat[0].numpy(), trained.mount_pos, trained.mount_quat)
    got, expected = make_sampler(sampler_parameters(sampler()))(points, robot), sampled(rays).numpy()
    assert (expected[:, 2] > 0).sum() > 10
    np.testing.assert_allclose(got, expected, atol=2e-5)


def test_the_heading_does_not_matter():
    rays, turned = random_rays(2, 400, seed=1), torch.tensor([[1.0, 0, 0, 0], [0.6, 0, 0, 0.8]])
    first = sample(sampler(), rays, Attitude(turned[:1].repeat(2, 1), (0.3, 0.0, -0.1), (1.0, 0.0, 0.0, 0.0)))
    other = sample(sampler(), rays, Attitude(turned[1:].repeat(2, 1), (0.3, 0.0, -0.1), (1.0, 0.0, 0.0, 0.0)))
    torch.testing.assert_close(first, other, atol=1e-4, rtol=0.0)
