"""The velocity that a policy asks its gait for: observed, limited, stored, resumed."""

import pytest
import torch

from omniperception import build
from omniperception.config import ConfigError

SMALL = (
    *("experiment=avoid", "init=unread", "num_envs=6", "seed=4", "ppo.hidden_dims=[16]", "sim.num_threads=1"),
    *("lidar.num_rays=200", "obstacles=static", "obstacles.curriculum=null", "rewards.avoidance.max_acceleration=3.0"),
    *(
        "ppo.num_learning_epochs=1",
        "ppo.num_steps_per_env=12",
        "ppo.num_mini_batches=2",
        "perception.supervised_epochs=1",
    ),
    "terminations.episode_length_s=0.4",
)


@pytest.fixture
def make_runner(make_config):
    def make(*settings, size=0.3):
        torch.manual_seed(0)
        runner = build.build_runner(make_config(*SMALL, *settings), None)
        with torch.no_grad():  # a read-out that sees things everywhere
            for part in (runner.alg.actor.read_out, runner.alg.actor.perception):
                for parameter in part.parameters():
                    parameter.add_(size * torch.randn_like(parameter))
        return runner

    return make


def test_it_is_observed_at_the_next_step_and_changes_no_faster_than_the_limit(make_runner):
    runner = make_runner()
    env, actor, obs = runner.env, runner.alg.actor, runner.env.get_observations()
    most, longest, began = 3.0 * env.control_dt, 0.0, 0
    assert not obs["last_asked"].any()
    with torch.inference_mode():
        for _ in range(30):
            before = obs["last_asked"].clone()
            obs, _, done, _ = env.step(actor(obs))
            longest = max(longest, float((actor.asked - before).norm(dim=1).max()))
            going = done == 0
            assert torch.equal(obs["last_asked"][going], actor.asked[going]) and not obs["last_asked"][~going].any()
            began += int((~going).sum())
    assert began > 0 and longest == pytest.approx(most, rel=1e-4)
    assert (actor.asked - env.state.reference[:, :2]).norm(dim=1).max() > 0.05  # it avoids something


def test_an_update_sees_what_the_policy_acted_on(make_runner):
    """PPO's first ratio is 1: the stored velocities limit the update's as they limited the rollout's."""
    runner = make_runner()
    obs = runner.env.get_observations()
    with torch.inference_mode():
        for _ in range(12):
            obs = runner.step(obs)
    alg = runner.alg
    with torch.no_grad():
        [batch] = alg.storage.mini_batch_generator(1, 1)
        alg.actor(batch.observations, stochastic_output=True)
        got = alg.actor.get_output_log_prob(batch.actions)
    torch.testing.assert_close(got, batch.old_actions_log_prob.squeeze(-1), atol=1e-4, rtol=1e-4)
    assert batch.observations["last_asked"].any()


@pytest.mark.parametrize("end_to_end", [True, False])
def test_an_update_in_bfloat16_perceives_what_was_acted_on(make_runner, end_to_end):
    """What rounds off there moves V_avoid by so much that PPO would take it for a step of its own."""
    runner = make_runner(f"perception.supervised_epochs={0 if end_to_end else 1}")
    obs = runner.env.get_observations()
    with torch.inference_mode():
        for _ in range(12):
            obs = runner.step(obs)
    alg, seen = runner.alg, []
    velocity = alg.actor.read_out.velocity
    alg.actor.read_out.velocity = lambda *given: seen.append(given) or velocity(*given)
    [batch] = alg.storage.mini_batch_generator(1, 1)
    for in_bfloat16 in (False, True):
        with torch.no_grad(), torch.autocast("cpu", torch.bfloat16, enabled=in_bfloat16):
            alg.actor(batch.observations)
    (features, _), (in_bfloat16, _) = seen
    assert features.any() and torch.equal(features, in_bfloat16)


@pytest.mark.parametrize("end_to_end", [True, False])
def test_the_loss_of_ppo_reaches_perception_by_way_of_the_controller(make_runner, end_to_end):
    """No weight of the gait's reads the embedding, so there is no other way; against a finite difference."""
    epochs = f"perception.supervised_epochs={0 if end_to_end else 1}"
    runner = make_runner(epochs, "rewards.avoidance.max_acceleration=null", size=0.05)
    obs = runner.env.get_observations()
    with torch.inference_mode():
        for _ in range(12):
            obs = runner.step(obs)
    actor = runner.alg.actor
    assert not actor.mlp[0].weight[:, actor.blind_dim :].any()
    actor.supervision = {}  # its own loss left out
    [batch] = runner.alg.storage.mini_batch_generator(1, 1)
    parameters = list(actor.perception.parameters())
    advantages = torch.randn(batch.old_actions_log_prob.shape[0], dtype=torch.float64)

    def loss():
        actor(batch.observations, stochastic_output=True)
        return (advantages * actor.get_output_log_prob(batch.actions).flatten().double()).sum()

    def shifted(shift):
        before = [parameter.clone() for parameter in parameters]
        for parameter, gradient in zip(parameters, gradients, strict=True):
            parameter += 0.0 if gradient is None else shift * gradient / size
        value = loss()
        for parameter, old in zip(parameters, before, strict=True):
            parameter.copy_(old)
        return float(value)

    gradients = torch.autograd.grad(loss(), parameters, allow_unused=True)
    if not end_to_end:
        assert all(gradient is None for gradient in gradients)
        return
    size = float(sum(gradient.square().sum() for gradient in gradients if gradient is not None).sqrt())
    with torch.no_grad():
        slope = (shifted(2e-3) - shifted(-2e-3)) / 4e-3
    assert size > 0.01 and slope == pytest.approx(size, rel=0.15)


def test_a_state_goes_on_with_it(make_runner):
    one, other = make_runner(), make_runner()
    with torch.inference_mode():
        obs = one.env.get_observations()
        for _ in range(7):
            obs = one.env.step(one.alg.actor(obs))[0]
        other.env.load_state_dict(one.env.state_dict())
        again = other.env.get_observations()
        assert obs["last_asked"].any() and torch.equal(again["last_asked"], obs["last_asked"])
        for _ in range(5):
            obs, again = (run.env.step(run.alg.actor(seen))[0] for run, seen in ((one, obs), (other, again)))
    assert torch.equal(again["last_asked"], obs["last_asked"])


def test_without_a_limit_nothing_is_observed(make_runner):
    runner = make_runner("rewards.avoidance.max_acceleration=null")
    assert runner.alg.actor.max_change is None and "last_asked" not in runner.env.get_observations()


def test_a_limit_is_positive(make_config):
    with pytest.raises(ConfigError, match=r"rewards\.avoidance\.max_acceleration=0\.0 must be positive or null"):
        make_config(*SMALL, "rewards.avoidance.max_acceleration=0.0")
