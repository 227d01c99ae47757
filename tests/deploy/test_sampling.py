"""The NumPy samplers of a robot against the Warp samplers of training, on the same clouds."""

import math

import numpy as np
import pytest
import torch

from omnilidar import quat_from_rpy
from omniperception.deploy.export import sampler_parameters
from omniperception.perception import Attitude as TorchAttitude
from omniperception.perception import FpsSampler, PdSampler, ProximitySampler, RawSampler, StandingSampler
from omnirobot.common.errors import ConfigError
from omnirobot.runtime import DeployError
from omnirobot.runtime.sampling import Attitude, farthest_points, make_sampler

MAX_RANGE, RAYS = 6.0, 301
MOUNT_POS, MOUNT_QUAT = (0.29, 0.0, -0.05), quat_from_rpy(0.0, -2.8782, 3.14)
GRID = {
    "split_deg": 20.0,
    "ring_deg": 9.0,
    "band_edges": (-0.34, -0.15, -0.05, 0.15, 3.0),
    "decay": 0.5,
    "blind": 0.3,
    "body": (0.5, 0.28),
}
STANDING = {"band_edges": (0.0, 0.12, 0.34, 0.8, 3.0), "decay": 0.5}
SAMPLERS = {
    "pd": lambda: PdSampler(48, 32, max_range=MAX_RANGE, split_deg=20.0, ring_deg=9.0),
    "fps": lambda: FpsSampler(64, max_range=MAX_RANGE, ring_deg=9.0),
    "proximity": lambda: ProximitySampler(32, 36, max_range=MAX_RANGE, **GRID),
    "standing": lambda: StandingSampler(36, max_range=MAX_RANGE, **STANDING),
    "raw": lambda: RawSampler(RAYS, max_range=MAX_RANGE),
}


def directions(count, rng, low, high):
    theta, phi = np.radians(rng.uniform(low, high, count)), rng.uniform(0.0, 2 * math.pi, count)
    return np.stack((np.cos(theta) * np.cos(phi), np.cos(theta) * np.sin(phi), np.sin(theta)), 1)


def cloud(name, rng):
    """(RAYS, 3) points, misses as zeros."""
    low, high = {"all near": (21.0, 52.0), "all far": (-7.0, 19.0)}.get(name, (-7.0, 52.0))
    points = directions(RAYS, rng, low, high) * rng.uniform(0.05, 6.0, (RAYS, 1))
    if name == "duplicates":
        points = points[rng.integers(0, 20, RAYS)]
    elif name == "few":
        points[rng.permutation(RAYS)[7:]] = 0.0
    elif name == "one":
        points[1:] = 0.0
    elif name == "empty":
        points[:] = 0.0
    elif name == "random":
        points[rng.uniform(size=RAYS) < 0.3] = 0.0
    return points.astype(np.float32)


CLOUDS = ("random", "all near", "all far", "duplicates", "few", "one", "empty")


def by_training(sampler, points, base_quat):
    """What the Warp sampler makes of one cloud."""
    points = torch.from_numpy(points)[None]
    ranges = points.norm(dim=-1)
    miss = ranges == 0
    rays = torch.where(miss[..., None], torch.tensor([1.0, 0.0, 0.0]), points / ranges[..., None])
    x, y, z = rays.double().unbind(-1)
    theta, phi = torch.atan2(z, torch.hypot(x, y)), torch.atan2(y, x).remainder(2 * math.pi)
    out = torch.full((1, sampler.num_points, 3), math.nan)
    attitude = TorchAttitude(torch.tensor([base_quat], dtype=torch.float32), MOUNT_POS, MOUNT_QUAT)
    sampler(ranges.masked_fill(miss, math.inf), rays, theta.float(), phi.float(), out, attitude)
    return out[0].numpy()


def by_robot(sampler, points, base_quat=(1.0, 0.0, 0.0, 0.0)):
    return make_sampler(sampler_parameters(sampler))(points, Attitude(np.array(base_quat), MOUNT_POS, MOUNT_QUAT))


@pytest.mark.parametrize("name", SAMPLERS)
@pytest.mark.parametrize("scene", CLOUDS)
def test_robot_and_training_sample_alike(name, scene):
    rng, sampler = np.random.default_rng(CLOUDS.index(scene)), SAMPLERS[name]()
    for _ in range(20):
        base_quat = quat_from_rpy(*rng.uniform((-0.3, -0.3, -3.0), (0.3, 0.3, 3.0)))
        points = cloud(scene, rng)
        expected, got = by_training(sampler, points, base_quat), by_robot(sampler, points, base_quat)
        assert got.dtype == np.float32 and got.shape == expected.shape
        np.testing.assert_allclose(got, expected, atol=1e-6)


def test_points_on_the_split_go_where_their_elevation_says():
    """To the last bit of a float32 angle, at all ranges, as in training."""
    rng, sampler = np.random.default_rng(11), make_sampler(sampler_parameters(SAMPLERS["pd"]()))
    theta = math.radians(20.0) + rng.uniform(-3e-7, 3e-7, 20_000)
    phi, far = rng.uniform(0.0, 2 * math.pi, (2, len(theta)))
    unit = np.stack((np.cos(theta) * np.cos(phi), np.cos(theta) * np.sin(phi), np.sin(theta)), 1)
    points = (unit * far[:, None] ** 2 * MAX_RANGE / 40).astype(np.float32)
    x, y, z = points.astype(np.float64).T
    above = np.arctan2(z, np.hypot(x, y)).astype(np.float32) > np.float32(math.radians(20.0))
    assert 0.3 < above.mean() < 0.7
    np.testing.assert_array_equal(sampler._is_proximal(points), above)


@pytest.mark.parametrize("count", [1, 2, 7, 40, 60])
def test_farthest_points_by_brute_force(count):
    points = np.random.default_rng(count).normal(size=(50, 3)).astype(np.float32)
    picked = [0]
    while len(picked) < min(count, 50):
        distance = np.linalg.norm(points[:, None].astype(float) - points[picked], axis=2).min(1)
        distance[picked] = -1.0
        picked.append(int(distance.argmax()))
    found = farthest_points(points, count)
    assert found.tolist() == (picked if count < 50 else list(range(50)))


def test_what_is_no_point():
    """Rows that are not finite, zero or beyond the range."""
    rng, sampler = np.random.default_rng(5), SAMPLERS["pd"]()
    points = cloud("all near", rng)
    expected = by_robot(sampler, points)
    noisy = np.insert(points, [3, 50, 100, 200], [[math.nan] * 3, [math.inf] * 3, [0.0] * 3, [0.0, 0.0, 6.01]], axis=0)
    np.testing.assert_array_equal(by_robot(sampler, noisy.astype(np.float32)), expected)


def test_a_cloud_that_lacks_rays_is_named():
    with pytest.raises(DeployError, match=r"\(301, 3\) was expected, \(300, 3\) given"):
        by_robot(SAMPLERS["raw"](), np.ones((300, 3), np.float32))


def test_a_sampler_of_ones_own_is_not_taken_for_the_one_it_derives_from():
    class Mine(FpsSampler):
        pass

    with pytest.raises(ConfigError, match=r"perception\.sampler: a Mine cannot be exported"):
        sampler_parameters(Mine(3, max_range=5.0))
