"""The clock that times the feet: it starts with the episode, rests with the robot, and is mirrored as a trot is."""

import math

import torch

from omniperception.env.mdp.curriculum import Curriculum, CurriculumConfig
from omniperception.env.mirror import Mirror

GAIT = ("observations=gait", "rewards=gait", "obstacles=none")


def test_it_starts_with_each_episode_and_is_0_once_the_robot_should_rest(make_env):
    """It rests where the command has been to stand for 0.06 s, three steps."""
    rest = ("commands.standing=0.5", "observations.groups.clock.terms.gait_phase.rest_s=0.06")
    env = make_env(*GAIT, *rest, "terminations.episode_length_s=0.2", blind=True, num_envs=16)
    moved = stood = 0
    for step in range(25):
        clock, command = env.get_observations()["clock"], env.command.value
        time = 0.02 * (step % 10)  # episodes of ten steps
        for k in range(16):
            moves = bool(command[k].any()) or step % 10 < 3
            expected = (math.sin(5 * math.pi * time), math.cos(5 * math.pi * time)) if moves else (0.0, 0.0)
            torch.testing.assert_close(clock[k], torch.tensor(expected), atol=1e-5, rtol=0)
            moved, stood = moved + moves, stood + (not moves)
        env.step(torch.zeros(16, 12))
    assert moved > 50 and stood > 50


def test_its_mirror_image_is_that_of_the_feet_of_a_trot(make_env):
    """Feet that follow the clock, seen in the mirror, follow the clock that is seen in the mirror."""
    env = make_env(*GAIT, blind=True, num_envs=2)
    env.command.value[:] = torch.tensor([0.5, 0.0, 0.0])
    env.episode_length_buf[:] = torch.tensor([7, 7 + 10])  # half a period of 2.5 Hz is ten steps of 0.02 s
    clock = env._groups["clock"].compute(env.state, torch.tensor([], dtype=torch.int64))
    image, _ = Mirror(env)(env, _with(env, clock), None)
    torch.testing.assert_close(image["clock"][2], clock[1], atol=1e-5, rtol=0)
    offsets = env.config.rewards.terms["foot_timing"].func.keywords["offsets"]
    left_right = [1, 0, 3, 2]
    assert [offsets[k] for k in left_right] == [(offset + 0.5) % 1.0 for offset in offsets]


def test_policies_see_and_rewards_ask_for_no_more_acceleration_than_was_said(make_env):
    """From rest towards (1.2, -0.5) m/s, 1.3 m/s in all, by 0.1 m/s in each step, and 1 rad/s by 0.4; then back."""
    acceleration = "observations.command_acceleration=[5.0,20.0]"
    env = make_env(*GAIT, acceleration, "terminations.episode_length_s=0.12", blind=True, num_envs=2)
    env.command.value[:] = torch.tensor([1.2, -0.5, 1.0])
    ahead = torch.tensor([12 / 13, -5 / 13])
    for step in range(1, 6):
        env.step(torch.zeros(2, 12))
        expected = torch.cat((0.1 * step * ahead, torch.tensor([min(0.4 * step, 1.0)])))
        torch.testing.assert_close(env.state.reference[0], expected, atol=1e-5, rtol=0)
        torch.testing.assert_close(env.get_observations()["command"][0], expected, atol=1e-5, rtol=0)
    kept = env.state.state_dict()
    env.command.value[0] = 0.0
    env.step(torch.zeros(2, 12))  # the sixth ends the episode
    assert not env.state.reference.any() and not env.state.stand_s.any()
    env.state.load_state_dict(kept)
    torch.testing.assert_close(env.state.reference[0], expected, atol=1e-5, rtol=0)
    env.state._difficulty = Curriculum(CurriculumConfig(start=0.5, max_velocity_error=1.0, rise=1.0))
    env.command.value[:] = 0.0
    env.step(torch.zeros(2, 12))  # with half of the randomization it goes back twice as fast
    torch.testing.assert_close(env.state.reference[0, :2], 0.3 * ahead, atol=1e-5, rtol=0)
    plain = make_env(*GAIT, "observations.command_acceleration=null", blind=True, num_envs=2)
    assert plain.state.reference is plain.command.value


def test_a_robot_without_actions_trots_on_and_rests(make_env):
    """Zero actions lift its feet at the rhythm of its gait; once the command has been to stand, it stays down."""
    env = make_env(*GAIT, "+stepping={lift: 1.6, rest_s: 0.5}", blind=True, num_envs=2)
    up, targets = [], []
    for step in range(150):
        env.command.value[:] = torch.tensor([0.3, 0.0, 0.0]) if step < 100 else 0.0
        env.step(torch.zeros(2, 12))
        up.append(env.state.foot_height[0] > 0.035)
        targets.append(env.state.targets[0][0])
    first, second = torch.stack(up[25:100])[:, 0], torch.stack(up[25:100])[:, 1]
    assert 10 < int(first.sum()) < 40 and 10 < int(second.sum()) < 40 and not (first & second).any()
    lifts = (first[1:] & ~first[:-1]).sum()
    assert 3 <= int(lifts) <= 4  # 2.5 Hz for 1.5 s
    assert not torch.stack(up[140:]).any() and torch.equal(targets[-1], env.state.default_joint_pos)
    assert not env.done.any()


def _with(env, clock):
    observations = env.get_observations().clone()
    observations["clock"] = clock
    return observations
