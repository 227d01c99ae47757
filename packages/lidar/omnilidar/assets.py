"""Lays the shapes of a scene, their meshes and height fields into the arrays that the kernels read."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import warp as wp

from .heightfield import HeightField
from .kernels.geometry import Geometry
from .kernels.heightfield import FieldPart
from .kernels.mesh import MeshPart
from .meshes import TriangleMesh
from .shapes import Shape, ShapeKind


@dataclass
class _Arrays:
    """Arrays laid out so far; ``num_nodes`` and ``num_leaves`` include the copies of deformables.

    ``windowed``: whether blocks of rays march through height fields.
    """

    windowed: bool
    mesh_parts: list[MeshPart] = field(default_factory=list)
    child: list[np.ndarray] = field(default_factory=list)
    bounds: list[np.ndarray] = field(default_factory=list)
    triangles: list[np.ndarray] = field(default_factory=list)
    num_children: int = 0
    num_nodes: int = 0
    num_leaves: int = 0
    field_parts: list[FieldPart] = field(default_factory=list)
    heights: list[np.ndarray] = field(default_factory=list)
    levels: list[tuple[int, int]] = field(default_factory=list)
    extremes: list[np.ndarray] = field(default_factory=list)
    windows: list[np.ndarray] = field(default_factory=list)
    num_heights: int = 0
    num_extremes: int = 0
    num_windows: int = 0

    def add_mesh(self, mesh: TriangleMesh, copies: int) -> int:
        """Lays out a mesh once, or ``copies`` times for a deformable; its part."""
        tree = mesh.tree
        part = MeshPart()
        part.first_child, part.first_node, part.first_leaf = self.num_children, self.num_nodes, self.num_leaves
        if copies:
            part.node_stride, part.leaf_stride = len(tree.child), len(tree.leaf_triangle)
        times = max(copies, 1)
        self.child.append(tree.child)
        self.bounds.append(np.broadcast_to(tree.bounds, (times, *tree.bounds.shape)).reshape(-1, 6, 4))
        triangles = mesh.leaf_corners
        self.triangles.append(np.broadcast_to(triangles, (times, *triangles.shape)).reshape(-1, 9, 4))
        self.num_children += len(tree.child)
        self.num_nodes += times * len(tree.child)
        self.num_leaves += times * len(triangles)
        if max(self.num_nodes * 6, self.num_leaves * 9) >= 2**31:
            raise ValueError(f"meshes fill {self.num_leaves} leaves of four triangles; 238 million are the limit")
        self.mesh_parts.append(part)
        return len(self.mesh_parts) - 1

    def add_field(self, asset: HeightField) -> int:
        """Lays out a height field; its part."""
        extremes, columns = asset.pyramid
        part = FieldPart()
        part.rows, part.cols = asset.heights.shape
        part.half_x, part.half_y = wp.float64(asset.half_x), wp.float64(asset.half_y)
        part.base, part.scale = wp.float64(asset.base), wp.float64(asset.scale)
        part.per_x = wp.float64((part.cols - 1) / (2.0 * asset.half_x))
        part.per_y = wp.float64((part.rows - 1) / (2.0 * asset.half_y))
        part.top = float(asset.heights.max())
        part.first_height, part.first_level, part.top_level = self.num_heights, len(self.levels), len(columns)
        self.heights.append(asset.heights.ravel())
        self.num_heights += asset.heights.size
        self.levels.append((0, 0))  # level 0 is the cells, whose extremes are their corners'
        for nodes, cols in zip(extremes, columns, strict=True):
            self.levels.append((self.num_extremes, cols))
            self.extremes.append(nodes)
            self.num_extremes += len(nodes)
        if self.windowed:
            part.first_window, part.window_cols = self.num_windows, asset.windows.shape[1]
            self.windows.append(asset.windows.reshape(-1, 4))
            self.num_windows += len(self.windows[-1])
        self.field_parts.append(part)
        return len(self.field_parts) - 1


def lay_out(shapes: Sequence[Shape], num_envs: int, device: wp.Device) -> tuple[Geometry, dict[int, MeshPart]]:
    """The shapes on the device, and the part of each deformable shape; an asset that shapes share is there once."""
    arrays = _Arrays(windowed=device.is_cpu)
    parts: list[int] = []
    shared: dict[int, int] = {}
    deformables: dict[int, MeshPart] = {}
    for k, shape in enumerate(shapes):
        part = 0
        if shape.kind == ShapeKind.DEFORMABLE:
            assert isinstance(shape.asset, TriangleMesh)
            part = arrays.add_mesh(shape.asset, num_envs)
            deformables[k] = arrays.mesh_parts[part]
        elif shape.asset is not None and id(shape.asset) in shared:
            part = shared[id(shape.asset)]
        elif shape.asset is not None:
            asset = shape.asset
            part = arrays.add_mesh(asset, 0) if isinstance(asset, TriangleMesh) else arrays.add_field(asset)
            shared[id(shape.asset)] = part
        parts.append(part)

    def upload(values: list, dtype: type) -> wp.array:
        return wp.array(values if len(values) else [dtype()], dtype=dtype, device=device)

    def by_env(values: np.ndarray, dtype: type) -> wp.array:
        row = values if len(values) else np.zeros((1, *values.shape[1:]))
        return wp.array(np.repeat(row[None], num_envs, 0), dtype=dtype, device=device)

    def concatenated(chunks: list[np.ndarray], dtype: type, ndim: int = 1) -> wp.array:
        if not chunks:
            return wp.empty((0,) * ndim, dtype=dtype, device=device)
        return wp.array(np.concatenate(chunks), dtype=dtype, device=device)

    geometry = Geometry()
    geometry.kind = upload([int(shape.kind) for shape in shapes], wp.int32)
    geometry.body = upload([shape.body for shape in shapes], wp.int32)
    geometry.pose = upload([wp_pose(shape.pos, shape.quat) for shape in shapes], wp.transformd)
    extents = np.array([shape.extents for shape in shapes], np.float64).reshape(-1, 3)
    geometry.size, geometry.exact_size = by_env(extents, wp.vec3), by_env(extents, wp.vec3d)
    geometry.radius = by_env(np.array([shape.bounding_radius for shape in shapes], np.float64), wp.float32)
    geometry.class_id = upload([shape.class_id for shape in shapes], wp.int32)
    geometry.part = upload(parts, wp.int32)
    geometry.mesh_part = wp.array(arrays.mesh_parts, dtype=MeshPart, device=device)
    geometry.mesh_bounds = concatenated(arrays.bounds, wp.vec4, 2)
    geometry.mesh_child = concatenated(arrays.child, wp.vec4i)
    geometry.mesh_triangle = concatenated(arrays.triangles, wp.vec4, 2)
    geometry.field_part = wp.array(arrays.field_parts, dtype=FieldPart, device=device)
    geometry.field_height = concatenated(arrays.heights, wp.float32)
    geometry.field_level = concatenated([np.array(arrays.levels, np.int32)] if arrays.levels else [], wp.vec2i)
    geometry.field_extreme = concatenated(arrays.extremes, wp.vec2)
    geometry.field_window = concatenated(arrays.windows, wp.vec4)
    return geometry, deformables


def wp_pose(pos: Sequence[float], quat: Sequence[float]) -> wp.transformd:
    """A position and an orientation (w, x, y, z) of any norm as Warp's transform in float64."""
    w, x, y, z = quat
    unit = wp.normalize(wp.quatd(x, y, z, w))  # type: ignore[call-overload]  # Warp's stubs leave quatd out
    return wp.transformd(wp.vec3d(*pos), unit)
