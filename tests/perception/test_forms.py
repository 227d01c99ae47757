"""The form of the samplers for GPUs, run on the CPU, gives the points of that for CPUs, bit for bit."""

import math

import pytest
import torch
from clouds import MAX_RANGE, random_rays, sample

from omniperception.perception import Attitude, FpsSampler, PdSampler, ProximitySampler, RawSampler
from omniperception.perception.samplers import kernels, sorting

SPLIT = {"max_range": MAX_RANGE, "split_deg": 10.0}
PROXIMITY = {**SPLIT, "band_edges": (-1.0, -0.2, 0.3, 2.0), "decay": 0.6, "blind": 0.4, "body": (0.5, 0.3)}
SAMPLERS = {
    "raw": lambda num_rays: RawSampler(num_rays, max_range=MAX_RANGE),
    "pd": lambda _: PdSampler(24, 16, **SPLIT),
    "proximal alone": lambda _: PdSampler(24, 0, **SPLIT),
    "distal alone": lambda _: PdSampler(0, 16, **SPLIT),
    "more than there are": lambda _: PdSampler(700, 900, **SPLIT),
    "farthest": lambda _: FpsSampler(40, max_range=MAX_RANGE),
    "proximities": lambda _: ProximitySampler(24, 7, **PROXIMITY),
    "proximities alone": lambda _: ProximitySampler(0, 7, **PROXIMITY),
}


@pytest.fixture
def as_on_a_gpu(monkeypatch):
    """Calls a function with many lanes for each environment and all rays sorted at once."""

    def call(function, *args):
        with monkeypatch.context() as patched:
            patched.setitem(kernels.LANES, "cpu", 32)
            patched.setattr(sorting, "SORT_ALL_RAYS_ON", ("cpu",))
            return function(*args)

    return call


def attitude(num_envs):
    quat = torch.nn.functional.normalize(torch.tensor([0.9, 0.1, -0.2, 0.3]), dim=0)
    return Attitude(quat.repeat(num_envs, 1), (0.3, 0.05, -0.1), (0.1, 0.99, 0.0, 0.1))


def clouds():
    yield random_rays(5, 333, seed=1)
    yield random_rays(1, 1, seed=2, miss=0.0)
    yield random_rays(3, 40, seed=3, miss=1.0)
    yield random_rays(2, 2100, seed=4, miss=0.05)
    ranges, directions, theta, phi = random_rays(4, 200, seed=5)
    ranges[1], ranges[2, 7], ranges[3] = math.inf, math.nan, 1.0
    theta[3], phi[3] = 0.0, 0.5  # equal keys stay in ray order
    yield ranges, directions, theta, phi


@pytest.mark.parametrize("name", SAMPLERS)
def test_bit_for_bit(name, as_on_a_gpu):
    for rays in clouds():
        num_envs, num_rays = rays[0].shape
        expected = sample(SAMPLERS[name](num_rays), rays, attitude(num_envs))
        sampler = SAMPLERS[name](num_rays)
        for _ in range(2):  # with memory that has been used, too
            assert torch.equal(as_on_a_gpu(sample, sampler, rays, attitude(num_envs)), expected)


@pytest.mark.parametrize("name", ["pd", "proximities"])
def test_fewer_environments_in_the_same_memory(name, as_on_a_gpu):
    rays, sampler = random_rays(7, 300, seed=6), SAMPLERS[name](300)
    whole = as_on_a_gpu(sample, sampler, rays, attitude(7))
    for part in (slice(0, 4), slice(4, 7)):
        some = tuple(t[part].contiguous() for t in rays)
        assert torch.equal(as_on_a_gpu(sample, sampler, some, attitude(len(some[0]))), whole[part])
