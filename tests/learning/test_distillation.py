"""A teacher that is told where to go, and a student that learns to do the same from what it sees."""

from dataclasses import replace

import pytest
import torch
from rsl_rl.models import MLPModel
from tensordict import TensorDict
from toy_env import ToyEnv, collect, config, steps_of

from omniperception.learning import PerceptivePpo, WindowedObservations
from omniperception.learning.distillation import DistillationConfig, Teacher
from omniperception.learning.phases import FIRST_LEARNING_RATE


def teacher(env, seed=1):
    torch.manual_seed(seed)
    distribution = {"class_name": "GaussianDistribution", "init_std": 0.5}
    groups = {"actor": ["command"]}
    return MLPModel(env.get_observations(), groups, "actor", env.num_actions, [8], "elu", distribution_cfg=distribution)


def algorithm(env, frames, **distillation):
    torch.manual_seed(0)
    wanted = DistillationConfig("somewhere", **{"iterations": 20, "learning_rate": 1e-2, **distillation})
    settings = replace(config(frames, num_learning_epochs=4), distillation=wanted)
    return PerceptivePpo(env, settings, "cpu")


def test_a_teacher_follows_command_and_avoidance_together():
    env = ToyEnv(5)
    actor, obs = teacher(env), env.get_observations()
    moved = obs["command"].clone()
    moved[:, :2] += obs["avoidance_target"]
    expected = actor(TensorDict({"command": moved}, [5]))
    kept = obs["command"].clone()
    assert torch.equal(Teacher(actor).actions(obs), expected)
    assert torch.equal(obs["command"], kept) and not torch.equal(actor(obs), expected)


def test_a_teacher_without_a_group_of_its_command_is_refused():
    actor = teacher(ToyEnv(5))
    actor.obs_groups = ["proprioception"]
    with pytest.raises(ValueError, match="distillation.teacher reads proprioception, but no group 'command'"):
        Teacher(actor)


@pytest.mark.parametrize("frames", [True, False])
def test_the_student_comes_to_do_what_the_teacher_does(frames):
    env = ToyEnv(32, frames=frames)
    alg, actor = algorithm(env, frames), teacher(ToyEnv(5))
    alg.learn_from(Teacher(actor))
    before = {name: p.clone() for name, p in actor.named_parameters()}
    critic = [p.clone() for p in alg.critic.parameters()]
    imitation = []
    for _ in range(20):
        collect(alg, env, 8)
        imitation.append(alg.update()["imitation"])
    assert imitation[-1] < 0.1 * imitation[0]
    assert not any(torch.equal(p, was) for p, was in zip(alg.critic.parameters(), critic, strict=True))
    assert alg.learning_rate == 1e-3  # PPO's own
    assert all(torch.equal(p, before[name]) for name, p in actor.named_parameters())

    collect(alg, env, 8)
    batch = next(iter(alg.storage.mini_batch_generator(1, 1))).observations
    groups = batch.groups if isinstance(batch, WindowedObservations) else batch
    with torch.no_grad():
        error = (alg.actor(batch) - Teacher(actor).actions(groups)).square().mean()
    assert error < 0.2 * imitation[0]
    rates = steps_of(alg)
    losses = alg.update()
    assert "surrogate" in losses and "imitation" not in losses  # PPO's turn
    assert rates[0] <= 1.5 * FIRST_LEARNING_RATE  # a lesson is not lost in PPO's first step


def test_what_does_not_fit_is_refused():
    env = ToyEnv(4)
    alg = algorithm(env, frames=True)
    collect(alg, env, 8)
    with pytest.raises(RuntimeError, match="needs a teacher"):
        alg.update()
    stranger = Teacher(teacher(env))
    stranger.groups = (*stranger.groups, "clock")
    with pytest.raises(ValueError, match="distillation.teacher reads the observations clock"):
        alg.learn_from(stranger)
