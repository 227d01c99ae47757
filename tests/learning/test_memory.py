"""Memory counted before anything is allocated, against the tensors of a run."""

import functools

import pytest
import torch
from test_ppo import collect
from toy_env import ToyEnv, config

from omniperception.learning import PerceptivePpo
from omniperception.learning.config import PerceptionConfig, PPOConfig
from omniperception.learning.memory import check_fits, footprint, kept_for_backward
from omniperception.perception import DirectMlp, FpsGru, PdRiskNet, PdSampler, RawSampler

RAYS, HISTORY = 40, 4


def ppo_config(**changes):
    values = {name: 1 for name in PPOConfig.__dataclass_fields__}
    values |= {"num_steps_per_env": 8, "num_mini_batches": 2, "max_minutes": None, "schedule": "adaptive"}
    values |= {"activation": "elu", "hidden_dims": (1,)}
    return PPOConfig(**{**values, **changes})


def perception(network=DirectMlp, sampler=None, history=HISTORY, **changes):
    sampler = sampler or functools.partial(RawSampler, num_rays=RAYS, max_range=5.0)
    network = functools.partial(network)
    return PerceptionConfig(sampler, network, history, height_weight=0.0, sector_weight=0.0, **changes)


def halves(num_proximal=5, num_distal=7):
    return functools.partial(PdSampler, num_proximal, num_distal, max_range=5.0, split_deg=10.0)


def test_predicted_bytes_are_those_of_a_run():
    env, cfg = ToyEnv(6), config()
    alg = PerceptivePpo.build(env, cfg, "cpu")
    collect(alg, env, 8)
    rollout = alg.storage.frames.untyped_storage().nbytes()
    alg.update()
    parameters = list(alg.actor.perception.parameters())
    adam = [alg.optimizer.state[p][name] for p in parameters for name in ("exp_avg", "exp_avg_sq")]
    held = [*parameters, *(p.grad for p in parameters), *adam]
    needs = footprint(cfg.perception, cfg.ppo, 6, 5)
    assert needs.rollout == rollout
    assert needs.optimization == sum(t.untyped_storage().nbytes() for t in held)


def test_direct_mlp_by_hand():
    """P = 40 points, H = 4, 256 hidden, 251 out; 10 environments, 8 steps, a frame every 5: W = 3 windows, F = 6."""
    needs = footprint(perception(), ppo_config(), 10, 5)
    assert needs.parameters == 4 * 120 * 256 + 256 + 256 * 251 + 251
    assert needs.rollout == 10 * 6 * 40 * 12
    assert needs.sensor == 10 * 9 * 40 * 12
    frames, hidden, out = 5 * 6 * 120, 5 * 3 * 256, 5 * 3 * 251
    assert needs.mini_batch >= 4 * (frames + hidden + out)


@pytest.mark.parametrize(
    "network", [DirectMlp(8, 4), FpsGru(8, 4, 9), PdRiskNet(5, 3, 4, 6, 5)], ids=lambda n: type(n).__name__
)
def test_meta_tensors_are_as_large_as_real_ones(network):
    real = kept_for_backward(network, 6, 3)
    assert real == kept_for_backward(network.to("meta"), 6, 3) > 6 * 6 * 8 * 12


def test_the_papers_verdict():
    """24 GB, 4096 environments, whole Mid-360 frames (20,000 points), 10 frames: out of memory."""
    whole = perception(sampler=functools.partial(RawSampler, num_rays=20_000, max_range=5.0), history=10)
    ppo = ppo_config(num_steps_per_env=24, num_mini_batches=4)
    shared = footprint(whole, ppo, 4096, 5)
    assert shared.rollout == 4096 * 15 * 20_000 * 12 and shared.total > 24e9
    risknet = functools.partial(PdRiskNet)
    assert footprint(perception(risknet, halves(256, 128), 10), ppo, 4096, 5).total < 24e9


def test_what_cannot_fit_is_refused_in_one_line():
    check_fits(perception(), ppo_config(), 10, 5, "cpu")
    with pytest.raises(
        ValueError, match=r"DirectMlp needs 0\.0 GB with num_envs=10 .*raise .*perception\.memory_gb"
    ) as error:
        check_fits(perception(memory_gb=1e-6), ppo_config(), 10, 5, "cpu")
    assert "\n" not in str(error.value)
    huge = perception(sampler=functools.partial(RawSampler, num_rays=10**7, max_range=5.0))
    with pytest.raises(ValueError, match="but there are"):
        check_fits(huge, ppo_config(), 10**6, 5, torch.device("cpu"))
    with pytest.raises(ValueError, match=r"memory_gb=-1 must be positive"):
        perception(memory_gb=-1)
