"""Height fields: the surface against a mesh of its triangles, gaps, walls, the base, and wrong input."""

import math

import numpy as np
import pytest
import torch
from lidar_helpers import cast, rotate, turn

from omnilidar import HeightField, Lidar, LidarConfig, RayScene, ScanPattern, Shape, ShapeKind, TriangleMesh
from omnilidar.kernels.march_block import REACHES


def field_shape(heights, half_x, half_y, base=0.0, scale=1.0, **options):
    return Shape(ShapeKind.HEIGHTFIELD, asset=HeightField(heights, half_x, half_y, base, scale), **options)


def surface_mesh(field):
    """The surface as a mesh of two triangles to a cell, divided from (row, col) to (row + 1, col + 1)."""
    rows, cols = field.heights.shape
    x, y = np.linspace(-field.half_x, field.half_x, cols), np.linspace(-field.half_y, field.half_y, rows)
    x, y = np.meshgrid(x, y)
    vertices = np.stack([x, y, field.heights * field.scale], -1).reshape(-1, 3)
    a = (np.arange(rows - 1)[:, None] * cols + np.arange(cols - 1)).ravel()
    lower, upper = np.stack([a, a + 1, a + cols + 1], 1), np.stack([a, a + cols + 1, a + cols], 1)
    return TriangleMesh(vertices, np.concatenate([lower, upper]))


@pytest.mark.parametrize(("rows", "cols"), [(2, 2), (2, 9), (33, 7), (66, 130)])
@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_the_surface_is_that_of_its_triangles(rows, cols, scale):
    rng = np.random.default_rng(rows * cols)
    quat = rng.normal(size=4)
    place = {"pos": tuple(scale * rng.normal(size=3)), "quat": tuple(quat / np.linalg.norm(quat))}
    shape = field_shape(rng.uniform(0, 1, (rows, cols)), 1.5 * scale, 0.7 * scale, scale=0.6 * scale, **place)
    mesh = Shape(ShapeKind.MESH, asset=surface_mesh(shape.asset), **place)
    above = 3.0 * scale  # from there no ray comes to a wall first
    targets = rng.uniform(-1, 1, (3000, 3)) * (1.4 * scale, 0.65 * scale, 0.0)
    origins = targets * 0.3 + rng.normal(size=(3000, 3)) * 0.1 * scale + (0.0, 0.0, above)
    origins, targets = (turn(shape.quat, points) + shape.pos for points in (origins, targets))
    ours, expected = (cast(RayScene([s], 1, 0), origins, targets - origins, normals=True) for s in (shape, mesh))
    assert expected.ranges.isfinite().float().mean() > 0.95
    both = ours.ranges.isfinite() & expected.ranges.isfinite()
    torch.testing.assert_close(ours.ranges[both], expected.ranges[both], rtol=2e-6, atol=2e-6 * scale)
    assert (ours.ranges.isfinite() != expected.ranges.isfinite()).sum() == 0
    same = (ours.normals_w - expected.normals_w).abs().amax(-1) < 1e-4
    assert same.float().mean() > 0.999  # next to an edge either triangle's


@pytest.mark.parametrize("base", [0.0, 0.2])
def test_nothing_falls_through(base):
    """Rays at grid points, along grid lines and along diagonals, from above and from inside."""
    rng = np.random.default_rng(1)
    rows, cols = 40, 57
    field = HeightField(rng.uniform(0.3, 0.33, (rows, cols)), 2.0, 1.0, base)  # nothing hides behind anything
    scene = RayScene([Shape(ShapeKind.HEIGHTFIELD, asset=field)], 1, 0)
    corners = surface_mesh(field).vertices * np.array([1 - 1e-6, 1 - 1e-6, 1.0])  # not past the rim
    grid = corners.reshape(rows, cols, 3)
    diagonal = (grid[:-1, :-1] + grid[1:, 1:]).reshape(-1, 3) / 2
    beside = np.concatenate([(grid[1:] + grid[:-1]).reshape(-1, 3), (grid[:, 1:] + grid[:, :-1]).reshape(-1, 3)]) / 2
    targets = np.concatenate([corners, diagonal, beside])
    above = np.stack([targets[:, 0], targets[:, 1], np.full(len(targets), 5.0)], -1)
    ranges = cast(scene, above, targets - above).ranges[0].numpy()  # straight down
    np.testing.assert_allclose(ranges, 5.0 - targets[:, 2], rtol=1e-5)
    over = np.array([0.1, -0.2, 4.0])
    ranges = cast(scene, np.broadcast_to(over, targets.shape), targets - over).ranges[0].numpy()
    assert (ranges <= np.linalg.norm(targets - over, axis=1) * (1 + 1e-5)).all()
    inside = np.array([0.013, 0.021, 0.15])
    rays = np.concatenate([targets - inside, rng.normal(size=(20000, 3)) * (1, 1, 0.3)])
    rays = rays[(rays[:, 2] >= 0) | (base > 0)]  # without a base there is no bottom
    assert cast(scene, np.broadcast_to(inside, rays.shape), rays).ranges.isfinite().all()


