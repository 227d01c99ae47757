"""Obstacles of every kind are seen alike by physics and rays: mj_ray through each environment's own physics model."""

import mujoco
import numpy as np
import pytest
import torch

from benchmarks.harness.reference import mujoco_ranges
from omnilidar import ShapeKind
from omniperception.evaluation.trials.clearance import Clearance
from omniperception.evaluation.trials.clearance_kernels import TOLERANCE
from omniperception.scene.rays import ray_shapes

NUM_ENVS, NUM_RAYS = 3, 1500
GROUPS = """+obstacles.groups={
  post: {kind: capsule, count: 2, size: [[0.05, 0.3], [0.1, 0.8]], speed: [0.0, 1.0]},
  rock: {kind: mesh, file: rock, count: 2, size: [[0.1, 0.5], [0.1, 0.4], [0.2, 0.6]]},
  wedge: {kind: mesh, file: wedge, count: 1, speed: [0.5, 0.5]},
  table: {kind: compound, count: 1, scale: [0.7, 1.3], parts: {
    top: {kind: box, size: [0.6, 0.4, 0.02], pos: [0.0, 0.0, 0.7]},
    leg: {kind: cylinder, size: [0.03, 0.34], pos: [0.5, 0.3, 0.34]},
    brace: {kind: capsule, size: [0.02, 0.5], pos: [0.0, 0.0, 0.4], rpy_deg: [20.0, 70.0, 10.0]}}},
  cairn: {kind: compound, count: 1, parts: {
    ball: {kind: sphere, size: [0.2], pos: [0.2, 0.0, 0.2]},
    stone: {kind: mesh, file: hexagon, size: [0.1, 0.1, 0.2], pos: [-0.4, 0.2, 0.2], rpy_deg: [0.0, 40.0, 0.0]}}},
  person: {kind: compound, count: 2, speed: [0.5, 1.5], scale: [0.9, 1.1], parts: {
    trunk: {kind: capsule, size: [0.18, 0.25], pos: [0.0, 0.0, 1.15]},
    left: {kind: capsule, size: [0.07, 0.35], pos: [0.0, 0.1, 0.85], hang: 0.42,
      swing: {axis: y, amplitude_deg: 25, per_metre: 0.7}},
    right: {kind: capsule, size: [0.07, 0.35], pos: [0.0, -0.1, 0.85], hang: 0.42,
      swing: {axis: y, amplitude_deg: 25, per_metre: 0.7, phase_deg: 180}}}}}""".replace("\n", "")
KINDS = {ShapeKind.BOX, ShapeKind.CYLINDER, ShapeKind.SPHERE, ShapeKind.CAPSULE, ShapeKind.MESH}


@pytest.fixture(scope="module")
def env(make_env):
    return make_env("experiment=avoid", "obstacles=mixed", GROUPS, "lidar.num_rays=200", num_envs=NUM_ENVS)


def rays_at_obstacles(env, rng):
    """(num_envs, R, 3) origins and directions, at the parts of obstacles that take part."""
    centre = env.sim.mocap_pos.float().numpy()
    middle = env.sim.qpos[:, None, :3].numpy()
    origins = middle + rng.uniform([-4, -4, -0.2], [4, 4, 1.5], (NUM_ENVS, NUM_RAYS, 3))
    aims = np.stack([c[rng.choice(np.flatnonzero(c[:, 2] > -50), NUM_RAYS)] for c in centre])
    directions = aims + rng.normal(scale=0.3, size=aims.shape) - origins
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    return origins.astype(np.float32), directions.astype(np.float32)


