"""What rays hit is what bodies touch: the ray scene against mj_ray on the very model that is simulated."""

import importlib.resources
from pathlib import Path

import mujoco
import numpy as np
import pytest
from mj_rays import assert_rays_are_those_of_mj_ray

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


@pytest.mark.parametrize("seed", range(5))
def test_ranges_and_geoms_are_those_of_mj_ray(world, seed):
    data, rng = random_state(world, seed)
    origins = rng.uniform([-3, -3, 0.05], [3, 3, 1.5], (NUM_RAYS, 3)).astype(np.float32)
    aims = data.geom_xpos[rng.integers(1, world.model.ngeom, NUM_RAYS)]  # half at a geom, half anywhere
    directions = np.where(rng.random((NUM_RAYS, 1)) < 0.5, aims - origins, rng.normal(size=(NUM_RAYS, 3)))
    assert len(set(assert_rays_are_those_of_mj_ray(world, data, origins, directions))) > 10


def test_shapes_are_the_models_geoms_with_their_classes(world):
    shapes = ray_shapes(world)
    assert shapes.geom_names == tuple(world.model.geom(i).name for i in range(world.model.ngeom))
    classes = {n: HitClass(s.class_id) for n, s in zip(shapes.geom_names, shapes.shapes, strict=True)}
    assert classes["ground"] == HitClass.TERRAIN and classes["trunk"] == HitClass.ROBOT
    assert all((c == HitClass.OBSTACLE) == n.startswith("obstacle_") for n, c in classes.items())


def test_unknown_excluded_geoms_are_named(world):
    with pytest.raises(ValueError, match=r"exclude_geoms names nose; known: .*trunk"):
        ray_shapes(world, ("nose",))


def test_excluded_geoms_may_be_of_a_form_that_is_not_built(make_config, tmp_path):
    """One mount serves the robot as it collides and as it is drawn."""
    file = tmp_path / "two_forms.xml"
    text = Path(str(importlib.resources.files("omniperception.scene") / "assets" / "go2.xml")).read_text()
    drawn = '<geom name="head_drawn" type="sphere" size="0.05" group="2" contype="0" conaffinity="0" mass="0"/>'
    marker = '<geom name="head_upper"'
    assert text.count(marker) == 1
    file.write_text(text.replace(marker, drawn + marker))
    for groups, left, seen in (("null", "head_upper", "trunk"), ("[2]", "head_drawn", None)):
        run = make_config(f"robot.file={file}", f"+robot.ray_groups={groups}", "obstacles=none")
        world = build_world(run.env.robot, run.env.terrain, run.env.obstacles)
        all_names = ray_shapes(world).geom_names
        names = ray_shapes(world, ("head_upper", "head_drawn")).geom_names
        assert left in all_names and set(all_names) - set(names) == {left}
        assert seen is None or seen in names
