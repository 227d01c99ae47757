"""What happens to one environment changes nothing in the others; saved states; both simulators give the same."""

import copy
import math
from dataclasses import replace

import pytest
import torch
from stepping import FULL, OTHERS, SIMS, assert_equal, assert_same, outcome, random_actions, still, tensors

from omniperception.env.env import OmniEnv
from omniperception.env.mdp.terms import RewardTerm
from omniperception.env.state import requires
from omniperception.learning import TrainingDiverged, load_checkpoint, save_checkpoint
from omniperception.sim import Failure

TERRAIN = ("terrain=mixed", "terrain.curriculum.start_level=9", "randomization=paper", "obstacles=moving")
ROBOT = (
    *("experiment=avoid", "terrain=flat", "obstacles=crowd", "obstacles.curriculum=null", "randomization=robot"),
    *("randomization.frames_lost=0.4", "randomization.pushes.every_s=[0.02,0.1]"),
    *("lidar.num_rays=200", "lidar.selection=every_kth", "lidar.period_s=0.04"),
)
TASKS = {**{name: (*FULL, *sim) for name, sim in SIMS.items()}, "terrain": TERRAIN, "robot": ROBOT}


@pytest.mark.parametrize("task", TASKS)
def test_a_fall_in_one_environment_changes_nothing_in_the_others(make_env, task):
    quiet, disturbed = (make_env(*TASKS[task]) for _ in range(2))
    for step, action in enumerate(random_actions(quiet, 12, scale=0.3)):
        if step in (3, 8):
            disturbed.sim.qpos[1, 3:7] = torch.tensor([0.0, 1.0, 0.0, 0.0], dtype=disturbed.sim.qpos.dtype)
        assert_equal(outcome(quiet, action, OTHERS)[0], outcome(disturbed, action, OTHERS)[0])
    assert disturbed.episode_length_buf.tolist() == [12, 3, 12, 12]


@pytest.mark.parametrize("task", TASKS)
def test_a_saved_state_goes_on_bit_for_bit(make_env, tmp_path, task):
    whole, resumed = (make_env(*TASKS[task], "terminations.episode_length_s=0.2") for _ in range(2))
    actions = random_actions(whole, 30, scale=0.5)
    for action in actions[:13]:
        whole.step(action)
    for action in actions[:3]:  # whatever it did before is forgotten
        resumed.step(action)
    save_checkpoint(tmp_path / "state.pt", whole.state_dict())
    resumed.load_state_dict(load_checkpoint(tmp_path / "state.pt"))
    assert_equal(tensors(whole.get_observations()), tensors(resumed.get_observations()))
    ends, level = 0, whole.ground.level.clone() if whole.ground else None
    for action in actions[13:]:
        expected = outcome(whole, action)[0]
        assert_equal(expected, outcome(resumed, action)[0])
        ends += int(expected["done"].sum())
        if whole.ground:
            assert torch.equal(whole.ground.level, resumed.ground.level)
            assert torch.equal(whole.sim.ground_pos, resumed.sim.ground_pos)
    assert ends >= 4 and (level is None or not torch.equal(whole.ground.level, level))


@requires("cloud")
def mean_range(state):
    """Of the newest cloud; 0 without one."""
    return torch.zeros(4) if state.cloud is None else state.cloud.true_ranges.clamp(max=6.0).mean(1)


@pytest.mark.parametrize("task", ["mujoco", "robot", "goal"])
def test_a_saved_state_is_no_live_memory(make_env, task):
    env = make_env(*{**TASKS, "goal": ("scenario=maze", "lidar.num_rays=100")}[task])
    actions = random_actions(env, 6, scale=0.5)
    for action in actions[:3]:
        env.step(action)
    saved = env.state_dict()
    kept = copy.deepcopy(saved)
    for action in actions[3:]:
        env.step(action)
    env.reset()
    assert_same(saved, kept)


def test_a_saved_state_has_its_clouds_and_targets(make_env):
    def make():
        task = make_env("obstacles=static", "lidar.num_rays=100").config
        terms = task.rewards.terms | {"points": RewardTerm(1.0, mean_range)}
        return OmniEnv(replace(task, rewards=replace(task.rewards, terms=terms)))

    whole, resumed = make(), make()
    actions = random_actions(whole, 8, scale=0.5)
    for action in actions[:7]:
        whole.step(action)
    state = copy.deepcopy(whole.state_dict())
    resumed.load_state_dict(state)
    assert torch.equal(resumed.state.cloud.true_ranges, whole.state.cloud.true_ranges)
    for each in (whole, resumed):
        each.step(actions[7])
    assert torch.equal(whole.rewards.weighted["points"], resumed.rewards.weighted["points"])
    assert_same(list(whole.state.targets), list(resumed.state.targets))


def qvel(value):
    return lambda env, actions: env.sim.qvel[1, 7].fill_(value)


def qpos(column, value):
    return lambda env, actions: env.sim.qpos[1, column].fill_(value)


def action(value):
    return lambda env, actions: actions[1, 3].fill_(value)


def mass(env, actions):
    env.sim.model_field("body_mass")[1, env.world.base_body] = -20.0
    env.sim.update_model(torch.tensor([1]))


