"""Several families behind one environment are, bit for bit, the families alone."""

from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from stepping import assert_equal, random_actions, tensors

from omniperception import build, config
from omniperception.env.env import OmniEnv
from omniperception.env.mixed import MixedEnv, families_of, shares_of
from omniperception.learning import load_checkpoint, save_checkpoint
from omniperception.plan import parts_of
from omnirobot.common.errors import ConfigError

BLIND = ("experiment=walk", "sim=mujoco", "sim.num_threads=1")
SEEING = (
    *("experiment=avoid", "terrain=flat", "init=null", "sim.num_threads=1", "lidar.num_rays=200"),
    *("lidar.selection=every_kth", "lidar.period_s=0.04"),
)
TASKS = {"blind": BLIND, "seeing": SEEING}
SHORT = ("families.crossing.episode_length_s=0.2", "families.hold.episode_length_s=0.3")


def compose(*overrides, num_envs=5):
    return build.assemble(config.compose(["~experiment", f"num_envs={num_envs}", *overrides]))


def families(*overrides, num_envs=5, task="blind"):
    return compose(*TASKS[task], "family=[crossing,hold]", *SHORT, *overrides, num_envs=num_envs).family_envs()


def step(env, action):
    observations, reward, done, extras = env.step(action)
    seen = {**tensors(observations), "reward": reward, "done": done, "time_outs": extras["time_outs"]}
    return {name: value.clone() for name, value in seen.items()}


@pytest.mark.parametrize("task", TASKS)
def test_families_are_what_they_are_alone(task):
    tasks = families(task=task)
    mixed, alone = MixedEnv(tasks), {name: OmniEnv(own) for name, own in tasks.items()}
    assert (mixed.num_envs, mixed.parts) == (5, {"crossing": slice(0, 3), "hold": slice(3, 5)})
    assert mixed.max_episode_length.tolist() == [10, 10, 10, 15, 15]
    ends = 0
    for action in random_actions(mixed, 34, scale=0.5):
        together = step(mixed, action)
        for name, part in mixed.parts.items():
            expected = step(alone[name], action[part])
            assert_equal(expected, {key: value[part] for key, value in together.items()})
            assert torch.equal(mixed.episode_length_buf[part], alone[name].episode_length_buf)
        ends += int(together["done"].sum())
    assert ends >= 10


def test_a_fall_in_one_family_changes_nothing_in_the_other():
    quiet, disturbed = (MixedEnv(families()) for _ in range(2))
    other = quiet.parts["hold"]
    for number, action in enumerate(random_actions(quiet, 12, scale=0.3)):
        if number == 3:
            qpos = disturbed.envs["crossing"].sim.qpos
            qpos[1, 3:7] = torch.tensor([0.0, 1.0, 0.0, 0.0], dtype=qpos.dtype)
        seen = [{name: value[other] for name, value in step(env, action).items()} for env in (quiet, disturbed)]
        assert_equal(*seen)
    assert quiet.episode_length_buf.tolist() != disturbed.episode_length_buf.tolist()


@pytest.mark.parametrize("task", TASKS)
def test_a_saved_state_goes_on_bit_for_bit(tmp_path, task):
    whole, resumed = (MixedEnv(families(task=task)) for _ in range(2))
    actions = random_actions(whole, 24, scale=0.5)
    for action in actions[:9]:
        whole.step(action)
    for action in actions[:2]:  # whatever it did before is forgotten
        resumed.step(action)
    save_checkpoint(tmp_path / "state.pt", whole.state_dict())
    resumed.load_state_dict(load_checkpoint(tmp_path / "state.pt"))
    assert_equal(tensors(whole.get_observations()), tensors(resumed.get_observations()))
    for action in actions[9:]:
        assert_equal(step(whole, action), step(resumed, action))
    assert torch.equal(whole.episode_length_buf, resumed.episode_length_buf)


def test_frames_are_the_same_tensors_between_two_ticks():
    whole = ("families.crossing.episode_length_s=20", "families.hold.episode_length_s=20")
    env = MixedEnv(families(*whole, task="seeing"))
    ticks, frames = [], []
    for _ in range(8):
        observations = env.step(torch.zeros(5, env.num_actions))[0]
        ticks.append(observations["frame_tick"])
        frames.append(observations["frames"])
    changes = [a != b for a, b in pairwise(ticks)]
    assert changes == [True, False, True, False, True, False, True]  # 0.04 s are two control steps
    assert [a is not b for a, b in pairwise(frames)] == changes


