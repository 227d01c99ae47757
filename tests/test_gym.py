"""Gymnasium's environments: its own checker, seeds, final observations."""

import warnings

import numpy as np
import pytest
import torch

import omniperception
from omnirobot.common.errors import ConfigError

gymnasium = pytest.importorskip("gymnasium", reason="extra gym")

from gymnasium.utils.env_checker import check_env  # noqa: E402
from gymnasium.vector import AutoresetMode, VectorEnv  # noqa: E402

BLIND = ("experiment=walk", "obstacles=none")
WITH_LIDAR = ("experiment=quickstart", "obstacles.curriculum=null", "lidar.num_rays=100")
SEEING = ("~experiment", "lidar.num_rays=200", "randomization=robot", "obstacles=moving")
STYLE = "symmetric and normalized|probably too|inf|env.spec"
"""What the checker would rather have, and says so."""


def rollout(env, seed, steps=12):
    """Observations of a reset and of steps with the same actions in all environments."""
    actions = np.random.default_rng(0).normal(size=(steps, 1, 12)).astype(np.float32)
    seen = [env.reset(seed=seed)[0]]
    return seen + [env.step(np.repeat(action, env.num_envs, 0))[0] for action in actions]


def alike(first, second, mine=slice(None), its=slice(None)):
    """Tell whether two rollouts are the same to the last bit, in some environments."""
    pairs = zip(first, second, strict=True)
    return all(np.array_equal(a[name][mine], b[name][its]) for a, b in pairs for name in a)


def test_gymnasiums_checker_has_no_complaint():
    env = omniperception.make_single(*BLIND)
    assert isinstance(env, gymnasium.Env)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", f".*({STYLE}).*")
        check_env(env, skip_render_check=True)


def test_seeds_decide_everything_and_resets_repeat_nothing():
    env = omniperception.make(*SEEING, num_envs=3)
    assert isinstance(env, VectorEnv) and env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    first, again, on, shifted = (rollout(env, seed) for seed in (5, 5, None, 6))
    assert env.observation_space.contains(first[-1]) and (first[-1]["frame_count"] > 0).all()
    assert alike(first, again)
    assert not any(np.array_equal(first[k]["frames"], on[k]["frames"]) for k in (0, 5, 10))
    assert alike(first, shifted, slice(1, None), slice(None, -1))  # environment k has seed + k
    assert not alike(first, first, slice(0, 1), slice(1, 2))


def test_some_environments_are_reset_and_the_others_go_on():
    env, other = (omniperception.make(*BLIND, num_envs=3, critic=True) for _ in range(2))
    for each in (env, other):
        rollout(each, 3)
    mask = np.array([False, True, False])
    env.reset(seed=[None, 8, None], options={"reset_mask": mask})
    still = np.zeros((3, 12), np.float32)
    now, then = env.step(still)[0], other.step(still)[0]
    for name in ("observations", "critic"):
        changed = (now[name] != then[name]).any(1)
        assert changed.tolist() == mask.tolist()


def test_a_reset_of_some_leaves_history_and_frames_of_the_others(vector_with_lidar):
    env, other = vector_with_lidar(), vector_with_lidar()
    for each in (env, other):
        assert (rollout(each, 3, 7)[-1]["frame_count"] == 2).all()
    before = env.env.get_observations()
    mask = np.array([False, True, False])
    env.reset(options={"reset_mask": mask})
    after = env.env.get_observations()
    names = set(after.keys()) - {"frame_tick"}  # the number of the newest frame, of all environments
    changed = {name: (after[name] != before[name]).flatten(1).any(1).tolist() for name in names}
    assert changed["proprioception"] == changed["frames"] == changed["frame_count"] == mask.tolist()
    assert not any(row[0] or row[2] for row in changed.values())
    still = np.zeros((3, 12), np.float32)
    now, then = env.step(still)[0], other.step(still)[0]
    for name in now:
        changed = (now[name] != then[name]).reshape(3, -1).any(1)
        assert changed.tolist() == mask.tolist(), name


def test_seeds_for_some_at_first_cast_no_second_frame_for_the_others(vector_with_lidar):
    seen = vector_with_lidar().reset(seed=[5, None, None])[0]
    assert seen["frame_count"].flatten().tolist() == [0, 1, 1]


