"""An environment that diverges is caught in the same step, counted with its cause, and harms no other."""

import math

import pytest
import torch

from omniperception.learning import TrainingDiverged
from omniperception.learning.runner import Runner
from omniperception.sim import Failure

FULL = ("obstacles=moving", "randomization=paper", "perception=pd_risknet", "ppo.num_steps_per_env=12")
OTHERS = torch.tensor([0, 2, 3])
STEP = 4


def break_qvel(env, actions):
    env.sim.qvel[1, 7] = 1e12


def break_speed(env, actions):
    env.sim.qvel[1, 7] = 3e4  # the engine itself takes it


def break_place(env, actions):
    env.sim.qpos[1, 0] = 1e9


def break_action(env, actions):
    actions[1, 3] = math.nan


def break_action_inf(env, actions):
    actions[1, 3] = math.inf


def break_mass(env, actions):
    env.sim.model_field("body_mass")[1, env.world.base_body] = -20.0
    env.sim.update_model(torch.tensor([1]))


def nothing(env, actions):
    pass


CASES = {
    break_qvel: (Failure.TOO_FAST, Failure.NOT_FINITE),
    break_speed: (Failure.TOO_FAST,),
    break_place: (Failure.TOO_FAR,),
    break_action: (Failure.ACTION,),
    break_action_inf: (Failure.ACTION,),
    break_mass: tuple(Failure)[1:],
}


def roll(env, disturb, steps=12):
    """What the other environments get in every step, and what environment 1 gets in step STEP."""
    generator = torch.Generator().manual_seed(0)
    record, own = [], None
    for step in range(steps):
        actions = 0.3 * torch.randn(env.num_envs, 12, generator=generator)
        if step == STEP:
            disturb(env, actions)
        observations, reward, done, extras = env.step(actions)
        seen = {name: value[OTHERS].clone() for name, value in observations.items()}
        seen |= {"reward": reward[OTHERS].clone(), "done": done[OTHERS].clone(), "qpos": env.sim.qpos[OTHERS].clone()}
        record.append(seen)
        assert all(torch.isfinite(value.float()).all() for value in observations.values()) and reward.isfinite().all()
        if step == STEP:
            own = reward[1].item(), done[1].item(), extras["time_outs"][1].item(), env.outcomes["diverged"].tolist()
    return record, own, extras["log"]


@pytest.fixture(scope="module")
def undisturbed(make_env):
    return roll(make_env(*FULL), nothing)[0]


@pytest.mark.parametrize("disturb", CASES, ids=lambda case: case.__name__)
def test_divergence_is_caught_in_its_step_named_and_stays_alone(make_env, undisturbed, disturb):
    record, own, log = roll(make_env(*FULL), disturb)
    assert own == (0.0, 1, 0.0, [False, True, False, False])
    assert log["Anomalies/diverged"] == 1
    counted = {cause for cause in Failure if log.get(f"Anomalies/{cause.name.lower()}")}
    assert len(counted) == 1 and counted <= set(CASES[disturb])
    for before, after in zip(undisturbed, record, strict=True):
        assert before.keys() == after.keys()
        for name in before:
            assert torch.equal(before[name], after[name]), name


def test_a_warning_of_the_engine_is_a_failure(make_env):
    """A roll-out stops a simulation at its first warning, here of full contact buffers, and says nothing."""
    env = make_env("obstacles=moving", blind=True)
    env.sim.batch.warning[2, 1, 1] += 1
    _, reward, done, _ = env.step(torch.zeros(4, 12))
    assert done.tolist() == [0, 0, 1, 0] and reward[2] == 0
    assert env.metrics.drain()["Anomalies/engine"] == 1
    assert not env.step(torch.zeros(4, 12))[2].any()


def test_a_diverged_environment_does_not_climb_the_terrain(make_env):
    env = make_env("terrain=mixed", "obstacles=none", blind=True)
    before = env.ground.level.clone()
    env.sim.qpos[1, 0] += 20.0 * env.config.terrain.tile_size  # far enough to be called walked
    env.sim.qvel[1, 0] = 2e3
    env.step(torch.zeros(4, 12))
    assert env.ground.level[1] <= before[1]


def test_diverged_environments_do_not_raise_the_curriculum(make_env):
    """Their tracking error is unknown, not 0, and with nobody sound it is no reason for more obstacles."""
    env = make_env("experiment=quickstart", "ppo.num_steps_per_env=4", num_envs=2)
    for step in range(4):
        env.sim.qvel[:, 0] = math.nan
        if step == 3:
            assert env.metrics.free_velocity_error() == math.inf
        env.step(torch.zeros(2, 12))
    assert env.obstacles.level == 0.0


def test_clipped_actions_are_counted(make_env):
    env = make_env("obstacles=none", "ppo.num_steps_per_env=1", blind=True)
    actions = torch.zeros(4, 12)
    actions[2, 1] = 1e6
    log = env.step(actions)[3]["log"]
    assert log["Anomalies/clipped_actions"] == 1 and env.step(torch.zeros(4, 12))[3]["log"]["Anomalies/diverged"] == 0


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ("randomization.ground_restitution=[0,2]", r"ground_restitution=\[0.0, 2.0\] must not exceed 1"),
        ("randomization.added_mass=[nan,1]", r"added_mass=\[nan, 1\] must be"),
        ("randomization.com_x=[0,inf]", r"com_x=\[0, inf\] must be"),
        ("randomization.added_mass=[-7,5]", "a base of 6.921 kg with -1.079 kg"),
    ],
)
def test_physics_that_cannot_be_is_refused(make_env, overrides, message):
    with pytest.raises(ValueError, match=message):
        make_env("obstacles=none", "randomization=paper", "randomization.payload_mass=[-1,3]", overrides, blind=True)


@pytest.mark.parametrize("where", ["rewards", "proprioception"])
def test_a_term_that_is_not_finite_is_named(make_env, make_config, where):
    from omniperception.build import build_runner

    run = make_config("experiment=walk", "num_envs=4", "ppo.num_steps_per_env=4", "ppo.num_mini_batches=1")
    runner: Runner = build_runner(run, None)
    env = runner.env
    if where == "rewards":
        term = next(iter(env.config.rewards.terms))
        env.rewards._terms[term] = lambda _: torch.tensor([0.0, 0.0, math.nan, 0.0])
    else:
        term, broken = "joint_vel", torch.zeros(4, 12)
        broken[2, 5] = math.inf
        env._groups[where]._terms[term] = lambda _: broken
    with pytest.raises(TrainingDiverged, match=rf"non-finite {where} \({term}\), first in environment 2"):
        runner.learn(1)
