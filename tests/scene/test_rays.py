"""What rays hit is what bodies touch: the ray scene against mj_ray on the very model that is simulated."""

import mujoco
import numpy as np
import pytest
import torch

from omniperception.lidar import RayScene
from omniperception.scene import build_world
from omniperception.scene.rays import HitClass, ray_shapes

NUM_RAYS = 400


@pytest.fixture(scope="module")
def world(make_config):
    run = make_config("obstacles=mixed")
    return build_world(run.env.robot, run.env.terrain, run.env.obstacles)


def random_state(world, seed):
    """A compiled model's data in a random state: base, joints, obstacle poses."""
    rng = np.random.default_rng(seed)
    data = mujoco.MjData(world.model)
    data.qpos[:3] = rng.uniform([-1, -1, 0.3], [1, 1, 0.8])
    data.qpos[3:7] = rng.normal(size=4)
    low, high = world.model.jnt_range[1:].T
    data.qpos[7:] = rng.uniform(low, high)
    data.mocap_pos[:] = rng.uniform([-3, -3, 0.2], [3, 3, 1.0], (world.model.nmocap, 3))
    data.mocap_quat[:] = rng.normal(size=(world.model.nmocap, 4))
    data.mocap_quat[:] /= np.linalg.norm(data.mocap_quat, axis=1, keepdims=True)
    mujoco.mj_forward(world.model, data)
    return data, rng


def reference(model, data, origin, direction):
    geom = np.array([-1], dtype=np.int32)
    distance = mujoco.mj_ray(model, data, origin, direction, None, 1, -1, geom)
    return (distance if geom[0] >= 0 else np.inf), int(geom[0])


@pytest.mark.parametrize("seed", range(5))
def test_ranges_and_geoms_are_those_of_mj_ray(world, seed):
    data, rng = random_state(world, seed)
    shapes = ray_shapes(world)
    scene = RayScene(shapes.shapes, 1, len(shapes.bodies), num_threads=1)
    scene.body_pos[0] = torch.tensor(data.xpos[list(shapes.bodies)], dtype=torch.float32)
    scene.body_quat[0] = torch.tensor(data.xquat[list(shapes.bodies)], dtype=torch.float32)
    origins = rng.uniform([-3, -3, 0.05], [3, 3, 1.5], (NUM_RAYS, 3)).astype(np.float32)
    aims = data.geom_xpos[rng.integers(1, world.model.ngeom, NUM_RAYS)]  # half at a geom, half anywhere
    directions = np.where(rng.random((NUM_RAYS, 1)) < 0.5, aims - origins, rng.normal(size=(NUM_RAYS, 3)))
    directions = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)
    hits = scene.cast(torch.tensor(origins)[None], torch.tensor(directions)[None])
    expected = [
        reference(world.model, data, o.astype(np.float64), d.astype(np.float64))
        for o, d in zip(origins, directions, strict=True)
    ]
    ranges, geoms = (np.array(x) for x in zip(*expected, strict=True))
    geom_id = hits.shape_id[0].numpy()  # one shape per geom, in the model's order
    grazing = geom_id != geoms
    assert grazing.mean() < 0.01
    np.testing.assert_allclose(hits.ranges[0].numpy()[~grazing], ranges[~grazing], atol=1e-4)
    assert len(set(geoms[~grazing])) > 10


def test_shapes_are_the_models_geoms_with_their_classes(world):
    shapes = ray_shapes(world)
    assert shapes.geom_names == tuple(world.model.geom(i).name for i in range(world.model.ngeom))
    classes = {n: HitClass(s.class_id) for n, s in zip(shapes.geom_names, shapes.shapes, strict=True)}
    assert classes["ground"] == HitClass.TERRAIN and classes["trunk"] == HitClass.ROBOT
    assert all((c == HitClass.OBSTACLE) == n.startswith("obstacle_") for n, c in classes.items())


def test_fixed_obstacles_carry_no_pose(make_config):
    run = make_config("obstacles=corridor", "commands=corridor")
    shapes = ray_shapes(build_world(run.env.robot, run.env.terrain, run.env.obstacles))
    wall = shapes.shapes[shapes.geom_names.index("obstacle_wall_0")]
    assert wall.body == -1 and wall.pos == (5.5, 2.05, 0.5) and wall.class_id == HitClass.OBSTACLE
    assert len(shapes.bodies) == 13 + 6  # base, four legs of three links, six walkers


def test_unknown_excluded_geoms_are_named(world):
    with pytest.raises(ValueError, match=r"exclude_geoms names nose; known: .*trunk"):
        ray_shapes(world, ("nose",))
