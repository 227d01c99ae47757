"""Triangle meshes, from arrays or from files, and the trees in which rays look for their triangles."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import warp as wp

from .kernels.mesh import STACK_SIZE
from .kernels.tree import NUM_BINS, split_triangles, widen_tree
from .mesh_files import far_hint, far_origin, read_mesh, unit_hint

HEURISTIC_DEPTH = 48
"""Below this depth of the binary tree, ranges of triangles are halved: no input makes a descent too deep."""


@dataclass(frozen=True)
class Tree:
    """A tree of boxes, four children to a node and four triangles to a leaf, nodes level by level.

    Attributes:
        bounds: Lows (x, y, z) and highs (x, y, z) of each node's children, (N, 6, 4) float32; no child is inside out.
        child: Node index if > 0, no child if 0, leaf -1 - child if < 0, (N, 4) int32.
        levels: (first node, number of nodes) of each level from the root.
        leaf_triangle: Indices of each leaf's triangles, -1 for none, (L, 4) int32.
    """

    bounds: np.ndarray
    child: np.ndarray
    levels: tuple[tuple[int, int], ...]
    leaf_triangle: np.ndarray


class TriangleMesh:
    """A triangle mesh in a frame of its own. Rays hit both sides of a triangle.

    Coordinates are kept in float32. Triangles without area are left out (a ray cannot hit them), duplicates are kept
    (the nearer hit is reported, of equal ones either). The mesh may be open, and its triangles may turn either way; the
    normal is that about which the corners go counter-clockwise.

    Attributes:
        vertices: (V, 3) float32, metres.
        triangles: Vertex indices, (T, 3) int32, those with area.
        num_degenerate: How many triangles were left out.

    Raises:
        ValueError: A shape is wrong, an index names no vertex, a vertex that a triangle uses is not finite, or all lie
            so far from the origin that float32 loses millimetres.
    """

    def __init__(self, vertices: np.ndarray, triangles: np.ndarray) -> None:
        self.vertices = np.array(vertices, dtype=np.float32, order="C")  # its own: what follows from it is kept
        given, triangles = np.asarray(triangles), np.ascontiguousarray(triangles, dtype=np.int64)
        if given.dtype.kind not in "iu" and not np.array_equal(given, triangles):
            raise ValueError("mesh.triangles must be whole numbers, of vertices")
        if self.vertices.ndim != 2 or self.vertices.shape[1] != 3 or triangles.ndim != 2 or triangles.shape[1] != 3:
            raise ValueError(
                f"mesh needs vertices (V, 3), triangles (T, 3); got {self.vertices.shape}, {triangles.shape}"
            )
        outside = (triangles < 0) | (triangles >= len(self.vertices))
        if outside.any():
            raise ValueError(
                f"mesh.triangles has index {triangles[outside][0]}; vertices are 0..{len(self.vertices) - 1}"
            )
        corners = self.vertices[triangles].astype(np.float64)
        broken = ~np.isfinite(corners).all(axis=(1, 2))
        if broken.any():
            first = int(np.flatnonzero(broken)[0])
            raise ValueError(f"mesh.vertices of {broken.sum()} triangles are not finite, the first is triangle {first}")
        far = far_origin(corners)
        if far is not None:
            raise ValueError(
                f"mesh.vertices: the mesh {far_hint(corners)}: subtract an origin in float64 first, such as"
                f" {tuple(far.tolist())}, and add it to shape.pos"
            )
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        has_area = (normal != 0.0).any(axis=1)
        self.triangles = triangles[has_area].astype(np.int32)
        self.num_degenerate = int((~has_area).sum())

    @classmethod
    def from_file(
        cls,
        path: str | Path,
        scale: float = 1.0,
        up: str | None = None,
        origin: Sequence[float] = (0.0, 0.0, 0.0),
    ) -> "TriangleMesh":
        """A mesh from a file, all its parts together, in metres, z up; see ``read_mesh``.

        Args:
            path: .stl, .obj or .ply; with the extra ``meshes`` .glb, .gltf, .dae and what else trimesh reads.
            scale: What coordinates are multiplied by, beside the unit that the format states.
            up: Axis of the file that points up, "z", "y" or "x"; None: as its format says, z where it says nothing.
            origin: Place that becomes the mesh's origin, metres, z up: for files in coordinates of a map.

        Raises:
            FileNotFoundError: There is no such file.
            ImportError: What reads it is not installed.
            ValueError: It is no mesh, none of its triangles has area, it lies far from its origin, or an argument is
                wrong.
        """
        vertices, triangles = read_mesh(path, scale, up)
        if said := unit_hint(path, vertices[triangles], scale):
            warnings.warn(said, stacklevel=2)
        vertices = vertices - np.asarray(origin, np.float64)
        far = far_origin(vertices[triangles])
        if far is not None:
            near = tuple((far + origin).tolist())
            raise ValueError(
                f"mesh {path} {far_hint(vertices[triangles])}: give origin={near}, and add it to shape.pos"
            )
        found = cls(vertices, triangles)
        if not len(found.triangles):
            raise ValueError(f"mesh {path}, {scale} times as large, holds no triangle with area")
        return found

    @cached_property
    def is_closed(self) -> bool:
        """Whether each edge belongs to two triangles that run along it in opposite ways: there is an inside."""
        _, number = np.unique(self.vertices, axis=0, return_inverse=True)  # corners in one place are one corner
        corners = number.reshape(-1)[self.triangles]
        edges = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
        one_way, count = np.unique(edges, axis=0, return_counts=True)
        return (
            len(edges) > 0 and bool((count == 1).all()) and np.array_equal(one_way, np.unique(edges[:, ::-1], axis=0))
        )

    def encloses(self, point: np.ndarray) -> bool:
        """Whether a point, (3,), lies inside: the triangles' solid angles around it add up to 4 pi.

        False for a mesh that is not closed. The solid angle is that of van Oosterom and Strackee (1983).
        """
        if not self.is_closed:
            return False
        a, b, c = np.moveaxis(self.vertices[self.triangles].astype(np.float64) - point, 1, 0)
        la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
        volume = np.einsum("ij,ij->i", a, np.cross(b, c))
        dots = [np.einsum("ij,ij->i", u, v) for u, v in ((a, b), (a, c), (b, c))]
        angle = 2.0 * np.arctan2(volume, la * lb * lc + dots[0] * lc + dots[1] * lb + dots[2] * la)
        return abs(float(angle.sum())) > 2.0 * np.pi

    @property
    def half_extents(self) -> tuple[float, float, float]:
        """Half of the smallest box around the frame's origin that holds the mesh, metres."""
        x, y, z = np.abs(self.vertices[self.triangles]).max(axis=(0, 1), initial=0.0).tolist()
        return x, y, z

    @property
    def radius(self) -> float:
        """Radius of the smallest sphere around the frame's origin that holds the mesh, metres."""
        corners = self.vertices[self.triangles].astype(np.float64)
        return float(np.linalg.norm(corners, axis=-1).max(initial=0.0)) * (1.0 + 1e-6)

    @cached_property
    def tree(self) -> Tree:
        """The tree over the triangles, built on the CPU."""
        return build_tree(self.vertices[self.triangles])

    @property
    def leaf_vertex(self) -> np.ndarray:
        """Vertex indices of each leaf's triangles by corner, -1 for none, (L, 3, 4) int32."""
        none = np.full((1, 3), -1, np.int32)  # the last row, which index -1 takes
        return np.ascontiguousarray(np.concatenate([self.triangles, none])[self.tree.leaf_triangle].transpose(0, 2, 1))

    @property
    def leaf_corners(self) -> np.ndarray:
        """Coordinates of each leaf's triangles, rows 3 * corner + axis, NaN for none, (L, 9, 4) float32."""
        none = np.full((1, 3), np.nan, np.float32)
        corners = np.concatenate([self.vertices, none])[self.leaf_vertex]  # (L, corner, triangle, axis)
        return np.ascontiguousarray(corners.transpose(0, 1, 3, 2)).reshape(-1, 9, 4)


