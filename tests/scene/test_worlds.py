"""The scenarios as scenes: they build in both splits and on uneven ground, fit their suite, and can be passed."""

import pytest
import torch
import yaml
from fields import make_field

from omniperception import build, config
from omniperception.env.env import OmniEnv
from omniperception.evaluation.suite import suite_worlds

BLIND = ("perception=none", "lidar=none", "rewards=walk", "observations=walk")
WORLDS = sorted({world.name for world in suite_worlds("held_out")})


def assembled(*overrides, num_envs=3):
    return build.assemble(config.compose([*BLIND, *overrides, f"num_envs={num_envs}"])).env


def field_of(task, num_envs):
    """The obstacles of many trials, without physics."""
    field = make_field(task.obstacles, num_envs, task.seed)
    goal = torch.tensor([task.commands.goal_x[0], 0.0]).expand(num_envs, 2)
    start = torch.zeros(num_envs, 2)
    field.reset(torch.arange(num_envs), start, goal)
    return field


@pytest.mark.parametrize("world", WORLDS)
def test_a_world_of_the_test_split_builds_resets_and_steps(world):
    env = OmniEnv(assembled(f"scenario={world}", "obstacles.split=test", "terminations.episode_length_s=0.06"))
    for _ in range(5):  # the fourth step is the first of another trial
        env.step(torch.zeros(3, 12))
        assert torch.isfinite(env.obstacles.pos_w).all() and env.obstacles.active.any(1).all()
        assert not env.contacts.any()


@pytest.mark.parametrize("world", ["corridor", "maze", "people", "furniture", "aerial_hard"])
def test_a_world_stands_on_uneven_ground(world):
    env = OmniEnv(assembled(f"scenario={world}", "terrain=mixed_easy"))
    for _ in range(3):
        env.step(torch.zeros(3, 12))
    field = env.obstacles
    lowest = torch.where(field.active, field.bottom_above_ground(), 0.0)
    assert lowest.abs().max() < 2.5


def test_levels_of_easy_terrain_are_drawn_evenly():
    env = OmniEnv(assembled("scenario=static", "terrain=mixed_easy", num_envs=400))
    counts = torch.bincount(env.ground.level, minlength=5)
    assert len(counts) == 5 and counts.min() > 50


def test_the_suite_has_every_world_on_both_grounds():
    suite = yaml.safe_load((config.CONFIG_DIR / "suite" / "held_out.yaml").read_text())
    assert suite["worlds"] == {world: ["flat", "mixed_easy"] for world in suite["worlds"]}
    assert sorted(suite["worlds"]) == sorted(WORLDS)


@pytest.mark.parametrize("world", WORLDS)
def test_obstacles_find_their_places_and_worlds_stay_small(world):
    task = assembled(f"scenario={world}", num_envs=1)
    field = field_of(task, 100)
    assert field.pos_w.shape[1] <= 70
    optional = {name for name, group in task.obstacles.groups.items() if group.layout is not None or group.present}
    there = torch.tensor(
        [part.name.removeprefix("obstacle_").rpartition("_")[0] not in optional for part in field.parts]
    )
    assert not there.any() or field.active[:, there].double().mean() > 0.95
