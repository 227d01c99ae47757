"""A perception network that supervision alone trains, beside PPO."""

import functools
from dataclasses import replace

import pytest
import torch
from toy_env import ToyEnv, collect, config

from omniperception.learning import PerceptivePpo
from omniperception.perception import FpsMlp, FpsSampler


def algorithm(env, avoidance_weight=0.0, network=None, **ppo):
    torch.manual_seed(0)
    cfg = config(supervised=True, **ppo)
    perception = replace(cfg.perception, avoidance_weight=avoidance_weight)
    if network is not None:
        sampler = functools.partial(FpsSampler, 3, max_range=5.0)
        perception = replace(perception, sampler=sampler, network=functools.partial(network), height_weight=0.0)
    return PerceptivePpo(env, replace(cfg, perception=perception), "cpu")


def parameters(module):
    return [p.detach().clone() for p in module.parameters()]


def test_supervision_learns_the_target():
    env = ToyEnv(6)
    alg = algorithm(env, num_learning_epochs=0)
    collect(alg, env, 8)
    errors = []
    for _ in range(60):
        errors.append(alg.fitting["perception"].update(alg.storage)["height_target"])
    assert errors[-1] < 0.3 * errors[0]


def test_an_update_trains_both_networks_and_nothing_without_a_target():
    env = ToyEnv(6)
    alg = algorithm(env)
    before = parameters(alg.actor)
    for _ in range(2):
        collect(alg, env, 8)
        assert alg.update()["height_target"] > 0
    now = dict(alg.actor.named_parameters())
    unchanged = [name for name, old in zip(now, before, strict=True) if torch.equal(now[name], old)]
    assert unchanged == [name for name in now if name.startswith("perception.distal")]


@pytest.mark.parametrize(("avoidance_weight", "network"), [(0.0, None), (5.0, None), (5.0, FpsMlp)])
def test_ppo_sees_what_the_policy_acted_on_and_does_not_change_it(avoidance_weight, network):
    """With and without frames; an MLP's embedding of no frame depends on its weights, too."""
    env = ToyEnv(6, episode=9)
    alg = algorithm(env, avoidance_weight, network)
    collect(alg, env, 8)
    before = list(alg.actor.perception_parameters())[-1].detach().clone()
    alg.fitting.pop("perception").update(alg.storage)  # what follows is PPO alone
    after_supervision = [p.detach().clone() for p in alg.actor.perception_parameters()]
    assert not avoidance_weight or (after_supervision[-1] - before).abs().max() > 1e-3  # the read-out's bias
    for batch in alg.storage.mini_batch_generator(2, 1):
        alg.actor(batch.observations, stochastic_output=True)
        log_prob = alg.actor.get_output_log_prob(batch.actions)
        has_frame = batch.observations.step_count > 0
        assert has_frame.any() and not has_frame.all()
        assert torch.allclose(log_prob, batch.old_actions_log_prob.squeeze(-1), atol=1e-4)
    alg.update()
    assert all(map(torch.equal, after_supervision, alg.actor.perception_parameters()))


def test_a_policy_may_be_supervised_from_some_iteration_on():
    env = ToyEnv(6)
    alone = PerceptivePpo(env, config(), "cpu")
    collect(alone, env, 8)
    alone.update()
    supervised = algorithm(env)
    supervised.load(alone.save())
    assert not supervised.fitting["perception"].optimizer.state
    collect(supervised, env, 8)
    assert supervised.update()["height_target"] > 0


def test_a_rollout_without_a_frame_teaches_nothing():
    env = ToyEnv(4, period=1000)
    alg = algorithm(env)
    before = parameters(alg.actor.perception)
    collect(alg, env, 8)
    assert "height_target" not in alg.update()
    assert all(map(torch.equal, before, parameters(alg.actor.perception)))


def test_without_epochs_of_ppo_the_policy_stays_as_it_is():
    env = ToyEnv(6)
    alg = algorithm(env, num_learning_epochs=0)
    before = {name: value.clone() for name, value in (alg.actor.state_dict() | alg.critic.state_dict()).items()}
    errors = []
    for _ in range(12):
        collect(alg, env, 8)
        losses = alg.update()
        errors.append(losses["height_target"])
    after = alg.actor.state_dict() | alg.critic.state_dict()
    assert set(losses) == {"height_target"} and errors[-1] < 0.7 * errors[0]
    changed = {name for name in before if not torch.equal(before[name], after[name])}
    assert changed and all(name.startswith("perception.proximal") for name in changed)


def test_the_learning_rate_falls():
    env, cfg = ToyEnv(4), config(max_iterations=4, num_learning_epochs=0)
    perception = replace(cfg.perception, supervised_epochs=1, learning_rate=1e-3, final_learning_rate=2e-4)
    alg, rates = PerceptivePpo(env, replace(cfg, perception=perception), "cpu"), []
    for _ in range(5):
        collect(alg, env, 8)
        alg.update()
        rates.append(alg.fitting["perception"].optimizer.param_groups[0]["lr"])
    assert rates == pytest.approx([1e-3, 8e-4, 6e-4, 4e-4, 2e-4])