ANY = set(Failure) - {Failure(0)}
CASES = {
    "velocity": (4, qvel(1e12), {Failure.TOO_FAST, Failure.NOT_FINITE}),
    "velocity_that_the_engine_takes": (5, qvel(3e4), {Failure.TOO_FAST}),
    "velocity_nan": (5, qvel(math.nan), ANY),  # in a step that ends with a LiDAR frame
    "place": (4, qpos(0, 1e9), {Failure.TOO_FAR}),
    "place_nan": (4, qpos(2, math.nan), ANY),
    "action_nan": (4, action(math.nan), {Failure.ACTION}),
    "action_inf": (5, action(math.inf), {Failure.ACTION}),
    "mass": (4, mass, ANY),
}


def roll(env, at=-1, disturb=None):
    """What the others get in every step, what environment 1 gets in step `at`, and the log."""
    record, own = [], None
    for step, actions in enumerate(random_actions(env, 8, scale=0.3)):
        if step == at:
            disturb(env, actions)
        seen, extras = outcome(env, actions)
        record.append({name: value[OTHERS] for name, value in seen.items()})
        assert [name for name, value in seen.items() if not torch.isfinite(value.float()).all()] == []
        if step == at:
            own = *(float(seen[name][1]) for name in ("reward", "done", "time_outs")), env.outcomes["diverged"].tolist()
    return record, own, extras["log"]


@pytest.fixture(scope="module", params=SIMS)
def diverging(request, make_env):
    """Builds environments of one simulator, and what their others get if none diverges."""

    def make():
        return make_env(*FULL, *SIMS[request.param], "ppo.num_steps_per_env=8")

    return make, roll(make())[0]


@pytest.mark.parametrize("case", CASES)
def test_divergence_is_caught_in_its_step_named_and_stays_alone(diverging, case):
    (make, undisturbed), (at, disturb, causes) = diverging, CASES[case]
    record, own, log = roll(make(), at, disturb)
    assert own == (0.0, 1.0, 0.0, [False, True, False, False])
    assert log["Anomalies/diverged"] == 1 and all(math.isfinite(value) for value in log.values())
    counted = {cause for cause in Failure if log.get(f"Anomalies/{cause.name.lower()}")}
    assert len(counted) == 1 and counted <= causes
    for expected, found in zip(undisturbed, record, strict=True):
        assert_equal(expected, found)


def test_a_warning_of_the_engine_is_a_failure(make_env):
    """A roll-out stops a simulation at its first warning, here of full contact buffers, and says nothing."""
    env = make_env("obstacles=moving", blind=True)
    env.sim.batch.warning[2, 1, 1] += 1
    _, reward, done, _ = env.step(still(env))
    assert done.tolist() == [0, 0, 1, 0] and reward[2] == 0
    assert env.metrics.drain()["Anomalies/engine"] == 1
    assert not env.step(still(env))[2].any()


def test_a_diverged_environment_does_not_climb_the_terrain(make_env):
    env = make_env("terrain=mixed", "obstacles=none", blind=True)
    before = env.ground.level.clone()
    env.sim.qpos[1, 0] += 20.0 * env.config.terrain.tile_size  # far enough to be called walked
    env.sim.qvel[1, 0] = 2e3
    env.step(still(env))
    assert env.ground.level[1] <= before[1]


def test_diverged_environments_do_not_raise_the_curriculum(make_env):
    """Their tracking error is unknown, not 0."""
    env = make_env("experiment=quickstart", "ppo.num_steps_per_env=4", num_envs=2)
    for step in range(4):
        env.sim.qvel[:, 0] = math.nan
        if step == 3:
            assert env.metrics.calm_velocity_error() == math.inf
            assert "Metrics/calm_velocity_error" not in env.metrics.drain()
        env.step(still(env))
    assert env.obstacles.level == 0.0


def test_clipped_actions_are_counted(make_env):
    env = make_env("obstacles=none", "ppo.num_steps_per_env=1", blind=True)
    actions = still(env)
    actions[2, 1] = 1e6
    log = env.step(actions)[3]["log"]
    assert log["Anomalies/clipped_actions"] == 1 and env.step(still(env))[3]["log"]["Anomalies/diverged"] == 0


@pytest.mark.parametrize("where", ["rewards", "proprioception"])
def test_a_term_that_is_not_finite_is_named(make_env, make_config, where):
    from omniperception.build import build_runner

    run = make_config("experiment=walk", "num_envs=4", "ppo.num_steps_per_env=4", "ppo.num_mini_batches=1")
    runner = build_runner(run, None)
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


def test_both_simulators_show_the_same(make_env):
    """The same seed gives the same world; one control step later float32 physics differs by little."""
    first, second = (make_env(*FULL, *sim) for sim in SIMS.values())
    for action in random_actions(first, 2, scale=0.3):
        one, other = outcome(first, action)[0], outcome(second, action)[0]
        for name in ("command", "proprioception", "privileged", "height_target", "reward"):
            torch.testing.assert_close(one[name], other[name], atol=2e-3, rtol=0, msg=name)
    same = (one["frames"] - other["frames"]).abs().amax(-1) < 1e-3
    assert (one["frames"] != 0).any() and same.float().mean() > 0.95  # a ray at an edge may hit the other side


@pytest.mark.slow
def test_a_height_field_carries_the_robot_in_both(make_env):
    heights = []
    for sim in SIMS.values():
        env = make_env(*FULL, *sim, "terrain=stairs", "terrain.levels=2", "terrain.curriculum=null")
        for action in random_actions(env, 5, scale=0.03):
            env.step(action)
        assert (env.state.foot_force[..., 2].sum(1) < -20).all()  # all stand
        heights.append(env.state.base_height)
    torch.testing.assert_close(*heights, atol=3e-3, rtol=0)
