"""Environments, bodies and odd counts in a ray scene."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from benchmarks.lidar_accuracy import random_mesh
from omniperception.lidar import (
    HeightField,
    Lidar,
    LidarConfig,
    RayScene,
    ScanPattern,
    Shape,
    ShapeKind,
    TriangleMesh,
    mid360,
)
from omniperception.lidar.scene import PlacedShapes, View


def rays(num_envs, num_rays=1, direction=(1.0, 0.0, 0.0)):
    return torch.zeros(num_envs, num_rays, 3), torch.tensor(direction).repeat(num_envs, num_rays, 1)


def test_environments_do_not_see_each_other():
    scene = RayScene([Shape(ShapeKind.SPHERE, (0.5,), body=0)], num_envs=3, num_bodies=1, num_threads=2)
    scene.body_pos[:, 0] = torch.tensor([[2.0, 0.0, 0.0], [0.0, 0.0, -1000.0], [0.0, 5.0, 0.0]])
    assert scene.cast(*rays(3)).ranges.flatten().tolist() == [1.5, math.inf, math.inf]
    assert scene.cast(*rays(3, direction=(0.0, 1.0, 0.0))).ranges.flatten().tolist() == [math.inf, math.inf, 4.5]


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
    assert scene.body_pos.shape == (num_envs, num_bodies, 3) and scene.body_quat.shape == (num_envs, num_bodies, 4)
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


# --- visibility ------------------------------------------------------------------------------------------------

BALLS = [Shape(ShapeKind.SPHERE, (0.5,), pos=(x, 0.0, 0.0), body=b) for x, b in ((2.0, -1), (4.0, 0), (6.0, 1))]


def test_shapes_are_there_in_some_environments_only():
    scene = RayScene(BALLS, num_envs=3, num_bodies=2)
    assert scene.visible_if_used is None and scene.cast(*rays(3)).ranges.flatten().tolist() == [1.5] * 3
    assert scene.visible_if_used is None  # nothing is allocated until somebody asks
    assert scene.visible.shape == (3, 3) and scene.visible.all()
    scene.visible[1, 0] = False
    scene.visible[2, list(scene.shapes_of(-1) + scene.shapes_of(0))] = False
    assert scene.cast(*rays(3)).ranges.flatten().tolist() == [1.5, 3.5, 5.5]
    assert scene.cast(*rays(3), exclude_shapes=(1,)).ranges.flatten().tolist() == [1.5, 5.5, 5.5]
    scene.visible[:] = True
    assert scene.cast(*rays(3)).ranges.flatten().tolist() == [1.5] * 3


def test_a_sensor_that_was_there_before_sees_what_is_hidden_later():
    scene = RayScene(BALLS, num_envs=2, num_bodies=2)
    config = LidarConfig(num_rays=1, period_s=0.1, min_range=0.0, max_range=20.0)
    forward = ScanPattern(torch.tensor([[1.0, 0.0, 0.0]]), torch.zeros(1), torch.zeros(1), 10.0)
    lidar = Lidar(config, forward, scene, mount_body=-1)
    time_s = torch.zeros(2, dtype=torch.float64)
    assert lidar.cast(time_s).ranges.flatten().tolist() == [1.5, 1.5]
    scene.visible[1, 0] = False
    assert lidar.cast(time_s).ranges.flatten().tolist() == [1.5, 3.5]


# --- order and culling -----------------------------------------------------------------------------------------


def random_crowd(num_shapes, seed, num_envs=2):
    generator = torch.Generator().manual_seed(seed)
    kinds = (ShapeKind.BOX, ShapeKind.SPHERE, ShapeKind.CYLINDER, ShapeKind.CAPSULE, ShapeKind.ELLIPSOID)
    lengths = {ShapeKind.SPHERE: 1, ShapeKind.CYLINDER: 2, ShapeKind.CAPSULE: 2}
    shapes = []
    for k in range(num_shapes):
        kind = kinds[k % len(kinds)]
        size = 0.05 + 0.3 * torch.rand(lengths.get(kind, 3), generator=generator)
        shapes.append(Shape(kind, tuple(size.tolist()), body=k))
    scene = RayScene(shapes, num_envs, num_shapes)
    scene.body_pos.copy_(10.0 * torch.rand(num_envs, num_shapes, 3, generator=generator) - 5.0)
    quat = torch.randn(num_envs, num_shapes, 4, generator=generator)
    scene.body_quat.copy_(quat / quat.norm(dim=-1, keepdim=True))
    return scene


@pytest.mark.parametrize("num_shapes", [1, 2, 40, 1000])
def test_a_view_has_everything_in_reach_nearest_first(num_shapes):
    scene = random_crowd(num_shapes, seed=num_shapes)
    placed = PlacedShapes(scene, (), View(pos=(0.3, 0.2, 0.1), max_range=4.0))
    placed.refresh()
    origin = torch.tensor([0.3, 0.2, 0.1])
    for env in range(scene.num_envs):
        count = int(placed.slots.count.numpy()[env])
        near, shape = placed.slots.near.numpy()[env, :count], placed.slots.shape.numpy()[env, :count]
        assert (near[1:] >= near[:-1]).all() and len(set(shape)) == count
        away = (scene.body_pos[env] - origin).norm(dim=-1)
        radius = torch.tensor([s.bounding_radius for s in scene.shapes])
        assert set((away < 4.0).nonzero().flatten().tolist()) <= set(shape.tolist())
        assert (torch.from_numpy(near) <= away[shape] + 1e-6).all()
        assert (torch.from_numpy(near) >= (away - radius)[shape] - 1e-4).all()
        centre = torch.from_numpy(placed.slots.bound.numpy()[env, :count, :3])
        torch.testing.assert_close(centre.norm(dim=-1), away[shape], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("window", [(-0.3, -0.1), (-0.05, 0.9), (1.2, 1.5), (-1.57, -1.1), (-1.5708, 1.5708)])
def test_what_is_left_out_is_outside_the_elevations(window):
    """A direction within the window that hits a shape proves that the shape must be in the view."""
    scene = random_crowd(200, seed=7, num_envs=1)
    placed = PlacedShapes(scene, (), View(elevation=window))
    placed.refresh()
    viewed = set(placed.slots.shape.numpy()[0, : int(placed.slots.count.numpy()[0])].tolist())
    generator = torch.Generator().manual_seed(1)
    low, high = (math.sin(angle) for angle in window)
    z = low + (high - low) * torch.rand(50000, generator=generator)
    azimuth = 2.0 * math.pi * torch.rand(50000, generator=generator)
    level = (1.0 - z * z).clamp(min=0.0).sqrt()
    directions = torch.stack((level * azimuth.cos(), level * azimuth.sin(), z), -1)[None]
    hits = scene.cast(torch.zeros_like(directions), directions)
    seen = set(hits.shape_id[hits.shape_id >= 0].tolist())
    assert seen and seen <= viewed
    if window[1] - window[0] < 1.0:
        assert len(viewed) < 190  # something is left out


def test_general_rays_through_a_thousand_shapes():
    """Against ten scenes of a hundred each, in which other shapes stand together."""
    scene = random_crowd(1000, seed=3, num_envs=1)
    generator = torch.Generator().manual_seed(0)
    origins = 10.0 * torch.rand(1, 3000, 3, generator=generator) - 5.0
    directions = torch.randn(1, 3000, 3, generator=generator)
    hits = scene.cast(origins, directions)
    best = torch.full_like(hits.ranges, math.inf)
    for first in range(0, 1000, 100):
        part = RayScene([replace(s, body=k) for k, s in enumerate(scene.shapes[first : first + 100])], 1, 100)
        part.body_pos.copy_(scene.body_pos[:, first : first + 100])
        part.body_quat.copy_(scene.body_quat[:, first : first + 100])
        best = torch.minimum(best, part.cast(origins, directions).ranges)
    assert torch.equal(hits.ranges, best)


# --- poses -----------------------------------------------------------------------------------------------------


def test_poses_may_be_float64():
    scene = RayScene([Shape(ShapeKind.SPHERE, (0.5,), body=0)], 1, 1, pose_dtype=torch.float64)
    assert scene.body_pos.dtype == scene.body_quat.dtype == torch.float64
    scene.body_pos[0, 0] = torch.tensor([1e6 + 0.123456, 0.0, 0.0], dtype=torch.float64)
    origin = torch.tensor([[[1e6 - 3.0, 0.0, 0.0]]], dtype=torch.float64)
    hits = scene.cast(origin, torch.tensor([[[1.0, 0.0, 0.0]]]))
    assert float(hits.ranges) == pytest.approx(2.623456, abs=1e-6)


def test_another_pose_type_is_refused():
    with pytest.raises(ValueError, match=r"pose_dtype=torch.float16 must be torch.float32 or torch.float64"):
        RayScene([], 1, 0, pose_dtype=torch.float16)


@pytest.mark.parametrize("pose_dtype", [torch.float32, torch.float64])
def test_a_scan_is_what_general_rays_see(pose_dtype):
    """Every kind of shape in one scene, from a moving sensor, against rays of their own."""
    mesh = TriangleMesh(*random_mesh(np.random.default_rng(0)))
    field = HeightField(np.random.default_rng(1).uniform(0, 1, (9, 12)), 0.8, 0.7, 0.1)
    assets = {ShapeKind.MESH: mesh, ShapeKind.DEFORMABLE: mesh, ShapeKind.HEIGHTFIELD: field}
    sizes = {ShapeKind.PLANE: (2.0, 0.0), ShapeKind.SPHERE: (0.4,), ShapeKind.CYLINDER: (0.2, 0.5)}
    sizes |= {ShapeKind.CAPSULE: (0.2, 0.5), ShapeKind.BOX: (0.5, 0.1, 0.3), ShapeKind.ELLIPSOID: (0.5, 0.1, 0.3)}
    kinds = list(ShapeKind) * 4
    shapes = [Shape(kind, sizes.get(kind, ()), body=k, asset=assets.get(kind)) for k, kind in enumerate(kinds)]
    scene = RayScene(shapes, num_envs=2, num_bodies=len(shapes) + 1, pose_dtype=pose_dtype)
    generator = torch.Generator().manual_seed(0)
    scene.body_pos.copy_(5.0 * torch.rand(scene.body_pos.shape, generator=generator) - 2.5)
    quat = torch.randn(scene.body_quat.shape, generator=generator)
    scene.body_quat.copy_(quat / quat.norm(dim=-1, keepdim=True))
    for k, shape in enumerate(shapes):
        if shape.kind == ShapeKind.DEFORMABLE:
            scene.update_vertices(k, torch.from_numpy(mesh.vertices) * (0.5 + torch.rand(2, 1, 3, generator=generator)))
    config = LidarConfig(num_rays=3000, period_s=0.1, min_range=0.0, max_range=7.0)
    lidar = Lidar(config, mid360(), scene, len(shapes), outputs=("ranges", "shape_id", "directions_s", "normals_w"))
    frame = lidar.cast(torch.tensor([0.3, 1.7], dtype=torch.float64))
    w, v = scene.body_quat[:, -1:, :1].double(), scene.body_quat[:, -1:, 1:].double().expand(2, 3000, 3)
    d = frame.directions_s.double()
    norm = scene.body_quat[:, -1:].double().square().sum(-1, keepdim=True)
    turned = d + 2 * torch.linalg.cross(v, torch.linalg.cross(v, d) + w * d) / norm
    hits = scene.cast(scene.body_pos[:, -1:].expand(2, 3000, 3), turned, max_range=7.0, normals=True)
    same = frame.shape_id == hits.shape_id
    assert same.float().mean() > 0.999 and {kinds[k] for k in frame.shape_id.unique() if k >= 0} == set(ShapeKind)
    torch.testing.assert_close(frame.ranges[same], hits.ranges[same], rtol=1e-5, atol=1e-5)
    close = (frame.normals_w - hits.normals_w)[same].norm(dim=-1) < 1e-3
    assert close.float().mean() > 0.998
