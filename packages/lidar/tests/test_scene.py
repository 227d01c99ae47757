"""Environments, bodies and odd counts in a ray scene."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from lidar_helpers import closed_shapes, random_quats, rotate

from benchmarks.lidar_accuracy import random_mesh
from omnilidar import (
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
from omnilidar.scene import PlacedShapes, SensorView


def rays(num_envs, num_rays=1, direction=(1.0, 0.0, 0.0)):
    return torch.zeros(num_envs, num_rays, 3), torch.tensor(direction).repeat(num_envs, num_rays, 1)


def test_environments_do_not_see_each_other_and_a_miss_after_a_hit_is_infinite():
    scene = RayScene([Shape(ShapeKind.SPHERE, (0.5,), body=0)], num_envs=3, num_bodies=1, num_threads=2)
    scene.body_pos[:, 0] = torch.tensor([[2.0, 0.0, 0.0], [0.0, 0.0, -1000.0], [0.0, 5.0, 0.0]])
    hits = scene.cast(*rays(3), normals=True)
    assert hits.ranges.flatten().tolist() == [1.5, math.inf, math.inf]
    hits = scene.cast(*rays(3, direction=(0.0, 1.0, 0.0)), normals=True)
    assert hits.ranges.flatten().tolist() == [math.inf, math.inf, 4.5]
    assert hits.shape_id.flatten().tolist() == [-1, -1, 0] and not hits.normals_w[:2].any()


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


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([Shape(ShapeKind.SPHERE, (1.0,), body=1)], 1, 1), r"shapes\[0\].body=1 must be < num_bodies=1"),
        (([], 1, 0, "cpu", 1, torch.float16), r"pose_dtype=torch.float16 must be torch.float32 or torch.float64"),
    ],
)
def test_wrong_scenes_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        RayScene(*arguments)


# --- visibility ------------------------------------------------------------------------------------------------

BALLS = [Shape(ShapeKind.SPHERE, (0.5,), pos=(x, 0.0, 0.0), body=b) for x, b in ((2.0, -1), (4.0, 0), (6.0, 1))]


def test_shapes_are_there_in_some_environments_only():
    """Also for a sensor that was built before anything was hidden."""
    scene = RayScene(BALLS, num_envs=3, num_bodies=2)
    forward = ScanPattern(torch.tensor([[1.0, 0.0, 0.0]]), torch.zeros(1), torch.zeros(1), 10.0)
    lidar = Lidar(LidarConfig(1, 0.1, min_range=0.0, max_range=20.0), forward, scene, mount_body=-1)

    def seen():
        ranges = scene.cast(*rays(3)).ranges.flatten().tolist()
        assert lidar.cast(0.0).ranges.flatten().tolist() == ranges
        return ranges

    assert scene.visible_if_used is None and seen() == [1.5] * 3
    assert scene.visible_if_used is None  # nothing is allocated until somebody asks
    assert scene.visible.shape == (3, 3) and scene.visible.all()
    scene.visible[1, 0] = False
    scene.visible[2, list(scene.shapes_of(-1) + scene.shapes_of(0))] = False
    assert seen() == [1.5, 3.5, 5.5]
    assert scene.cast(*rays(3), exclude_shapes=(1,)).ranges.flatten().tolist() == [1.5, 5.5, 5.5]
    scene.visible[:] = True
    assert seen() == [1.5] * 3


# --- order and culling -----------------------------------------------------------------------------------------


def random_crowd(num_shapes, seed, num_envs=2):
    generator = torch.Generator().manual_seed(seed)
    scene = RayScene(closed_shapes(num_shapes), num_envs, num_shapes)
    scene.body_pos.copy_(10.0 * torch.rand(num_envs, num_shapes, 3, generator=generator) - 5.0)
    scene.body_quat.copy_(random_quats(generator, num_envs, num_shapes))
    return scene


@pytest.mark.parametrize("window", [(-0.3, -0.1), (-0.05, 0.9), (1.2, 1.5), (-1.57, -1.1), (-1.5708, 1.5708)])
def test_what_is_left_out_is_outside_the_elevations(window):
    """A direction within the window that hits a shape proves that the shape must be in the view."""
    scene = random_crowd(200, seed=7, num_envs=1)
    placed = PlacedShapes(scene, (), SensorView(elevation=window))
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


# --- poses -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("reach", [0.0, 1.0])
@pytest.mark.parametrize("pose_dtype", [torch.float32, torch.float64])
def test_a_scan_is_what_general_rays_see(pose_dtype, reach):
    """Every kind of shape in one scene, from a moving sensor, against rays of their own, from one place or many."""
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
    scene.body_quat.copy_(random_quats(generator, *scene.body_quat.shape[:2]))
    for k, shape in enumerate(shapes):
        if shape.kind == ShapeKind.DEFORMABLE:
            scene.update_vertices(k, torch.from_numpy(mesh.vertices) * (0.5 + torch.rand(2, 1, 3, generator=generator)))
    config = LidarConfig(num_rays=3000, period_s=0.1, min_range=0.0, max_range=7.0)
    pattern = mid360()
    if reach:
        starts = reach * torch.randn(pattern.num_rows, 3, generator=generator)
        pattern = replace(pattern, origins_s=starts)
    outputs = ("ranges", "shape_id", "directions_s", "normals_w", "row")
    lidar = Lidar(config, pattern, scene, len(shapes), outputs=outputs)
    frame = lidar.cast(torch.tensor([0.3, 1.7], dtype=torch.float64))
    quat = torch.nn.functional.normalize(scene.body_quat[:, -1:].double(), dim=-1)
    turned = rotate(quat, frame.directions_s.double())
    origins = scene.body_pos[:, -1:].double().expand(2, 3000, 3)
    if reach:
        origins = origins + rotate(quat, starts[frame.row.long()].double())
    hits = scene.cast(origins.to(pose_dtype), turned, max_range=7.0, normals=True)
    same = frame.shape_id == hits.shape_id
    assert same.float().mean() > 0.999 and {kinds[k] for k in frame.shape_id.unique() if k >= 0} == set(ShapeKind)
    torch.testing.assert_close(frame.ranges[same], hits.ranges[same], rtol=1e-5, atol=1e-5)
    close = (frame.normals_w - hits.normals_w)[same].norm(dim=-1) < 1e-3
    assert close.float().mean() > 0.998