@pytest.mark.parametrize("base", [0.0, 0.5])
def test_a_flat_field_stops_rays(base):
    scene = RayScene([field_shape(np.zeros((5, 5)), 2.0, 2.0, base)], 1, 0)
    rng = np.random.default_rng(0)
    targets = rng.uniform(-2, 2, (2000, 3)) * (1, 1, 0)
    origins = rng.uniform(-3, 3, (2000, 3)) * (1, 1, 0) + (0, 0, 1.0)
    ranges = cast(scene, origins, targets - origins).ranges[0].numpy()
    np.testing.assert_allclose(ranges, np.linalg.norm(targets - origins, axis=1), rtol=1e-5)


@pytest.mark.parametrize(
    ("origin", "direction", "base", "expected"),
    [
        ((-5, 0, 0.5), (1, 0, 0), 0.0, 3.0),  # a wall, from outside
        ((0, 0, 0.5), (0, 1, 0), 0.0, 1.0),  # a wall, from inside
        ((0, 0, 0.25), (0, 0, 1), 0.0, 0.75),  # the surface from below
        ((0, 0, -3), (0, 0, 1), 0.0, 4.0),  # through the missing bottom to the underside of the surface
        ((0, 0, -3), (0, 0, 1), 0.5, 2.5),  # the bottom of the base
        ((0, 0, 0.25), (0, 0, -1), 0.5, 0.25),  # the top of the base, from inside
        ((0, 0, 0.25), (0, 0, -1), 0.0, math.inf),  # out at the missing bottom
        ((0, 0, -0.25), (0, 0, -1), 0.5, 0.25),  # out of the base
        ((-5, 0, -0.25), (1, 0, 0), 0.5, 3.0),  # a side of the base
        ((-5, 0, -0.25), (1, 0, 0), 0.0, math.inf),  # under the field
        ((-5, 0, 1.25), (1, 0, 0), 0.5, math.inf),  # over it
    ],
)
def test_walls_and_base(origin, direction, base, expected):
    scene = RayScene([field_shape(np.ones((4, 6)), 2.0, 1.0, base)], 1, 0)
    hits = cast(scene, origin, direction, normals=True)
    assert float(hits.ranges) == pytest.approx(expected)
    if math.isfinite(expected) and min(abs(origin[2] - 0.25), 1) > 0:  # hit from outside, or from inside at a wall
        facing = np.dot(hits.normals_w[0, 0].numpy(), direction)
        assert abs(facing) == pytest.approx(1.0)


def test_environments_share_a_field_and_may_hide_it():
    shapes = [field_shape(np.ones((3, 3)), 2.0, 2.0), field_shape(np.ones((3, 3)), 2.0, 2.0, scale=2.0)]
    scene = RayScene(shapes, num_envs=3, num_bodies=0)
    scene.visible[0, 1] = False
    scene.visible[2] = False
    ranges = cast(scene, [[(0, 0, 5)]] * 3, [[(0, 0, -1)]] * 3).ranges
    assert ranges.flatten().tolist() == [4.0, 3.0, math.inf]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([[0, 0], [0, math.nan]], 1, 1), "1 values that are not finite"),
        (([[0, 0], [0, -1]], 1, 1), "subtract the lowest"),
        ((np.zeros((2, 2)), 1, 1, -1), "base=-1"),
    ],
)
def test_wrong_fields_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        HeightField(*arguments)


