"""The clock that times the feet: it starts with the episode, stands with the robot, and is mirrored as a trot is."""

import math

import torch

from omniperception.env.mirror import Mirror

GAIT = ("observations=gait", "rewards=gait", "obstacles=none")


def test_it_starts_with_each_episode_and_is_0_while_the_robot_should_stand(make_env):
    env = make_env(*GAIT, "terminations.episode_length_s=0.2", "commands.standing=0.5", blind=True, num_envs=16)
    moved = stood = 0
    for step in range(25):
        clock, command = env.get_observations()["clock"], env.command.value
        time = 0.02 * (step % 10)  # episodes of ten steps
        for k in range(16):
            moves = bool(command[k].any())
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


def _with(env, clock):
    observations = env.get_observations().clone()
    observations["clock"] = clock
    return observations