def test_a_length_that_is_set_reaches_the_families():
    env = MixedEnv(families())
    buffer = env.episode_length_buf
    buffer.copy_(torch.tensor([9, 0, 0, 14, 0]))
    assert [own.episode_length_buf.tolist() for own in env.envs.values()] == [[9, 0, 0], [14, 0]]
    _, _, done, extras = env.step(torch.zeros(5, env.num_actions))
    assert done.tolist() == [1, 0, 0, 1, 0] and extras["time_outs"].tolist() == [1, 0, 0, 1, 0]
    env.episode_length_buf = torch.tensor([1, 2, 3, 4, 5])
    assert buffer.tolist() == [1, 2, 3, 4, 5]
    assert [own.episode_length_buf.tolist() for own in env.envs.values()] == [[1, 2, 3], [4, 5]]


def test_logs_say_how_each_family_fares():
    tasks = {name: replace(own, log_interval=20) for name, own in families().items()}
    mixed, alone = MixedEnv(tasks), {name: OmniEnv(own) for name, own in tasks.items()}
    for action in random_actions(mixed, 20, scale=0.3):
        log = mixed.step(action)[3].get("log")
        logs = {name: alone[name].step(action[part])[3].get("log") for name, part in mixed.parts.items()}
    for name, own in logs.items():
        assert log[f"Families/{name}_time_out_rate"] == own["Metrics/time_out_rate"]
        assert {f"Families/{name}_{rate}" for rate in ("goal_rate", "collision_rate", "fall_rate")} <= set(log)
    error = (3 * logs["crossing"]["Metrics/velocity_error"] + 2 * logs["hold"]["Metrics/velocity_error"]) / 5
    assert log["Metrics/velocity_error"] == pytest.approx(error)
    assert log["Anomalies/clipped_actions"] == sum(own["Anomalies/clipped_actions"] for own in logs.values())


def test_hooks_see_the_end_of_all_episodes():
    env = MixedEnv(families())
    env.episode_length_buf.copy_(torch.tensor([9, 0, 0, 14, 0]))
    seen = []
    env.step_hooks.append(lambda: seen.append((env.episode_length_buf.tolist(), env.final_observations())))
    observations = env.step(torch.zeros(5, env.num_actions))[0]
    ((lengths, final),) = seen
    assert lengths == [10, 1, 1, 15, 1]
    same = (final["proprioception"] == observations["proprioception"]).all(1)
    assert same.tolist() == [False, True, True, False, True]


def test_a_policy_is_asked_for_the_part_of_a_family():
    env = MixedEnv(families())
    env.state.ask_by(lambda: None)
    env.step(torch.zeros(5, env.num_actions))
    asked = torch.arange(10.0).view(5, 2)
    env.state.ask_by(lambda: asked)
    env.step(torch.zeros(5, env.num_actions))
    for name, own in env.envs.items():
        assert torch.equal(own.state.last_asked, asked[env.parts[name]])


def test_levels_go_on_in_families_and_without_them():
    curriculum = "+randomization.curriculum={start: 0.2, max_velocity_error: 0.3, rise: 0.1}"
    with_families, alone = families(curriculum), compose(*BLIND, "obstacles=moving", curriculum).env
    env = MixedEnv(with_families)
    assert len(env.curriculum_levels) == 4  # of randomization and obstacles, twice
    env.curriculum_levels = (0.3, 1.0, 0.7, 1.0)
    other = MixedEnv(with_families)
    other.begin_at_levels_of(env.state_dict())
    assert other.curriculum_levels == (0.3, 1.0, 0.7, 1.0)
    single = OmniEnv(alone)
    single.begin_at_levels_of(env.state_dict())
    assert single.curriculum_levels[:2] == (0.3, 1.0)
    other.begin_at_levels_of(single.state_dict())
    assert other.curriculum_levels == (0.3, 1.0, 0.3, 1.0)


def test_terms_that_are_not_finite_are_those_of_their_family():
    env = MixedEnv(families())
    env.step(torch.zeros(5, env.num_actions))
    env.envs["hold"].observations["command"][1] = torch.nan
    assert env.terms_not_finite("command", 4) == ["command"] and env.terms_not_finite("command", 3) == []