def test_the_end_of_an_episode_is_told_with_its_last_frames(vector_with_lidar):
    ends, goes_on = vector_with_lidar("terminations.episode_length_s=0.14"), vector_with_lidar()
    for each in (ends, goes_on):
        rollout(each, 1, 6)
    still = np.zeros((3, 12), np.float32)
    final, expected = ends.step(still)[4]["final_obs"], goes_on.step(still)[0]
    assert (final["frame_count"] == 2).all() and (final["frames"] != 0).any()
    for name in expected:
        assert np.array_equal(final[name], expected[name]), name


def test_the_end_of_an_episode_is_told_with_its_last_observation():
    env = omniperception.make(*BLIND, "terminations.episode_length_s=0.1", num_envs=2)
    silent = omniperception.make(*BLIND, "terminations.episode_length_s=1.0", num_envs=2)
    seen, expected = rollout(env, 1, 4), rollout(silent, 1, 4)
    assert all(np.array_equal(a, b) for a, b in zip(seen, expected, strict=True))
    action = np.full((2, 12), 0.1, np.float32)
    after, _, terminated, truncated, infos = env.step(action)
    assert truncated.all() and not terminated.any() and infos["time_out"].all() and infos["_final_obs"].all()
    assert np.array_equal(infos["final_obs"], silent.step(action)[0])  # the same moment without an end
    assert not np.array_equal(infos["final_obs"], after)
    assert "final_obs" not in env.step(action)[4]
    env.env.sim.qpos[1, 3:7] = torch.tensor([0.0, 1.0, 0.0, 0.0], dtype=env.env.sim.qpos.dtype)
    _, _, terminated, truncated, infos = env.step(action)
    assert terminated.tolist() == infos["fall"].tolist() == [False, True] and not truncated.any()


def test_tensors_stay_where_they_are():
    env = omniperception.make(*BLIND, num_envs=2, arrays="torch")
    observations, groups = env.reset(seed=0)[0], env.env.get_observations()
    assert torch.equal(observations, torch.cat([groups[name] for name in env.env.config.observations.actor], 1))
    _, reward, terminated, *_ = env.step(torch.zeros(2, 12))
    assert reward.shape == (2,) and terminated.dtype == torch.bool


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda env: env.reset(seed=[1]), r"seed=\[1\] must be a whole number from 0 to 8796093022207, or 2 of"),
        (lambda env: env.reset(seed=1.5), "seed=1.5 must be a whole number from 0"),
        (lambda env: env.reset(seed=[1.5, 2]), r"seed=\[1.5, 2\] must be a whole number from 0"),
        (lambda env: env.reset(seed=2**64), "seed=18446744073709551616 must be a whole number from 0"),
        (lambda env: env.reset(options={"mask": 1}), r"options=\['mask'\] is unknown; known: reset_mask"),
        (lambda env: env.reset(options={"reset_mask": [True]}), r"reset_mask must be \(2,\) bool"),
        (lambda env: env.step(np.zeros((2, 3))), r"actions: shape \(2, 12\) was expected, \(2, 3\) given"),
        (lambda env: omniperception.make("obstacles.split=test"), "for reports, and no training may see it"),
        (lambda env: omniperception.make("num_envs=4", num_envs=2), "num_envs is given twice"),
        (lambda env: omniperception.make("robt=go2"), "did you mean robot"),
        (lambda env: omniperception.make(*BLIND, num_envs=1, arrays="jax"), "arrays=jax must be numpy or torch"),
    ],
)
def test_wrong_calls_get_one_line(vector_of_two, call, message):
    with pytest.raises(ConfigError, match=message):
        call(vector_of_two)


@pytest.fixture(scope="module")
def vector_with_lidar():
    return lambda *overrides: omniperception.make(*WITH_LIDAR, *overrides, num_envs=3)


def test_seeds_are_numbers_of_any_kind_or_none(vector_of_two):
    first, _ = vector_of_two.reset(seed=3)
    assert np.array_equal(vector_of_two.reset(seed=np.int64(3))[0], first)
    assert np.array_equal(vector_of_two.reset(seed=np.array([3, 4]))[0], first)
    again, _ = vector_of_two.reset(seed=[None, None])
    assert not np.array_equal(again, first)


def test_one_robot_takes_no_options():
    env = omniperception.make_single(*BLIND)
    with pytest.raises(ConfigError, match=r"options=\['reset_mask'\] is unknown; one robot takes none"):
        env.reset(options={"reset_mask": [True]})


@pytest.fixture(scope="module")
def vector_of_two():
    return omniperception.make(*BLIND, num_envs=2)