@pytest.mark.parametrize(("rows", "cols"), [(2, 2), (41, 86), (300, 270)])
def test_windows_hold_the_highest_points_around_each_block(rows, cols):
    field = HeightField(np.random.default_rng(rows).uniform(0, 1, (rows, cols)), 1.0, 1.0)
    blocks = [-(-(n - 1) // 4) for n in (rows, cols)]
    assert field.windows.shape == (*blocks, len(REACHES))
    for row, col in np.random.default_rng(0).integers(0, blocks, (50, 2)):
        for reach, highest in zip(REACHES, field.windows[row, col], strict=True):
            low, high = np.maximum(4 * np.array([row, col]) - reach, 0), 4 * np.array([row, col]) + 4 + reach + 1
            assert highest == field.heights[low[0] : high[0], low[1] : high[1]].max()


@pytest.mark.parametrize(("base", "scale"), [(0.0, 1.0), (0.5, 1.0), (0.5, 1e-3), (0.0, 100.0)])
def test_a_scan_hits_what_single_rays_hit(base, scale):
    """From above, near the rim, in the ground, below it, far over it and beside it, upright and tilted."""
    rng = np.random.default_rng(3)
    steps = 0.15 * np.floor(np.arange(240) / 3 % 20)
    heights = steps[None, :] + np.where(rng.random((200, 240)) < 0.02, rng.uniform(0, 0.6, (200, 240)), 0.0)
    field = HeightField(heights, 12.0 * scale, 10.0 * scale, base * scale, scale)
    pos, quat = scale * np.array([30.0, -20.0, 1.0]), np.array([math.cos(0.3), 0.0, 0.0, math.sin(0.3)])
    shapes = [Shape(ShapeKind.HEIGHTFIELD, asset=field, pos=tuple(pos), quat=tuple(quat))]
    above, below = [(0, 0, 3.2), (4, 5, 3.0), (11.99, -9.99, 3.1), (3, 3, 20)], [(-7, 2, 0.1), (1, 1, -0.2), (1, 2, -5)]
    places = scale * np.array([*above, *below, (-14, 0, 1)])
    origins = torch.from_numpy(turn(quat, np.tile(places, (2, 1))) + pos)  # upright and tilted
    scene = RayScene(shapes, len(origins), 1, pose_dtype=torch.float64)
    scene.body_pos[:, 0] = origins
    scene.body_quat[:, 0] = torch.tensor([1.0, 0, 0, 0])
    tilt = torch.from_numpy(rng.normal(size=(len(places), 4)))
    scene.body_quat[len(places) :, 0] = torch.nn.functional.normalize(tilt, dim=-1)
    pattern = ScanPattern.from_angles(np.arcsin(rng.uniform(-1, 1, 3000)), rng.uniform(0, 2 * np.pi, 3000), 30000.0)
    config = LidarConfig(3000, min_range=0.0, max_range=40.0 * scale)
    lidar = Lidar(config, pattern, scene, 0, outputs=("ranges", "directions_s", "normals_w"))
    frame = lidar.cast(0.3)
    directions = rotate(scene.body_quat, frame.directions_s.double())
    starts = origins[:, None].expand_as(directions).contiguous()
    single = scene.cast(starts, directions, max_range=40.0 * scale, normals=True)
    assert 0.3 < single.ranges.isfinite().float().mean() < 0.9
    near = (frame.ranges - single.ranges).abs() <= 1e-5 + 1e-5 * single.ranges
    same = near | (frame.ranges == single.ranges)
    assert same.float().mean() > 0.9998  # beside the others, rays that graze an edge
    normals_agree = (frame.normals_w - single.normals_w).abs().amax(-1) < 1e-3
    assert normals_agree.float().mean() > 0.999


def test_a_field_keeps_its_heights_when_the_callers_array_is_filled_again():
    heights = np.full((3, 3), 1.0, dtype=np.float32)
    scene = RayScene([Shape(ShapeKind.HEIGHTFIELD, asset=HeightField(heights, 1.0, 1.0))], 1, 0)
    heights[:] = 3.0
    hits = scene.cast(np.array([[[0.1, 0.2, 10.0]]]), np.array([[[0.0, 0.0, -1.0]]]))
    assert float(hits.ranges[0, 0]) == pytest.approx(9.0)


def test_a_mesh_keeps_its_vertices_when_the_callers_array_is_filled_again():
    vertices = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [0.0, 1.0, 0.0]], dtype=np.float32)
    mesh = TriangleMesh(vertices, np.array([[0, 1, 2]]))
    vertices[:, 2] = 3.0
    hits = RayScene([Shape(ShapeKind.MESH, asset=mesh)], 1, 0).cast(
        np.array([[[0.0, 0.0, 10.0]]]), np.array([[[0.0, 0.0, -1.0]]])
    )
    assert float(hits.ranges[0, 0]) == pytest.approx(10.0)
