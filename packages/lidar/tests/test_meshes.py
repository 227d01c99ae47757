"""Triangle meshes: rigid instances, deformable ones, gaps, and input that is not as it should be."""

import math
import sys

import numpy as np
import pytest
import torch
from lidar_helpers import CUBE, CUBE_FACES, cast, one, turn

from benchmarks.lidar_accuracy import random_mesh
from omnilidar import RayScene, Shape, ShapeKind, TriangleMesh
from omnilidar.kernels.mesh import STACK_SIZE
from omnilidar.meshes import _build_tree


def mesh_shape(vertices, triangles, **options):
    return Shape(ShapeKind.MESH, asset=TriangleMesh(vertices, triangles), **options)


def test_a_cube_is_the_box():
    rng = np.random.default_rng(0)
    place = {"pos": (0.3, -0.2, 0.1), "quat": (0.5, 0.5, -0.5, 0.5)}
    scenes = [
        RayScene([shape], 1, 0)
        for shape in (mesh_shape(CUBE, CUBE_FACES, **place), Shape(ShapeKind.BOX, (1, 1, 1), **place))
    ]
    origins, directions = rng.uniform(-3, 3, (2000, 3)), rng.normal(size=(2000, 3))
    mesh, box = (cast(scene, origins, directions, normals=True) for scene in scenes)
    torch.testing.assert_close(mesh.ranges, box.ranges, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(mesh.normals_w, box.normals_w, rtol=0, atol=1e-6)


def test_bodies_carry_instances_of_one_mesh():
    shapes = [mesh_shape(CUBE, CUBE_FACES, body=k) for k in range(2)]
    shapes[1] = Shape(ShapeKind.MESH, asset=shapes[0].asset, body=1, class_id=4)
    scene = RayScene(shapes, num_envs=2, num_bodies=2, num_threads=2)
    assert scene.geometry.mesh_triangle.shape[0] == len(shapes[0].asset.tree.leaf_triangle)  # it is there once
    scene.body_pos[:, 0] = torch.tensor([[5.0, 0, 0], [0, 7.0, 0]])
    scene.body_pos[:, 1] = torch.tensor([[0, 9.0, 0], [11.0, 0, 0]])
    hits = cast(scene, np.zeros((2, 2, 3)), [[[1, 0, 0], [0, 1, 0]]] * 2)
    assert hits.ranges.tolist() == [[4.0, 8.0], [10.0, 6.0]] and hits.shape_id.tolist() == [[0, 1], [1, 0]]


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("place", [0.0, 1000.0])
def test_no_ray_leaves_a_closed_room(scale, place):
    """Aimed anywhere, at corners, along edges, at the middle of edges, from the middle and from anywhere inside."""
    rng = np.random.default_rng(3)
    vertices, faces = random_mesh(rng)
    vertices *= scale
    quat = rng.normal(size=4)
    quat /= np.linalg.norm(quat)
    scene = RayScene([mesh_shape(vertices, faces, body=0)], 1, 1, pose_dtype=torch.float64)
    scene.body_pos[:] = place
    scene.body_quat[0, 0] = torch.from_numpy(quat)
    turned = turn(quat, vertices) + place
    edges = np.concatenate([turned[faces[:, [k, (k + 1) % 3]]] for k in range(3)])
    along = rng.uniform(0, 1, (len(edges), 1))
    targets = np.concatenate([turned, edges.mean(1), edges[:, 0] * along + edges[:, 1] * (1 - along)])
    inside = place + scale * rng.uniform(-0.05, 0.05, (len(targets), 3))
    middle = np.full_like(targets, place)  # from which all of the room is seen
    ranges = cast(scene, middle, targets - middle).ranges[0].numpy()
    np.testing.assert_allclose(ranges, np.linalg.norm(targets - middle, axis=1), rtol=1e-5)
    assert cast(scene, inside, targets - inside).ranges.isfinite().all()
    anywhere = rng.normal(size=(20000, 3))
    assert cast(scene, np.broadcast_to(inside[:1], anywhere.shape), anywhere).ranges.isfinite().all()


def test_corners_and_edges_of_a_cube_in_exact_numbers():
    targets = np.array([(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if x or y or z], float)
    scene = RayScene([mesh_shape(CUBE, CUBE_FACES)], 1, 0)
    ranges = cast(scene, np.zeros_like(targets), targets).ranges[0].numpy()
    np.testing.assert_allclose(ranges, np.linalg.norm(targets, axis=1), rtol=1e-6)


def test_a_tree_holds_every_triangle_once_in_its_boxes():
    rng = np.random.default_rng(0)
    corners = (rng.normal(size=(1000, 1, 3)) + 0.1 * rng.normal(size=(1000, 3, 3))).astype(np.float32)
    mesh = TriangleMesh(corners.reshape(-1, 3), np.arange(3000).reshape(-1, 3))
    tree = mesh.tree
    leaves = tree.leaf_triangle[tree.leaf_triangle >= 0]
    assert sorted(leaves) == list(range(1000))
    assert sum(count for _, count in tree.levels) == len(tree.child)

    def box(child):
        if child > 0:
            return tree.bounds[child, :3].min(1), tree.bounds[child, 3:].max(1)
        held = tree.leaf_triangle[-1 - child]
        points = corners[held[held >= 0]].reshape(-1, 3)
        return points.min(0), points.max(0)

    for node, lane in zip(*np.nonzero(tree.child), strict=True):
        low, high = box(tree.child[node, lane])
        np.testing.assert_array_equal(tree.bounds[node, :3, lane], low)
        np.testing.assert_array_equal(tree.bounds[node, 3:, lane], high)


def test_nested_triangles_fit_the_stack():
    sizes = 2.0 ** np.arange(-60, 60)  # every split of the heuristic takes off the largest
    corners = (sizes[:, None, None] * np.array([(1, 0, 0), (0, 1, 0), (0, 0, 1)])).astype(np.float32)
    corners = np.repeat(corners, 8, axis=0)
    tree, need = _build_tree(corners, heuristic_depth=0)
    assert need <= STACK_SIZE and sorted(tree.leaf_triangle[tree.leaf_triangle >= 0]) == list(range(len(corners)))
    shape = mesh_shape(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))
    assert one([shape], (0, 0, 0), (1, 1, 1)) == pytest.approx(2.0**-60 / math.sqrt(3.0), rel=1e-5)


def test_triangles_without_area_duplicates_and_unused_vertices():
    triangles = np.concatenate([CUBE_FACES, CUBE_FACES[:3], [(0, 0, 1), (2, 2, 2)]])
    mesh = TriangleMesh(np.concatenate([CUBE, [(math.nan, math.inf, 1e30)]]), triangles)
    assert mesh.num_degenerate == 2 and len(mesh.triangles) == 15
    assert one([Shape(ShapeKind.MESH, asset=mesh)], (-3, 0.2, 0.1), (1, 0, 0)) == 2.0


@pytest.mark.parametrize("triangles", [np.zeros((0, 3), int), [(0, 0, 1)]], ids=["none", "a line"])
def test_a_mesh_without_triangles_is_not_hit(triangles):
    shapes = [Shape(kind, asset=TriangleMesh(CUBE, triangles)) for kind in (ShapeKind.MESH, ShapeKind.DEFORMABLE)]
    assert one(shapes, (-3, 0, 0), (1, 0, 0)) == math.inf


def test_slivers_and_coplanar_faces():
    sliver = mesh_shape([(0, -1, -1e-6), (0, 1, -1e-6), (0, 0, 1e-6)], [(0, 1, 2)])
    assert one([sliver], (-2, 0, 0), (1, 0, 0)) == 2.0
    assert one([sliver], (-2, 0, 3e-6), (1, 0, 0)) == math.inf
    twice = mesh_shape(np.concatenate([CUBE, CUBE]), np.concatenate([CUBE_FACES, CUBE_FACES[:, ::-1] + 8]))
    assert one([twice, twice], (-3, 0.5, 0.1), (1, 0, 0)) == 2.0
    in_plane = mesh_shape([(0, -1, 0), (2, -1, 0), (0, 1, 0)], [(0, 1, 2)])
    assert one([in_plane], (-1, -0.5, 0), (1, 0, 0)) in (1.0, math.inf)  # along the face: a point on it, or none


def test_both_sides_are_hit_and_the_normal_follows_the_corners():
    shape = mesh_shape([(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(0, 1, 2)])
    scene = RayScene([shape], 1, 0)
    hits = cast(scene, [[(0.2, 0.2, 1), (0.2, 0.2, -1)]], [[(0, 0, -1), (0, 0, 1)]], normals=True)
    assert hits.ranges.tolist() == [[1.0, 1.0]] and hits.normals_w[0].tolist() == [[0.0, 0.0, 1.0]] * 2


@pytest.mark.parametrize(
    ("vertices", "triangles", "message"),
    [
        (np.zeros((4, 2)), [(0, 1, 2)], r"vertices \(V, 3\)"),
        (CUBE, [(0, 1)], r"triangles \(T, 3\)"),
        (CUBE, [(0, 1, 8)], "has index 8; vertices are 0..7"),
        (np.where(CUBE > 0, math.nan, CUBE), CUBE_FACES, "are not finite, the first is triangle 0"),
    ],
)
def test_wrong_meshes_are_refused(vertices, triangles, message):
    with pytest.raises(ValueError, match=message):
        TriangleMesh(vertices, np.array(triangles))


@pytest.mark.filterwarnings("ignore:mesh .* large")
def test_files_are_read(tmp_path):
    lines = [f"v {x} {y} {z}" for x, y, z in CUBE] + [f"f {a} {b} {c}" for a, b, c in CUBE_FACES + 1]
    (tmp_path / "cube.obj").write_text("\n".join(lines))
    mesh = TriangleMesh.from_file(tmp_path / "cube.obj", scale=2.0)
    assert len(mesh.triangles) == 12 and one([Shape(ShapeKind.MESH, asset=mesh)], (-3, 0, 0.1), (1, 0, 0)) == 1.0
    for scale, message in ((0.0, "scale=0.0 of mesh .* must be above 0"), (1e-60, "holds no triangle with area")):
        with pytest.raises(ValueError, match=message):
            TriangleMesh.from_file(tmp_path / "cube.obj", scale=scale)
    with pytest.raises(ValueError, match="must be whole numbers"):
        TriangleMesh(CUBE, np.array([[0, 1.5, 2]]))


def test_a_missing_trimesh_names_its_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(ImportError, match=r"omnilidar\[meshes\]"):
        TriangleMesh.from_file("cube.glb")


# --- deformable ------------------------------------------------------------------------------------------------


def test_a_deformed_mesh_is_the_mesh_of_its_vertices():
    rng = np.random.default_rng(2)
    vertices, faces = random_mesh(rng)
    scene = RayScene([Shape(ShapeKind.DEFORMABLE, asset=TriangleMesh(vertices, faces))], 3, 0, num_threads=2)
    origins, directions = rng.uniform(-2, 2, (3, 800, 3)), rng.normal(size=(3, 800, 3))
    for _ in range(2):
        moved = np.stack([random_mesh(rng)[0] * rng.uniform(0.5, 2) + rng.normal(size=3) for _ in range(3)])
        scene.update_vertices(0, torch.from_numpy(moved))
        hits = cast(scene, origins, directions, normals=True)
        for env in range(3):
            rigid = RayScene([mesh_shape(moved[env], faces)], 1, 0)
            expected = cast(rigid, origins[env], directions[env], normals=True)
            torch.testing.assert_close(hits.ranges[env], expected.ranges[0], rtol=1e-6, atol=1e-6)
            torch.testing.assert_close(hits.normals_w[env], expected.normals_w[0], rtol=0, atol=1e-5)


def test_vertices_written_in_place_and_those_that_are_not_finite():
    """What is not finite takes its triangles away for that frame."""
    scene = RayScene([Shape(ShapeKind.DEFORMABLE, asset=TriangleMesh(CUBE, CUBE_FACES))], 2, 0)
    ray = ([[(-5, 0.5, 0.1)]] * 2, [[(1, 0, 0)]] * 2)
    scene.vertices(0)[1] *= 2.0
    scene.refit()
    assert cast(scene, *ray).ranges.flatten().tolist() == pytest.approx([4.0, 3.0])
    scene.update_vertices(0, torch.from_numpy(CUBE))
    for wrong in (math.nan, math.inf):
        scene.vertices(0)[1, :4, 1] = wrong  # the wall at x = -1, and every wall beside it
        scene.refit()
        assert cast(scene, *ray).ranges.tolist() == [[4.0], [6.0]]
    scene.update_vertices(0, torch.from_numpy(CUBE))
    assert cast(scene, *ray).ranges.tolist() == [[4.0], [4.0]]
