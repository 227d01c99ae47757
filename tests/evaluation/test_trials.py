"""The queue of trials: which scene a trial is, which trials are counted and in which order."""

import pytest
import torch

from omniperception.common.random import EnvRandom, TrialRandom
from omniperception.evaluation.trials.episodes import run_episodes
from omniperception.evaluation.trials.outcomes import CLEARANCE_CAP
from omniperception.evaluation.trials.tracks import footprints

WALK = ("experiment=walk", "rewards=walk")
SHORT = "terminations.episode_length_s=0.4"  # 20 control steps


DRAWN = "scenario=static condition=robot"
"""With parameters of the robot that are drawn, too."""


def stand(observations):
    return torch.zeros(len(observations), 12)


def fling(env, which):
    """Robots in trials `which` throw themselves over, the others stand."""

    def policy(observations):
        actions = torch.zeros(env.num_envs, 12)
        thrown = which(env.random.trial)
        actions[thrown, 1::3], actions[thrown, 2::3] = 8.0, -8.0
        return actions

    return policy


def scenes(env, policy, trials):
    """What each trial begins with: goal, command, base, obstacles."""
    found = {}

    def look():
        for env_id in (env.episode_length_buf == 0).nonzero().flatten().tolist():
            parts = [env.command.value[env_id], env.sim.qpos[env_id].float(), footprints(env)[env_id].flatten()]
            if env.command.goal_w is not None:
                parts.append(env.command.goal_w[env_id])
            if env.randomizer.joint_offset is not None:
                mass = env.sim.model_field("body_mass")[env_id, env.world.base_body]
                parts += [env.randomizer.joint_offset[env_id], torch.stack((env.randomizer.delay[env_id], mass))]
            if env.ground is not None:
                parts.append(torch.stack((env.ground.level[env_id], env.ground.column[env_id])))
            found[int(env.random.trial[env_id])] = torch.cat([part.double() for part in parts])

    look()
    run_episodes(env, policy, trials, on_step=look)
    return found


def test_clearance_does_not_depend_on_how_many_environments_there_are(make_env):
    crowd = ("obstacles=crowd", "obstacles.curriculum=null", "terminations.episode_length_s=0.5")  # 25 steps: odd
    alone, *others = (run_episodes(make_env(*WALK, *crowd, f"num_envs={n}"), stand, 7).clearance for n in (1, 3, 5))
    assert (alone < CLEARANCE_CAP).sum() > 3
    assert all(torch.equal(alone, other) for other in others)


@pytest.mark.parametrize("scene", ["scenario=moving", "scenario=abs_hard", "terrain=mixed obstacles=static", DRAWN])
def test_a_trial_is_the_same_scene_however_many_environments_there_are(make_env, scene):
    by_number = []
    for num_envs in (1, 3, 5):
        env = make_env(*WALK, *scene.split(), SHORT, f"num_envs={num_envs}", "obstacles.curriculum=null")
        by_number.append(scenes(env, stand, 7))
    for trial in range(7):
        alone, *others = (found[trial] for found in by_number)
        assert all(torch.equal(alone.nan_to_num(7.0), other.nan_to_num(7.0)) for other in others), trial
    assert len({tuple(found.nan_to_num(7.0).tolist()) for found in map(by_number[0].get, range(7))}) == 7


def test_another_policy_gets_the_same_scenes(make_env):
    """Also where trials end early and obstacles draw again all the time."""
    found = []
    for which in (lambda trial: trial < 0, lambda trial: trial % 2 == 1):
        env = make_env(*WALK, "scenario=moving", SHORT, "terminations.min_base_height=0.25", "num_envs=3")
        env.obstacles._approach._start *= 0.2
        found.append(scenes(env, fling(env, which), 9))
    for trial in range(9):
        assert torch.equal(found[0][trial], found[1][trial])


def test_all_trials_are_counted_in_their_order_and_short_ones_no_more_than_others(make_env):
    env = make_env(
        *WALK, "obstacles=none", "terminations.episode_length_s=2.0", "terminations.min_base_height=0.25", "num_envs=3"
    )
    episodes = run_episodes(env, fling(env, lambda trial: trial % 2 == 1), 8)
    fell = episodes.ended("fall")
    assert len(episodes) == 8 and fell.tolist() == [False, True] * 4
    assert torch.allclose(episodes.length_s[~fell], torch.tensor(2.0, dtype=torch.float64))
    assert (episodes.length_s[fell] < 1.5).all()
    # the work is the sum of the lengths, not that of rounds of the slowest
    assert env.step_count * env.control_dt <= float(episodes.length_s.sum()) / 3 + 2.0


def test_streams_of_trials_are_those_of_environments_with_these_numbers():
    expected = EnvRandom(4, 5).uniform(torch.arange(5), (3,))
    random = TrialRandom(4, 2)
    got = []
    for begins in ([0, 1], [1], [0], [1]):
        random.start_episode(torch.tensor(begins))
        got.append(random.uniform(torch.tensor(begins), (3,)))
    assert torch.equal(torch.cat(got), expected) and random.trial.tolist() == [3, 4]


def test_only_trials_are_counted(make_env):
    env = make_env(*WALK, "obstacles=none", SHORT, "num_envs=2")
    env.step(torch.zeros(2, 12))
    with pytest.raises(ValueError, match="freshly built"):
        run_episodes(env, stand, 2)
    env = make_env(*WALK, "obstacles=none", SHORT, "num_envs=2", trials=False)
    with pytest.raises(ValueError, match="build it with EnvConfig.trials"):
        run_episodes(env, stand, 2)
