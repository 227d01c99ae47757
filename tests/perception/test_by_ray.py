"""The kernels of a GPU, run on the CPU, sample what those of a CPU do, bit for bit."""

import math

import pytest
import torch
from clouds import MAX_RANGE, random_rays, sample

from omniperception.perception import Attitude, FpsSampler, PdSampler, ProximitySampler
from omniperception.perception.samplers import by_ray

SPLIT = {"max_range": MAX_RANGE, "split_deg": 10.0}
PROXIMITY = {**SPLIT, "band_edges": (-1.0, -0.2, 0.3, 2.0), "decay": 0.6, "blind": 0.4, "body": (0.5, 0.3)}
SAMPLERS = {
    "pd": lambda: PdSampler(24, 16, **SPLIT),
    "proximal alone": lambda: PdSampler(24, 0, **SPLIT),
    "distal alone": lambda: PdSampler(0, 16, **SPLIT),
    "more than there are": lambda: PdSampler(700, 900, **SPLIT),
    "farthest": lambda: FpsSampler(40, max_range=MAX_RANGE),
    "proximities": lambda: ProximitySampler(24, 7, **PROXIMITY),
}


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
def test_bit_for_bit(name, monkeypatch):
    for rays in clouds():
        per_env = sample(SAMPLERS[name](), rays, attitude(len(rays[0])))
        with monkeypatch.context() as patched:
            patched.setattr(by_ray, "USED_ON", ("cpu",))
            sampler = SAMPLERS[name]()
            for _ in range(2):  # with memory that has been used, too
                assert torch.equal(sample(sampler, rays, attitude(len(rays[0]))), per_env)


def test_fewer_environments_in_the_same_memory(monkeypatch):
    monkeypatch.setattr(by_ray, "USED_ON", ("cpu",))
    rays, sampler = random_rays(7, 300, seed=6), SAMPLERS["pd"]()
    whole = sample(sampler, rays)
    for part in (slice(0, 4), slice(4, 7)):
        assert torch.equal(sample(sampler, tuple(t[part].contiguous() for t in rays)), whole[part])
