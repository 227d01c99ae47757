"""Curriculum over terrain: episodes and their spread over the terrain."""

from types import SimpleNamespace

import pytest
import torch

from omniperception.common.random import EnvRandom
from omniperception.env.terrain_levels import TerrainLevels
from omniperception.scene import TerrainCurriculumConfig

DT, LIMIT = 0.02, 1000
"""Episodes of 20 s."""


class FakeGround:
    """Ten levels of tiles of 8 m with platforms of 2 m."""

    def __init__(self, level, curriculum):
        self.config = SimpleNamespace(levels=10, tile_size=8.0, platform=2.0, curriculum=curriculum)
        self.level = torch.tensor(level)

    def move(self, env_ids, level):
        self.level[env_ids] = level


def walk(levels, velocity, command, steps, start=(0.0, 0.0)):
    """Every environment walks `steps` control steps at `velocity` in its yaw frame, commanded `command`."""
    num_envs = len(levels.walked)
    velocity, command = torch.tensor(velocity), torch.tensor([*command, 0.0])
    for step in range(steps):
        xy = torch.tensor(start) + velocity * DT * (step + 1)
        state = SimpleNamespace(
            base_lin_vel_yaw=velocity.expand(num_envs, 2), base_pos_w=torch.tensor([*xy, 0.3]).expand(num_envs, 3)
        )
        levels.record(state, command.expand(num_envs, 3), torch.ones(num_envs, dtype=torch.bool))


def curriculum_of(num_envs=1, level=3, **settings):
    ground = FakeGround([level] * num_envs, TerrainCurriculumConfig(**settings))
    return ground, TerrainLevels(ground, EnvRandom(0, num_envs), DT, LIMIT)


@pytest.mark.parametrize(
    ("velocity", "command", "steps", "complete", "expected"),
    [
        ((0.25, 0.0), (1.0, 0.0), 1000, True, 4),  # 5 m from the start: farther than half a tile, however slow
        ((0.15, 0.0), (0.18, 0.0), 1000, True, 4),  # 3 m of 3.6 m: more than four fifths
        ((0.15, 0.0), (0.25, 0.0), 1000, True, 3),  # 3 m of 5 m: neither enough nor too little
        ((0.15, 0.0), (0.4, 0.0), 1000, True, 2),  # 3 m of 8 m: less than half
        ((0.5, 0.0), (0.5, 0.0), 200, False, 2),  # fell after 2 m; 10 m would have been commanded
        ((0.5, 0.0), (0.5, 0.0), 500, False, 4),  # fell after 5 m, beyond the tile
        ((0.5, 0.0), (0.5, 0.0), 200, True, 4),  # reached its goal after 2 m
        ((0.04, 0.0), (0.04, 0.0), 1000, True, 3),  # followed, but stayed on the platform
        ((0.0, 0.0), (0.0, 0.0), 1000, True, 3),  # stood still as commanded
        ((0.0, 0.15), (0.3, 0.0), 1000, True, 2),  # 3 m, but not the way that was commanded
    ],
)
def test_up_and_down_by_hand(velocity, command, steps, complete, expected):
    ground, levels = curriculum_of(up_share=0.8, down_share=0.5)
    walk(levels, velocity, command, steps)
    levels.start(torch.tensor([0]), torch.zeros(1, 2), torch.tensor([complete]))
    assert ground.level.tolist() == [expected]
    assert levels.walked.item() == levels.commanded.item() == levels.reach.item() == 0.0


def test_distance_counts_from_where_the_episode_started():
    ground, levels = curriculum_of()
    levels.start(torch.tensor([0]), torch.tensor([[50.0, -20.0]]))
    ground.level[:] = 3
    walk(levels, (0.04, 0.0), (0.04, 0.0), 1000, start=(50.0, -20.0))
    assert levels.reach.item() == pytest.approx(0.8, abs=1e-3)
    levels.start(torch.tensor([0]), torch.zeros(1, 2), torch.tensor([True]))
    assert ground.level.tolist() == [3]


