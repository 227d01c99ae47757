"""Obstacles of another size in every environment: contacts are those of a model compiled with these sizes."""

import copy
from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch
from robots import default_joints, stand

from omniperception.scene import build_world
from omniperception.scene.obstacles import ObstacleGroup
from omniperception.sim import SimConfig
from omniperception.sim.mujoco_warp import MujocoWarpConfig

READ = {"box": 3, "cylinder": 2, "sphere": 1}
NUM_ENVS, POSES = 4, 40


@pytest.fixture(scope="module", params=[SimConfig(), MujocoWarpConfig(device="cpu")], ids=["mujoco", "mujoco_warp"])
def engine(request):
    return request.param


def world_of(run, sizes):
    """The robot and one obstacle of each kind, compiled with sizes {kind: (m, ...)}."""
    groups = {kind: ObstacleGroup(kind, 1, tuple((s, s) for s in size[: READ[kind]])) for kind, size in sizes.items()}
    obstacles = replace(run.env.obstacles, groups=groups)
    return build_world(run.env.robot, run.env.terrain, obstacles, ("obstacle_contact",))


def touched_when_compiled(run, sizes, qpos, mocap_pos, mocap_quat):
    """(P, 3) bool: which obstacle touches the robot at each of P poses, from MjData of a model with these sizes."""
    world = world_of(run, dict(zip(READ, sizes.tolist(), strict=True)))
    model, data, found = world.model, mujoco.MjData(world.model), []
    ids = [model.geom(name).id for name in world.obstacles.geom_names()]
    for pos, quat in zip(mocap_pos, mocap_quat, strict=True):
        data.qpos[:], data.mocap_pos[:], data.mocap_quat[:] = qpos, pos, quat
        mujoco.mj_forward(model, data)
        found.append([any(k in contact.geom for contact in data.contact) for k in ids])
    return np.array(found)


def test_contacts_are_those_of_a_model_compiled_with_each_environments_sizes(run, engine):
    """Every engine starts with obstacles of 2 cm, whose bounds would keep larger ones from touching anything."""
    rng = np.random.default_rng(0)
    sizes = rng.uniform(0.02, 0.25, (NUM_ENVS, 3, 3))
    world = world_of(run, {kind: (0.02, 0.02, 0.02) for kind in READ})
    sim = engine.build(world, NUM_ENVS)
    stand(sim)
    geoms = tuple(world.model.geom(name).id for name in world.obstacles.geom_names())
    sim.resize(geoms, torch.arange(NUM_ENVS), torch.from_numpy(sizes))
    rest = sim.qpos.clone()
    rest[:, 2] = 0.5
    pos = rng.uniform([-0.6, -0.5, 0.2], [0.6, 0.5, 0.8], (POSES, NUM_ENVS, 3, 3))
    quat = rng.normal(size=(POSES, NUM_ENVS, 3, 4))
    quat /= np.linalg.norm(quat, axis=-1, keepdims=True)
    felt = []
    for k in range(POSES):
        sim.reset(torch.arange(NUM_ENVS), rest, torch.zeros(NUM_ENVS, 18))
        sim.mocap_pos[:], sim.mocap_quat[:] = (torch.from_numpy(x[k]).to(sim.mocap_pos) for x in (pos, quat))
        sim.step(default_joints(sim).expand(NUM_ENVS, -1))
        felt.append(sim.contact_sensor("obstacle_contact").numpy() > 0)
    felt = np.array(felt)
    expected = [touched_when_compiled(run, sizes[e], rest[e].numpy(), pos[:, e], quat[:, e]) for e in range(NUM_ENVS)]
    expected = np.stack(expected, 1)
    assert 0.15 < expected.mean() < 0.85
    assert (felt == expected).mean() > 0.999, (felt != expected).sum()


def test_one_environments_size_changes_no_other(run, engine):
    """The obstacle is pressed into the trunk of all robots; only where it has shrunk it does not touch."""
    world = world_of(run, {"box": (0.1, 0.1, 0.1), "cylinder": (0.1, 0.1), "sphere": (0.1,)})
    kept, resized = engine.build(world, NUM_ENVS), engine.build(world, NUM_ENVS)
    box = (world.model.geom("obstacle_box_0").id,)
    for sim in (kept, resized):
        stand(sim)
        sim.resize(box, torch.arange(NUM_ENVS), torch.full((NUM_ENVS, 1, 3), 0.1))
        sim.mocap_pos[:, 0] = torch.tensor([0.0, 0.0, 0.47])
    resized.resize(box, torch.tensor([2]), torch.full((1, 1, 3), 0.01))
    for sim in (kept, resized):
        sim.step(default_joints(sim).expand(NUM_ENVS, -1), 20)
    others = [0, 1, 3]
    assert torch.equal(kept.qpos[others], resized.qpos[others]) and not torch.equal(kept.qpos[2], resized.qpos[2])
    assert kept.touched("obstacle_contact").all() and resized.touched("obstacle_contact").tolist()[2] is False


def test_a_saved_state_has_the_sizes(run, engine):
    world = world_of(run, {"box": (0.02, 0.02, 0.02), "cylinder": (0.1, 0.1), "sphere": (0.1,)})
    first, second = engine.build(world, NUM_ENVS), engine.build(world, NUM_ENVS)
    stand(first)
    first.resize((world.model.geom("obstacle_box_0").id,), torch.tensor([1]), torch.full((1, 1, 3), 0.1))
    first.mocap_pos[:, 0] = torch.tensor([0.0, 0.0, 0.47])
    second.load_state_dict(copy.deepcopy(first.state_dict()))
    for sim in (first, second):
        sim.step(default_joints(sim).expand(NUM_ENVS, -1), 10)
        assert sim.touched("obstacle_contact").tolist() == [False, True, False, False]
    assert torch.equal(first.qpos, second.qpos)


@pytest.mark.parametrize(("name", "message"), [("ground", "geom ground is a plane"), ("trunk", "geom trunk shares")])
def test_geoms_without_a_size_of_their_own_are_refused(run, engine, name, message):
    world = world_of(run, {"box": (0.02, 0.02, 0.02)})
    sim = engine.build(world, 1)
    with pytest.raises(ValueError, match=message):
        sim.resize((world.model.geom(name).id,), torch.tensor([0]), torch.ones(1, 1, 3))