def assert_seen_alike(env, rng):
    """Casts rays through the LiDAR's scene and through the models that are simulated; returns the kinds that are hit.

    A few rays in a thousand may graze an edge and hit another.
    """
    scene, names = env.sensing.scene, ray_shapes(env.world, env.sensing.config.exclude_geoms).geom_names
    pos, quat = env.sim.body_poses(ray_shapes(env.world).bodies)
    scene.set_poses(pos, quat)
    origins, directions = rays_at_obstacles(env, rng)
    hits, seen = scene.cast(origins, directions), set()
    for index in range(NUM_ENVS):
        model, data = env.sim.batch.get_model(index), env.sim.batch.get_data(index)
        mujoco.mj_kinematics(model, data)
        for name in sorted({model.geom(k).name for k in range(model.ngeom)} - set(names)):
            model.geom(name).rgba[3] = 0.0  # the LiDAR's own housing, which its rays pass through
        ranges, geoms = mujoco_ranges(model, data, origins[index].astype(float), directions[index].astype(float))
        expected = [model.geom(k).name if k >= 0 else "" for k in geoms]
        got = [names[k] if k >= 0 else "" for k in hits.shape_id[index].tolist()]
        same = np.array(got) == expected
        assert same.mean() > 0.995, [pair for pair in zip(got, expected, strict=True) if pair[0] != pair[1]]
        np.testing.assert_allclose(hits.ranges[index].numpy()[same], ranges[same], rtol=1e-5, atol=1e-4)
        seen |= {scene.shapes[names.index(name)].kind for name in got if name.startswith("obstacle_")}
    return seen


def test_every_kind_is_seen_where_it_is_touched_in_each_environments_size(env):
    """Also after some have moved, and after one environment has been reset alone."""
    rng = np.random.default_rng(0)
    env.obstacles.level = 1.0
    env._reset(torch.arange(NUM_ENVS))
    assert (env.obstacles.size[0] != env.obstacles.size[1]).any()
    assert assert_seen_alike(env, rng) == KINDS
    before = env.obstacles.size.clone()
    for _ in range(20):
        env.step(torch.zeros(NUM_ENVS, 12))
    env._reset(torch.tensor([1]))
    others = [0, 2]
    assert torch.equal(env.obstacles.size[others], before[others]) and not torch.equal(env.obstacles.size[1], before[1])
    assert_seen_alike(env, rng)
    legs = [k for k, part in enumerate(env.obstacles.parts) if part.name.endswith(("left", "right"))]
    tilted = env.obstacles.quat_w[:, legs, 1:3].norm(dim=-1)
    assert len(legs) == 4 and (tilted > 0.01).all()


def test_clearances_are_those_that_mujoco_measures(env):
    """Robots among the parts, in any pose; penetration is 0."""
    clearance, generator = Clearance(env), torch.Generator().manual_seed(0)
    parts, expected, got = env.sim.mocap_pos, [], []
    for k in range(parts.shape[1]):
        uniform = torch.rand(NUM_ENVS, 7, generator=generator).double() - 0.5
        env.sim.qpos[:, :3] = parts[:, k] + 1.6 * uniform[:, :3]
        env.sim.qpos[:, 3:7] = torch.nn.functional.normalize(uniform[:, 3:], dim=1)
        got += clearance.measure(torch.full((NUM_ENVS,), 2.0)).tolist()
        for index in range(NUM_ENVS):
            model, data = env.sim.batch.get_model(index), env.sim.batch.get_data(index)
            mujoco.mj_kinematics(model, data)
            names = [model.geom(g).name for g in range(model.ngeom)]
            obstacles = [g for g, name in enumerate(names) if name.startswith("obstacle_")]
            robot = [g for g in range(model.ngeom) if model.body_rootid[model.geom_bodyid[g]] == env.world.base_body]
            pairs = [mujoco.mj_geomDistance(model, data, r, o, 2.0, None) for r in robot for o in obstacles]
            expected.append(max(min(pairs), 0.0))
    assert 0.1 < np.mean(np.array(expected) == 0.0) < 0.9
    np.testing.assert_allclose(got, expected, atol=TOLERANCE + 1e-5)


def test_a_resumed_environment_sees_and_touches_the_saved_sizes(make_env, env):
    other = make_env("experiment=avoid", "obstacles=mixed", GROUPS, "lidar.num_rays=200", "seed=9", num_envs=NUM_ENVS)
    other.load_state_dict(env.state_dict())
    assert torch.equal(other.obstacles.size, env.obstacles.size)
    assert_seen_alike(other, np.random.default_rng(1))