@pytest.mark.parametrize("task", TASKS)
def test_a_training_goes_on_exactly_where_it_was(tmp_path, task):
    short = ("ppo.num_steps_per_env=6", "ppo.num_mini_batches=2", "logger=none")
    run = compose(*TASKS[task], "family=[crossing,hold]", *SHORT, *short)
    build.seed_everything(0)
    first = build.build_runner(run, tmp_path)
    first.learn(1, init_at_random_ep_len=True)
    first.learn(1)
    second = build.build_runner(run, None)
    assert second.load(tmp_path / "checkpoints" / "model_1.pt")
    second.learn(1)
    expected, actual = (runner.alg.actor.state_dict() for runner in (first, second))
    assert_equal(expected, actual)
    assert first.env.state_dict().keys() == {"families"}


def test_a_plan_names_the_families():
    runner = build.build_runner(compose(*BLIND, "family=[crossing,hold]"), None)
    assert {"crossing obstacles", "hold obstacles", "perception"} <= parts_of(runner).keys()
    assert list(families_of(runner.env)) == ["crossing", "hold"]
    single = build.build_runner(compose(*BLIND), None)
    assert list(families_of(single.env).values()) == [single.env]


def test_what_else_reads_a_run_has_its_own_worlds(tmp_path):
    run = compose(*BLIND, "family=[crossing,hold]", "obstacles=static", "logger=none")
    config.save(run.composed, tmp_path)
    build.build_runner(run, tmp_path).learn(0)
    loaded = build.load_run(tmp_path, ["scenario=corridor", "num_envs=1", "obstacles.split=test"])
    env = build.load_policy(loaded, tmp_path).env
    assert isinstance(env, OmniEnv) and env.num_envs == 1 and "long_wall" not in env.config.obstacles.groups
    assert list(loaded.families) == ["crossing", "hold"]
    assert list(build.load_run(tmp_path, ["family=[hold]"]).families) == ["hold"]
    assert not build.load_run(tmp_path, ["families=null"]).families


@pytest.mark.parametrize(("num_envs", "numbers"), [(3, [1, 1, 1]), (4, [1, 2, 1]), (100, [25, 50, 25])])
def test_shares(num_envs, numbers):
    assert shares_of({"a": 1.0, "b": 2.0, "c": 1.0}, num_envs) == dict(zip("abc", numbers, strict=True))


def test_seeds_and_shares_of_a_run():
    run = compose(
        *BLIND, "family=[crossing,hold]", "families.crossing.share=1", "families.hold.share=3", "seed=7", num_envs=8
    )
    tasks = run.family_envs()
    assert [own.num_envs for own in tasks.values()] == [2, 6]
    assert [own.seed for own in tasks.values()] == [7, 7 + build.FAMILY_STRIDE]
    assert tasks["hold"].terminations.episode_length_s == 15.0 != run.env.terminations.episode_length_s


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["family=[nowhere]"], "family=nowhere is unknown; known: "),
        (["families.hold.obstacles.split=test"], "families.hold: obstacles.split=test is for reports, and no training"),
        (["families.hold.share=0"], "families.hold: share=0 must be positive"),
        (["+families.hold.walls=1"], "families.hold: walls is unknown; known: commands, episode_length_s, obstacles"),
        (["families.hold.obstacles.groups.cluster.kind=cone"], "families.hold: obstacles.groups.cluster: "),
        (["families.hold.obstacles=null"], "families.hold: lacks obstacles; give families.hold.obstacles=..."),
        (["num_envs=1"], "num_envs=1 gives 2 families fewer than one environment each; raise it"),
        (["families.hold.episode_length_s=0.001"], "families.hold: terminations.episode_length_s=0.001 is less than"),
        (
            ["families.hold.obstacles.curriculum={rise: 0.1}"],
            "families.hold.obstacles.curriculum: all families see LiDAR frames in the same steps",
        ),
        (
            ["observations.groups.privileged.terms.nearest_obstacles={count: 16, max_distance: 4.0}"],
            "families.hold: observations.groups.privileged.terms.nearest_obstacles has 96 numbers, and 84 in crossing",
        ),
    ],
)
def test_one_line_says_what_is_wrong(overrides, message):
    chosen = [] if "family=[nowhere]" in overrides else ["family=[crossing,hold]"]
    with pytest.raises(ConfigError) as caught:
        build.build_runner(compose(*BLIND, *chosen, *overrides), None)
    assert str(caught.value).startswith(message) and "\n" not in str(caught.value)


def test_families_that_differ_in_more_are_refused():
    tasks = families()
    with pytest.raises(ValueError, match="families.hold differs from crossing in more than num_envs, seed, obstacles"):
        MixedEnv({**tasks, "hold": replace(tasks["hold"], log_interval=7)})
