"""What is recorded of trials, on the real environment."""

import pytest
import torch

from omniperception.evaluation.trials.episodes import run_episodes
from omniperception.evaluation.trials.outcomes import Episodes

SHORT = "terminations.episode_length_s=0.4"  # 20 control steps
BLIND = ("lidar=none", "obstacles=none", "rewards=walk", "observations=walk")


def stand(observations):
    return torch.zeros(len(observations), 12)


def test_errors_are_means_over_the_steps_of_the_episode(make_env):
    env = make_env(*BLIND, SHORT, "num_envs=4")
    names, errors = ("velocity_error", "yaw_rate_error"), []
    keep = lambda: errors.append(torch.stack([getattr(env, name) for name in names]))  # noqa: E731
    left = []
    episodes = run_episodes(env, stand, 8, on_step=keep, on_left=left.append)
    assert left == 19 * [8] + 20 * [4] + [0]
    for name, kept in zip(names, torch.stack(errors, 1), strict=True):
        by_episode = kept.reshape(2, 20, 4).mean(1).flatten().double()
        assert torch.allclose(getattr(episodes, name), by_episode, atol=1e-6), name
    assert episodes.free_velocity_error is None and episodes.summary()["free_velocity_error_m_s"] is None


def test_contacts_are_counted_when_they_begin(make_env):
    stays = ("terminations.min_base_height=0.0", "terminations.max_tilt_deg=180.0")  # thrown over, too
    env = make_env("obstacles=moving", SHORT, *stays, "num_envs=4")
    # an obstacle on the robot of environment 2 from the first step; the last step of an episode counts, too
    touched = torch.zeros(4, dtype=torch.bool)

    def put_on_robot(observations):
        step = int(env.episode_length_buf[2])
        far, here = torch.tensor([50.0, 50.0]), env.state.kinematics.base_pos_w[2, :2]
        env.obstacles.velocity_w[2] = 0.0
        env.obstacles.pos_w[2, :, :2] = far.double()
        env.obstacles.pos_w[2, 0, :2] = here.double() if step in (5, 6, 19) else far.double()
        return torch.zeros(4, 12)

    env.obstacles.advance = lambda dt, xy: None  # the test moves them
    episodes = run_episodes(env, put_on_robot, 4, on_step=lambda: touched.logical_or_(env.contacts))
    assert episodes.contacts[2] == 2 and episodes.collided[2] and touched[2]
    assert episodes.ended("time_out")[2] and episodes.success[2]


def test_a_touch_that_physics_diverges_from_counts(make_env):
    env = make_env(*BLIND, SHORT, "num_envs=2")

    def diverge():
        if int(env.episode_length_buf[0]) == 5:
            env.contacts, env.healthy = torch.tensor([True, False]), torch.tensor([False, False])

    env.step_hooks.append(diverge)
    episodes = run_episodes(env, stand, 2)
    assert episodes.contacts.tolist() == [1, 0] and episodes.collided.tolist() == [True, False]


def test_goals_are_successes_of_goal_commands(make_env):
    goal = ("commands=corridor", "commands.spawn.x=[-0.5,-0.5]", "commands.goal_x=[-0.6,-0.6]")
    env = make_env(*BLIND, *goal, "num_envs=2")
    episodes = run_episodes(env, stand, 2)
    assert episodes.has_goal and episodes.ended("goal").all() and episodes.success.all()
    assert episodes.summary()["rates"]["success"]["count"] == 2


def test_the_free_time_is_that_of_the_straight_way(make_env):
    """To the goal's edge at the commanded speed: 10 - 0.5 m, or 12 m to a line; and no less than it has to be held."""
    spawn = ("commands.spawn.x=[0,0]", "commands.spawn.y=[3,3]", "commands.speed=0.5")
    for commands, goal, expected in (
        (("commands=goal", "commands.radius=0.5"), (6.0, -5.0), 19.0),  # 6 m ahead, 8 m aside
        (("commands=goal", "commands.radius=null"), (12.0, 0.0), 24.0),
        (("commands=goal", "commands.radius=0.5", "+commands.hold_s=20.0"), (6.0, -5.0), 20.0),
    ):
        at = tuple(f"commands.goal_{axis}=[{x},{x}]" for axis, x in zip("xy", goal, strict=True))
        episodes = run_episodes(make_env(*BLIND, *commands, *spawn, *at, SHORT, "num_envs=2"), stand, 3)
        assert episodes.free_time_s.tolist() == pytest.approx([expected] * 3, abs=1e-5)


def test_the_world_of_each_trial_is_filed(make_env):
    env = make_env(
        "lidar=none",
        "rewards=walk",
        "observations=walk",
        "scenario=maze",
        "terminations.episode_length_s=0.06",
        "num_envs=2",
    )
    seen = []
    env.step_hooks.append(lambda: seen.append(env.obstacles.world[:, 0].clone()))
    episodes = run_episodes(env, stand, 6)
    every = torch.stack(seen)[::3]  # trials of three steps each, two at a time
    assert episodes.world.tolist() == every.flatten().tolist() and len(set(episodes.world.tolist())) > 2
    assert Episodes.from_columns(episodes.columns()).world.tolist() == episodes.world.tolist()
