"""Environments, bodies and odd counts in a ray scene."""

import math

import pytest
import torch

from omniperception.lidar import RayScene, Shape, ShapeKind


def rays(num_envs, num_rays=1, direction=(1.0, 0.0, 0.0)):
    return torch.zeros(num_envs, num_rays, 3), torch.tensor(direction).repeat(num_envs, num_rays, 1)


def test_environments_do_not_see_each_other():
    scene = RayScene([Shape(ShapeKind.SPHERE, (0.5,), body=0)], num_envs=3, num_bodies=1, num_threads=2)
    scene.body_pos[:, 0] = torch.tensor([[2.0, 0.0, 0.0], [0.0, 0.0, -1000.0], [0.0, 5.0, 0.0]])
    assert scene.cast(*rays(3)).ranges.flatten().tolist() == [1.5, math.inf, math.inf]
    assert scene.cast(*rays(3, direction=(0.0, 1.0, 0.0))).ranges.flatten().tolist() == [
        math.inf,
        math.inf,
        4.5,
    ]


def test_a_body_carries_and_turns_its_shape():
    shape = Shape(ShapeKind.BOX, (0.5, 1.0, 2.0), body=1, pos=(0.0, 3.0, 0.0))
    scene = RayScene([shape], num_envs=1, num_bodies=2)
    half = math.pi / 4.0  # a quarter turn about z: the body's +y is the environment's -x
    scene.body_quat[0, 1] = torch.tensor([math.cos(half), 0.0, 0.0, math.sin(half)])
    scene.body_pos[0, 1] = torch.tensor([10.0, 0.0, 0.0])
    assert float(scene.cast(*rays(1)).ranges) == pytest.approx(10.0 - 3.0 - 1.0, abs=1e-5)


def test_a_miss_after_a_hit_is_infinite():
    scene = RayScene([Shape(ShapeKind.SPHERE, (0.5,), body=0)], num_envs=1, num_bodies=1)
    scene.body_pos[0, 0, 0] = 2.0
    assert float(scene.cast(*rays(1)).ranges) == 1.5
    scene.body_pos[0, 0, 2] = -1000.0
    hits = scene.cast(*rays(1), normals=True)
    assert float(hits.ranges) == math.inf and int(hits.shape_id) == -1 and not hits.normals_w.any()


@pytest.mark.parametrize("num_envs", [1, 3, 7])
@pytest.mark.parametrize("num_rays", [0, 1, 3001])
@pytest.mark.parametrize("num_bodies", [0, 2])
@pytest.mark.parametrize("shapes", [[], [Shape(ShapeKind.SPHERE, (0.5,), pos=(2.0, 0.0, 0.0))]], ids=["empty", "one"])
def test_odd_counts(num_envs, num_rays, num_bodies, shapes):
    scene = RayScene(shapes, num_envs, num_bodies, num_threads=2)
    assert scene.body_pos.shape == (num_envs, num_bodies, 3) and scene.body_quat.shape == (
        num_envs,
        num_bodies,
        4,
    )
    ranges = scene.cast(*rays(num_envs, num_rays)).ranges
    assert ranges.shape == (num_envs, num_rays)
    assert (ranges == (1.5 if shapes else math.inf)).all()


def test_a_plane_is_closest_last():
    shapes = [Shape(ShapeKind.PLANE, class_id=3), Shape(ShapeKind.SPHERE, (0.5,), pos=(0.0, 0.0, 1.0))]
    scene = RayScene(shapes, 1, 0)
    origins = torch.tensor([[[0.0, 0.0, 4.0], [2.0, 0.0, 4.0]]])
    hits = scene.cast(origins, torch.tensor([0.0, 0.0, -1.0]).expand(1, 2, 3), normals=True)
    assert hits.ranges.tolist() == [[2.5, 4.0]] and hits.shape_id.tolist() == [[1, 0]]
    assert torch.allclose(hits.normals_w, torch.tensor([0.0, 0.0, 1.0]).expand(1, 2, 3))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([], 0, 0), "num_envs=0"),
        (([], 1, -1), "num_bodies=-1"),
        (([Shape(ShapeKind.SPHERE, (1.0,), body=1)], 1, 1), r"shapes\[0\].body=1 must be < num_bodies=1"),
        (([], 1, 0, "cpu", 0), "num_threads=0"),
    ],
)
def test_wrong_scenes_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        RayScene(*arguments)


def test_wrong_rays_are_refused():
    scene = RayScene([], 2, 0)
    with pytest.raises(ValueError, match="num_envs=2"):
        scene.cast(*rays(1))
    with pytest.raises(ValueError, match="exclude_shapes"):
        scene.cast(*rays(2), exclude_shapes=(0,))
    with pytest.raises(ValueError, match="max_range=-1"):
        scene.cast(*rays(2), max_range=-1)
