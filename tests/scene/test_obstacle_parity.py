"""Obstacles of every kind are seen alike by physics and rays: mj_ray through each environment's own physics model."""

import mujoco
import numpy as np
import pytest
import torch

from benchmarks.harness.reference import mujoco_ranges
from omniperception.lidar import ShapeKind
from omniperception.scene.rays import ray_shapes

NUM_ENVS, NUM_RAYS = 3, 1500
POST = "+obstacles.groups.post={kind: capsule, count: 3, size: [[0.05, 0.3], [0.1, 0.8]], speed: [0.0, 1.0]}"
KINDS = {ShapeKind.BOX, ShapeKind.CYLINDER, ShapeKind.SPHERE, ShapeKind.CAPSULE}


@pytest.fixture(scope="module")
def env(make_env):
    return make_env("experiment=avoid", "obstacles=mixed", POST, "lidar.num_rays=200", num_envs=NUM_ENVS)


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


def test_a_resumed_environment_sees_and_touches_the_saved_sizes(make_env, env):
    other = make_env("experiment=avoid", "obstacles=mixed", POST, "lidar.num_rays=200", "seed=9", num_envs=NUM_ENVS)
    other.load_state_dict(env.state_dict())
    assert torch.equal(other.obstacles.size, env.obstacles.size)
    assert_seen_alike(other, np.random.default_rng(1))