def build_tree(corners: np.ndarray) -> Tree:
    """The tree over triangles with these corners, (T, 3, 3) float32."""
    if len(corners) == 0:
        return Tree(_no_boxes(1), np.zeros((1, 4), np.int32), ((0, 1),), np.full((1, 4), -1, np.int32))
    for heuristic_depth in (HEURISTIC_DEPTH, 0):
        tree, need = _build_tree(corners, heuristic_depth)
        if need <= STACK_SIZE:
            break
    return tree


def _build_tree(corners: np.ndarray, heuristic_depth: int) -> tuple[Tree, int]:
    """The tree, and how many entries of a stack its descent may need."""
    count = len(corners)
    size = 2 * count

    def new(shape: int | tuple[int, ...], dtype: type = wp.int32) -> wp.array:
        return wp.zeros(shape, dtype=dtype, device="cpu")

    lower: wp.array = wp.array(corners.min(axis=1), dtype=wp.vec3, device="cpu")
    upper: wp.array = wp.array(corners.max(axis=1), dtype=wp.vec3, device="cpu")
    order: wp.array = wp.array(np.arange(count, dtype=np.int32), dtype=wp.int32, device="cpu")
    bins = [new(NUM_BINS, dtype) for dtype in (wp.vec3, wp.vec3, wp.int32, wp.float32)]
    first, number, left, depth = (new(size) for _ in range(4))
    node_lower, node_upper = new(size, wp.vec3), new(size, wp.vec3)
    split = [lower, upper, heuristic_depth, *bins, order, first, number, left, depth, node_lower, node_upper]
    wp.launch(split_triangles, dim=1, inputs=split, device="cpu")

    bounds: wp.array = wp.array(_no_boxes(count), dtype=wp.float32, device="cpu")
    child, leaf = new((count, 4)), wp.full((count, 4), -1, dtype=wp.int32, device="cpu")
    depth, totals = new(count), new(3)
    binary = [order, first, number, left, node_lower, node_upper, new(size), new(size)]
    wp.launch(widen_tree, dim=1, inputs=[*binary, bounds, child, depth, leaf, totals], device="cpu")

    num_nodes, num_leaves, need = (int(x) for x in totals.numpy())
    sizes = np.bincount(depth.numpy()[:num_nodes])
    firsts = np.concatenate([[0], np.cumsum(sizes)[:-1]])
    levels = tuple((int(a), int(b)) for a, b in zip(firsts, sizes, strict=True))
    tree = Tree(bounds.numpy()[:num_nodes].copy(), child.numpy()[:num_nodes].copy(), levels, leaf.numpy()[:num_leaves])
    return tree, need


def _no_boxes(count: int) -> np.ndarray:
    boxes = np.full((count, 6, 4), np.inf, np.float32)
    boxes[:, 3:] = -np.inf
    return boxes
