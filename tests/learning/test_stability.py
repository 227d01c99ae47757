"""Extreme numbers in learning: it stops with the cause, before they reach the weights."""

import pytest
import torch
from test_ppo import algorithm, collect, collected
from toy_env import ToyEnv, config

from omniperception.learning import PerceptivePpo, RolloutTooSmall, Runner, TrainingDiverged


def stopped_by(alg):
    """The line with which an update stops."""
    with pytest.raises(TrainingDiverged) as error:
        alg.update()
    assert "\n" not in str(error.value)
    return str(error.value)


def finite_weights(alg):
    return all(torch.isfinite(p).all() for model in (alg.actor, alg.critic) for p in model.parameters())


def test_a_frame_that_is_not_finite_does_not_reach_a_supervised_network():
    env = ToyEnv(6)
    alg = PerceptivePpo(env, config(supervised=True), "cpu")
    collect(alg, env, 8)
    alg.storage.frames[2] = float("nan")
    line = stopped_by(alg)
    assert "gradient of the perception network" in line and "observation 'frames'" in line
    assert finite_weights(alg)


@pytest.mark.parametrize("model", ["actor", "critic"])
def test_gradients_whose_norm_overflows_are_not_passed_over(model):
    """Clipping divides by their norm, infinity, and nothing would ever be learnt."""
    env = ToyEnv(4)
    alg = algorithm(env)
    for parameter in getattr(alg, model).parameters():
        parameter.register_hook(lambda gradient: gradient * 1e25)
    collect(alg, env, 8)
    assert f"gradient of the {model} overflowed in every step" in stopped_by(alg)


def test_nothing_to_learn_for_the_actor_is_no_reason_to_stop():
    alg = collected(frames=False, entropy_coef=0.0)
    alg.storage.advantages = torch.zeros_like(alg.storage.advantages)
    alg.update()
    assert finite_weights(alg)


def test_a_likelihood_ratio_that_overflows_is_the_cause():
    alg = collected(frames=False)
    alg.storage.actions.copy_(alg.storage.distribution_params[0])
    alg.storage.actions_log_prob.fill_(-100.0)
    with torch.no_grad():
        alg.actor.distribution.std_param.fill_(1e-6)
    assert "times as likely, smallest standard deviation 1.0e-06" in stopped_by(alg)
    assert finite_weights(alg)


def test_an_observation_whose_square_overflows_is_the_cause():
    alg = collected(frames=False)
    alg.storage.observations["command"][3, 2, 0] = 1e30
    assert "observation 'command' reach 1e+30, whose square overflows" in stopped_by(alg)


@pytest.mark.parametrize(
    ("num_mini_batches", "frames", "steps", "message"),
    [
        (2, True, 8, "num_mini_batches=2 must not exceed the 1 environments"),
        (2, False, 1, "num_mini_batches=2 must not exceed the 1 steps"),
        (1, False, 1, "no spread"),
    ],
)
def test_rollouts_that_are_too_small_are_refused_before_they_are_collected(num_mini_batches, frames, steps, message):
    alg = algorithm(ToyEnv(1, frames=frames), steps, frames, num_mini_batches=num_mini_batches)
    with pytest.raises(RolloutTooSmall, match=message):
        alg.check_rollout()


def test_anomalies_are_on_the_console_when_they_happen(tmp_path, capsys):
    env = ToyEnv(4)
    step = env.step

    def log(actions):
        observations, rewards, dones, extras = step(actions)
        extras["log"] |= {"Anomalies/diverged": 3.0, "Anomalies/engine": 0.0}
        return observations, rewards, dones, extras

    env.step = log
    Runner(env, config(), tmp_path).learn(1)
    line = capsys.readouterr().out
    assert "| diverged 3" in line and "engine" not in line
