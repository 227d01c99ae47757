"""The proximity grid against a brute-force search in float64."""

import itertools
import math

import numpy as np
import pytest
import torch
from clouds import MAX_RANGE, random_rays, sample

from omniperception.perception import Attitude, PdSampler, ProximitySampler

SPLIT, EDGES, SECTORS, DECAY, BLIND, BODY = 10.0, (-1.0, -0.2, 0.3, 2.0), 7, 0.6, 0.4, (0.5, 0.3)
MOUNT_POS, MOUNT_RPY = (0.3, 0.05, -0.1), (0.1, -2.8, 3.0)


def turn(axis, angle):
    """Rotation matrix about x (0), y (1) or z (2)."""
    c, s = math.cos(angle), math.sin(angle)
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    matrix = np.eye(3)
    matrix[i, i], matrix[j, j], matrix[i, j], matrix[j, i] = c, c, -s, s
    return matrix


def from_rpy(roll, pitch, yaw):
    return turn(2, yaw) @ turn(1, pitch) @ turn(0, roll)


def quaternion(matrix):
    """(w, x, y, z) of a rotation matrix, by its eigenvector: independent of any formula under test."""
    values, vectors = np.linalg.eig(matrix)
    axis = np.real(vectors[:, np.argmin(abs(values - 1))])
    other = np.cross(axis, [1.0, 0, 0] if abs(axis[0]) < 0.9 else [0, 1.0, 0])
    angle = math.atan2(axis @ np.cross(other, matrix @ other), other @ (matrix @ other))
    return (math.cos(angle / 2), *(math.sin(angle / 2) * axis / np.linalg.norm(axis)))


def sampler(**changes):
    options = {"split_deg": SPLIT, "band_edges": EDGES, "decay": DECAY, "blind": BLIND, "body": BODY, **changes}
    return ProximitySampler(8, SECTORS, max_range=MAX_RANGE, **options)


def attitude(rolls_pitches_yaws):
    quats = [quaternion(from_rpy(*rpy)) for rpy in rolls_pitches_yaws]
    return Attitude(torch.tensor(quats, dtype=torch.float32), MOUNT_POS, quaternion(from_rpy(*MOUNT_RPY)))


def angles(num_envs, seed):
    return np.random.default_rng(seed).uniform((-0.4, -0.4, -3.1), (0.4, 0.4, 3.1), (num_envs, 3))


def test_each_cell_holds_its_nearest_hit():
    rays, rpy = random_rays(4, 300, seed=3), angles(4, 5)
    got = sample(sampler(), rays, attitude(rpy))[:, 8:].double().numpy()
    ranges, directions, theta, _ = (x.double().numpy() for x in rays)
    filled = 0
    for env in range(4):
        level = from_rpy(rpy[env][0], rpy[env][1], 0.0)
        with np.errstate(invalid="ignore"):
            cloud = ranges[env][:, None] * (directions[env] @ from_rpy(*MOUNT_RPY).T)
            cloud = (cloud + MOUNT_POS) @ level.T
        counts = np.isfinite(ranges[env]) & (theta[env] <= np.radians(SPLIT)) & (ranges[env] >= BLIND)
        counts &= ~((abs(cloud[:, 0]) < BODY[0]) & (abs(cloud[:, 1]) < BODY[1]))
        bearing = np.arctan2(cloud[:, 1], cloud[:, 0])
        horizontal = np.hypot(cloud[:, 0], cloud[:, 1])
        for (band, (low, high)), sector in itertools.product(enumerate(itertools.pairwise(EDGES)), range(SECTORS)):
            start = -np.pi + sector * 2 * np.pi / SECTORS
            inside = counts & (cloud[:, 2] >= low) & (cloud[:, 2] < high)
            inside &= (bearing >= start) & (bearing < start + 2 * np.pi / SECTORS)
            expected = np.zeros(3)
            if inside.any():
                hit = np.flatnonzero(inside)[horizontal[inside].argmin()]
                near = math.exp(-horizontal[hit] / DECAY)
                expected = near * np.array([math.cos(bearing[hit]), math.sin(bearing[hit]), 1.0])
                filled += 1
            np.testing.assert_allclose(got[env, band * SECTORS + sector], expected, atol=1e-5)
    assert filled > 20


def test_heading_does_not_matter_and_free_space_is_zero():
    rays = random_rays(5, 200, seed=1)
    rpy = np.tile([0.2, -0.1, 0.0], (5, 1))
    ahead = sample(sampler(), rays, attitude(rpy))
    rpy[:, 2] = [0.5, -2.0, 3.1, 1.0, -0.3]
    assert torch.allclose(sample(sampler(), rays, attitude(rpy)), ahead, atol=1e-5)
    nothing = (torch.full_like(rays[0], math.inf), *rays[1:])
    assert (sample(sampler(), nothing, attitude(rpy)) == 0).all()


def test_proximal_half_is_pd_risknets():
    rays = random_rays(3, 200, seed=2)
    expected = sample(PdSampler(8, 0, max_range=MAX_RANGE, split_deg=SPLIT), rays)
    assert torch.equal(sample(sampler(), rays, attitude(angles(3, 1)))[:, :8], expected)


def test_inside_and_outside_of_inference_mode():
    rays, level = random_rays(3, 200, seed=4), attitude(angles(3, 2))
    proximities = sampler()
    with torch.inference_mode():
        inside = sample(proximities, rays, level)
    assert torch.equal(sample(proximities, rays, level), inside)


@pytest.mark.parametrize("quats", [torch.zeros(3, 4, dtype=torch.float64), torch.zeros(2, 4)])
def test_attitudes_of_another_type_or_number_are_refused(quats):
    with pytest.raises(ValueError, match=r"attitude\.base_quat must"):
        sample(sampler(), random_rays(3, 20), Attitude(quats, MOUNT_POS, quaternion(from_rpy(*MOUNT_RPY))))


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"band_edges": [0.0, 0.0]}, "band_edges"),
        ({"body": [0.1]}, "body="),
        ({}, "needs the attitude of the base"),
    ],
)
def test_impossible_grids_are_refused(change, named):
    with pytest.raises(ValueError, match=named):
        sample(sampler(**change), random_rays(2, 20))