def test_the_easiest_level_is_the_floor_and_beyond_the_hardest_any_may_follow():
    ground, levels = curriculum_of(400, level=0)
    everyone, nowhere = torch.arange(400), torch.zeros(400, 2)
    walk(levels, (0.0, 0.0), (1.0, 0.0), 10)
    levels.start(everyone, nowhere, torch.zeros(400, dtype=torch.bool))
    assert (ground.level == 0).all()
    ground.level[:] = 9
    walk(levels, (1.0, 0.0), (1.0, 0.0), 300)
    levels.start(everyone, nowhere, torch.zeros(400, dtype=torch.bool))
    counts = ground.level.bincount(minlength=10)
    assert len(counts) == 10 and counts.min() > 20 and counts.max() < 65  # 40 each


def test_only_the_environments_that_ended_move():
    ground, levels = curriculum_of(3)
    walk(levels, (1.0, 0.0), (1.0, 0.0), 300)
    levels.start(torch.tensor([1]), torch.zeros(1, 2), torch.tensor([False]))
    assert ground.level.tolist() == [3, 4, 3]
    assert levels.reach.tolist() == pytest.approx([6.0, 0.0, 6.0], abs=1e-4)


def test_environments_begin_up_to_the_start_level_and_without_a_curriculum_anywhere():
    ground, levels = curriculum_of(300, start_level=2)
    levels.start(torch.arange(300), torch.zeros(300, 2))
    assert ground.level.bincount().min() > 70 and ground.level.max() == 2
    ground.config.curriculum = None
    levels.start(torch.arange(300), torch.zeros(300, 2), torch.ones(300, dtype=torch.bool))
    assert ground.level.bincount(minlength=10).min() > 15


def test_levels_are_logged(make_env):
    env = make_env("terrain=stairs", "ppo.num_steps_per_env=3", num_envs=8, blind=True)
    env.ground.move(torch.arange(8), torch.tensor([1, 1, 2, 2, 4, 5, 7, 8]))
    for _ in range(3):
        extras = env.step(torch.zeros(8, 12))[3]
    assert extras["log"]["Metrics/terrain_level"] == 30 / 8
    assert extras["log"]["Terrain/level_stairs_up"] == 1.5  # columns 0 and 1
    assert extras["log"]["Terrain/level_stairs_down"] == 6.0


def test_levels_outlast_resets_of_all_with_seeds(make_env):
    """Time restarts; the curriculum keeps its levels, but for the one that a step of standing may take."""
    env = make_env("terrain=stairs", "terrain.curriculum.start_level=0", num_envs=8, blind=True)
    levels = torch.tensor([1, 2, 3, 4, 5, 6, 7, 8])
    env.ground.move(torch.arange(8), levels)
    env.step(torch.zeros(8, 12))
    for _ in range(2):
        env.reset(seeds=torch.arange(8))
        assert env.step_count == 0 and ((env.ground.level - levels).abs() <= 1).all()


@pytest.mark.parametrize("num_envs", [8, 3, 11])
def test_levels_outlast_a_change_of_the_task(make_env, num_envs):
    """Also of the number of robots; on ground of fewer levels the hardest is the most."""
    old = make_env("terrain=stairs", num_envs=8, blind=True)
    old.ground.move(torch.arange(8), torch.tensor([2, 2, 3, 4, 5, 6, 7, 9]))
    old.step(torch.zeros(8, 12))
    state = old.state_dict()
    new = make_env(
        "terrain=stairs", "terrain.levels=6", "terrain.curriculum.start_level=0", num_envs=num_envs, blind=True
    )
    new.begin_at_levels_of(state)
    expected = [2, 2, 3, 4, 5, 5, 5, 5, 2, 2, 3][:num_envs]
    assert new.ground.level.tolist() == expected and new.step_count == 0
    new.step(torch.zeros(num_envs, 12))
    flat = make_env("terrain=flat", num_envs=2, blind=True)
    flat.begin_at_levels_of(state)
    new.begin_at_levels_of(flat.state_dict())
