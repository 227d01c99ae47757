"""Estimates of what a policy does not observe: who trains them, and who reads them."""

import pytest
import torch
from tensordict import TensorDict

from omniperception import build, config
from omniperception.config import ConfigError
from omniperception.learning.estimator import EstimatingModel, EstimatorConfig

GROUPS = {"actor": ["state"]}
SMALL = (
    "experiment=walk",
    "observations=gait_without_velocity",
    "num_envs=16",
    "ppo.hidden_dims=[16]",
    "sim.num_threads=1",
)


ESTIMATOR = EstimatorConfig("truth", hidden_dims=(16,))


def model_and_obs(estimator=ESTIMATOR):
    torch.manual_seed(0)
    state = torch.randn(512, 5)
    truth = state @ torch.tensor([[1.0, 0.0], [0.5, -1.0], [0.0, 0.3], [0.0, 0.0], [-0.7, 0.2]])
    obs = TensorDict({"state": state, "truth": truth}, batch_size=[512])
    return EstimatingModel(obs, GROUPS, "actor", 3, estimator, hidden_dims=[8]), obs


def test_the_policys_loss_does_not_reach_the_estimator_nor_the_other_way_round():
    model, obs = model_and_obs()
    model(obs).square().sum().backward()
    assert all(p.grad is None for p in model.estimator.parameters())
    assert all(p.grad is not None for p in model.mlp.parameters())
    model.zero_grad(set_to_none=True)
    model.estimation_error(obs).backward()
    assert all(p.grad is not None for p in model.estimator.parameters())
    assert all(p.grad is None for p in model.mlp.parameters())


def test_what_can_be_estimated_is_and_the_policy_reads_it():
    model, obs = model_and_obs()
    optimizer = torch.optim.Adam(model.estimator.parameters(), lr=1e-2)
    for _ in range(300):
        optimizer.zero_grad()
        model.estimation_error(obs).backward()
        optimizer.step()
    with torch.no_grad():
        before = model(obs)
        assert (model.estimate - obs["truth"]).square().mean() < 0.05 * obs["truth"].square().mean()
        assert torch.equal(model.get_latent(obs)[:, 5:], model.estimate)
        for parameter in model.estimator.parameters():
            parameter.zero_()
        assert (model(obs) - before).abs().max() > 1e-3


def test_without_an_estimator_it_is_rsl_rls_model():
    model, _ = model_and_obs(None)
    assert model.blind_dim == model.obs_dim == model.mlp[0].in_features == 5 and model.estimate is None
    assert not [name for name in model.state_dict() if "estimator" in name]


def test_a_run_learns_estimates_and_measures_by_them():
    run = build.assemble(config.compose([*SMALL, "randomization=robot", "ppo.symmetry=true"]))
    runner = build.build_runner(run, None)
    actor, env = runner.alg.actor, runner.env
    assert actor.obs_dim == env.get_observations()["proprioception"].shape[1] + 3 + 12 + 2
    weights = [p.detach().clone() for p in actor.estimator.parameters()]
    runner.learn(2)
    assert all((p != before).any() for p, before in zip(actor.estimator.parameters(), weights, strict=True))
    env.state.invalidate()
    torch.testing.assert_close(env.state.measured.base_lin_vel_b, actor.estimate, atol=1e-5, rtol=0)
    assert (env.state.measured.base_lin_vel_b - env.state.kinematics.base_lin_vel_b).abs().max() > 1e-3


def test_a_group_that_does_not_exist_is_refused():
    with pytest.raises(ConfigError, match=r"groups \['nothing'\] are used but not defined"):
        build.assemble(config.compose([*SMALL, "observations.estimated=nothing"]))


@pytest.mark.parametrize(
    ("settings", "is_velocity"),
    [
        ((), True),
        (("+observations.groups.velocity.history=2",), False),
        (("+observations.groups.extra={terms: {base_height: {}}}", "observations.estimated=extra"), False),
    ],
    ids=("velocity", "with the past", "height"),
)
def test_the_velocity_measured_is_an_estimate_of_it_alone(make_config, settings, is_velocity):
    """Estimates with a bias of 7 are measured velocities, or change nothing in them."""
    runner = build.build_runner(make_config(*SMALL, *settings), None)
    with torch.no_grad():
        list(runner.alg.actor.estimator.parameters())[-1].fill_(7.0)
        runner.alg.actor(runner.env.get_observations())
    runner.env.state.invalidate()
    velocity = runner.env.state.measured.base_lin_vel_b
    assert bool((velocity.abs() > 3.0).all()) == is_velocity
