"""The benchmark's scenes, triangles and float64 reference against closed forms."""

import math

import numpy as np
import pytest

from benchmarks.lidar_benchmark.peers.triangles import environment_triangles, tessellate
from benchmarks.lidar_benchmark.reference import Reference, errors, terrain_ranges
from benchmarks.lidar_benchmark.rotations import about, matrices, quat_multiply
from benchmarks.lidar_benchmark.scenes import (
    CLEARANCE,
    SPEED,
    BenchmarkScene,
    Terrain,
    obstacle_scene,
    spinning_scan,
    terrain_scene,
)

SCAN = spinning_scan(3, channels=4, columns=8)


def test_a_smooth_scene_moves_at_its_speed_and_closes_its_circle():
    scene = obstacle_scene(SCAN, num_bodies=8, num_frames=16, motion="smooth")
    around = np.concatenate([scene.positions, scene.positions[:1]]).astype(float)
    steps = np.linalg.norm(np.diff(around, axis=0), axis=-1)
    chord = 2.0 * math.sin(math.pi / 16) / (2.0 * math.pi / 16)  # of the arc that is walked in one frame
    assert steps == pytest.approx(SPEED * SCAN.period_s * chord, rel=1e-4)


def test_a_jumping_scene_is_another_one_in_each_frame_and_a_static_one_the_same():
    jump = obstacle_scene(SCAN, num_bodies=8, num_frames=3, motion="jump")
    assert np.linalg.norm(jump.positions[1] - jump.positions[0], axis=-1).mean() > 2.0
    static = obstacle_scene(SCAN, num_bodies=8, num_frames=3, motion="static")
    assert not static.moving and static.num_frames == 3
    assert (static.positions[0] == static.positions[2]).all() and (static.sensor_quat[0] == static.sensor_quat[2]).all()


def test_no_obstacle_touches_the_sensor():
    scene = obstacle_scene(SCAN, num_bodies=200, num_frames=4, motion="jump")
    reach = np.linalg.norm(scene.positions - scene.sensor_pos[:, :, None], axis=-1)
    assert (reach - np.linalg.norm(scene.sizes, axis=1) > CLEARANCE - 0.2).all()


def test_a_part_of_a_scene_has_the_same_rays_and_poses():
    scene = obstacle_scene(SCAN, num_bodies=4, num_frames=2)
    part = scene.environments(1, 3)
    assert part.num_envs == 2
    assert (part.directions_w(1) == scene.directions_w(1)[1:]).all() and (part.quats == scene.quats[:, 1:]).all()


def test_rotations_turn_as_quaternions_do():
    turn = about(np.array([0.0, 0.0, 1.0]), np.array(math.pi / 2))
    assert matrices(turn) @ [1.0, 0.0, 0.0] == pytest.approx([0.0, 1.0, 0.0], abs=1e-15)
    tilt = about(np.array([1.0, 0.0, 0.0]), np.array(0.3))
    assert matrices(quat_multiply(turn, tilt)) == pytest.approx(matrices(turn) @ matrices(tilt), abs=1e-15)


@pytest.mark.parametrize(
    ("kind", "size", "volume"),
    [
        ("box", (0.2, 0.3, 0.4), 8 * 0.2 * 0.3 * 0.4),
        ("sphere", (0.5, 0, 0), 4 / 3 * math.pi * 0.5**3),
        ("cylinder", (0.3, 0.6, 0), math.pi * 0.3**2 * 1.2),
        ("capsule", (0.3, 0.6, 0), math.pi * 0.3**2 * 1.2 + 4 / 3 * math.pi * 0.3**3),
    ],
)
def test_triangles_close_around_a_little_less_than_the_shape(kind, size, volume):
    vertices, faces = tessellate(kind, np.array(size))
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    assert len(np.unique(edges, axis=0)) == len(edges), "an edge is walked twice the same way"
    assert {tuple(edge) for edge in edges} == {tuple(edge[::-1]) for edge in edges}, "an edge has no neighbour"
    corners = vertices.astype(float)[faces]
    enclosed = np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6.0
    assert volume * (0.999 if kind == "box" else 0.9) < enclosed <= volume * (1 + 1e-6), "inside out, or too small"


def test_the_reference_of_a_sphere_is_its_closed_form():
    still = np.zeros((1, 1, 3), np.float32), np.array([[[1, 0, 0, 0]]], np.float32)
    centre = np.array([[[[3.0, 0.0, 0.0]]]], np.float32)
    scene = BenchmarkScene(
        ("sphere",), np.array([[0.5, 0, 0]], np.float32), centre, still[1][:, :, None], *still, SCAN, 30.0, plane=False
    )
    directions = np.array([[1.0, 0.0, 0.0], [math.cos(0.1), math.sin(0.1), 0.0], [0.0, 1.0, 0.0]])
    slant = 3.0 * math.cos(0.1) - math.sqrt(0.25 - (3.0 * math.sin(0.1)) ** 2)
    assert Reference(scene).ranges(0, 0, directions) == pytest.approx([2.5, slant, math.inf], abs=1e-12)


def test_the_terrain_reference_lets_nothing_through_its_edges_and_corners():
    terrain = Terrain(np.zeros((9, 9), np.float32), 0.5)
    targets = terrain.vertices.astype(float) * 0.99
    targets = np.concatenate([targets, (terrain.vertices[terrain.faces].astype(float).sum(1) / 3.0)])
    origin = np.array([0.1, 0.2, 1.5])
    rays = targets * (1, 1, 0) - origin
    lengths = np.linalg.norm(rays, axis=1)
    assert terrain_ranges(terrain, origin, rays / lengths[:, None]) == pytest.approx(lengths, rel=1e-12)
    assert terrain_ranges(terrain, origin, np.array([[0.0, 0.0, 1.0]])) == [math.inf]


def test_a_terrain_scene_stands_above_its_ground():
    scene = terrain_scene(SCAN, cells=20, cell=0.5, num_frames=2)
    down = np.array([[0.0, 0.0, -1.0]])
    for env in range(scene.num_envs):
        height = Reference(scene).ranges(0, env, down)[0]
        assert 0.3 < height < 0.8
    vertices, faces = environment_triangles(scene, 0, 0)
    assert len(faces) == 2 * 20 * 20 and faces.max() == len(vertices) - 1


def test_errors_of_known_ranges():
    truth = np.array([1.0, 2.0, 4.0, math.inf, math.inf, 5.0])
    found = errors(np.array([1.0, 2.002, 4.4, math.inf, 3.0, math.inf]), truth)
    assert found.num_rays == 6 and found.disagree == pytest.approx(100.0 / 3.0)
    assert found.median == pytest.approx(1e-3) and found.largest == pytest.approx(0.1)
    assert found.gross == pytest.approx(100.0 / 3.0, abs=34.0)
