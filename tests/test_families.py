"""Families of worlds to train in: every one composes, builds and steps; none is a world of the held-out suite."""

import pytest
import torch
import yaml

from omniperception import build, config
from omniperception.env.env import OmniEnv
from omniperception.env.mixed import MixedEnv

BLIND = ("experiment=walk", "sim=mujoco", "sim.num_threads=1")
FAMILIES = sorted(path.stem for path in config.CONFIG_DIR.glob("family/**/*.yaml") if path.stem != "all")
HELD_OUT = yaml.safe_load((config.CONFIG_DIR / "suite" / "held_out.yaml").read_text())["worlds"]


def family_of(name):
    return build.assemble(config.compose([*BLIND, f"family={name}", "num_envs=6"]))


@pytest.fixture(scope="module")
def held_out_worlds():
    return {name: build.assemble(config.compose([*BLIND, f"scenario={name}"])).env for name in HELD_OUT}


def test_no_family_is_missed():
    assert len(FAMILIES) == 13 and len(HELD_OUT) == 19
    everything = build.assemble(config.compose([*BLIND, "family=all", "num_envs=187"]))
    assert sorted(everything.families) == FAMILIES
    counts = {name: task.num_envs for name, task in everything.family_envs().items()}
    assert counts == {name: 10 * family.share for name, family in everything.families.items()}


@pytest.mark.parametrize("name", FAMILIES)
def test_every_family_composes_builds_and_steps(name):
    run = family_of(name)
    (task,) = run.family_envs().values()
    env = OmniEnv(task)
    for _ in range(3):
        _, rewards, _, _ = env.step(torch.zeros(6, env.num_actions))
    assert torch.isfinite(rewards).all() and not env.contacts.any()
    assert task.obstacles.curriculum is None and task.obstacles.split == "dev"
    assert task.obstacles.num_obstacles >= 6  # as many as critics observe
    if name == "driven":  # velocities, as far as the gait goes, and none
        assert task.commands.lin_vel_x == (-1.0, 2.0) and task.commands.standing == 0.2
    else:
        assert task.commands.speeds == (0.7, 1.3)


@pytest.mark.parametrize("name", FAMILIES)
def test_no_family_is_a_world_of_the_held_out_suite(name, held_out_worlds):
    (family,) = family_of(name).families.values()
    for scenario, env in held_out_worlds.items():
        assert family.commands != env.commands
        own, theirs = (set(map(repr, obstacles.groups.values())) for obstacles in (family.obstacles, env.obstacles))
        assert not own & theirs, scenario  # not even a group is the same
    kinds = {group.kind for group in family.obstacles.groups.values()}
    assert kinds <= {"box", "cylinder", "sphere"}  # the test split has others


def test_all_of_them_go_beside_each_other(make_config):
    nearest = "observations.groups.privileged.terms.nearest_obstacles={count: 6, max_distance: 4.0}"
    run = make_config(*BLIND, "family=all", "num_envs=13", nearest)
    env = MixedEnv(run.family_envs())
    for _ in range(2):
        _, rewards, _, _ = env.step(torch.zeros(13, env.num_actions))
    assert env.observations["privileged"].shape == (13, 34 + 36) and torch.isfinite(rewards).all()


def walls_and_people(env):
    """Of each environment: half the width (m) of its corridor, y (m) of its people and who is there."""
    field = env.obstacles
    names = [part.name for part in field.parts]
    left, people = names.index("obstacle_wall_0"), [k for k, name in enumerate(names) if "wall" not in name]
    inner = field.pos_w[:, left, 1] - field.size[:, left, 1]
    return inner, field.pos_w[:, people], field.active[:, people], field.radius[:, people]


def test_people_stay_in_the_corridor_of_their_world(make_config):
    """Each bounces between its own walls, through resets and a resume."""
    run = make_config(*BLIND, "family=corridor", "num_envs=30", "families.corridor.episode_length_s=1.5")
    task = run.family_envs()["corridor"]
    env, resumed = OmniEnv(task), OmniEnv(task)
    widest, bounced = 0.0, 0
    for step in range(200):
        before = env.obstacles.root_velocity_w[..., 1].clone()
        env.step(torch.zeros(30, env.num_actions))
        half, people, there, _ = walls_and_people(env)
        beyond = people[..., 1].abs() - (half[:, None] - 0.3)
        assert beyond[there].max() < 1e-6
        assert (people[..., 0][there] >= 1.5 - 1e-6).all()
        turned = (before * env.obstacles.root_velocity_w[..., 1] < 0) & ~env.done[:, None]
        bounced += int(turned.sum())
        widest = max(widest, float(half.max()))
        if step == 99:
            resumed.load_state_dict(env.state_dict())
        elif step > 99:
            resumed.step(torch.zeros(30, env.num_actions))
            assert torch.equal(resumed.obstacles.pos_w, env.obstacles.pos_w)
    assert bounced > 30 and widest > 3.2
    assert len(env.obstacles.world.unique()) > 15


def test_people_of_all_speeds():
    everything = build.assemble(config.compose([*BLIND, "family=all", "num_envs=13"]))
    groups = [group for family in everything.families.values() for group in family.obstacles.groups.values()]
    people = [group.speed for group in groups if group.moves]
    assert min(low for low, _ in people) <= 0.3 and max(high for _, high in people) == 2.5
