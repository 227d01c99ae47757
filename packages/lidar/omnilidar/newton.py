"""A ray scene from a Newton model. Newton is imported when a scene is made, not before."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import warp as wp

from .heightfield import HeightField
from .meshes import TriangleMesh
from .rotations import quat_rotated
from .scene import RayScene, body_named
from .shapes import Shape, ShapeKind

if TYPE_CHECKING:
    import newton

_KINDS = {
    "PLANE": ShapeKind.PLANE,
    "HFIELD": ShapeKind.HEIGHTFIELD,
    "SPHERE": ShapeKind.SPHERE,
    "CAPSULE": ShapeKind.CAPSULE,
    "ELLIPSOID": ShapeKind.ELLIPSOID,
    "CYLINDER": ShapeKind.CYLINDER,
    "BOX": ShapeKind.BOX,
    "MESH": ShapeKind.MESH,
    "CONVEX_MESH": ShapeKind.MESH,
}
_LENGTHS = {ShapeKind.SPHERE: 1, ShapeKind.CAPSULE: 2, ShapeKind.CYLINDER: 2, ShapeKind.ELLIPSOID: 3, ShapeKind.BOX: 3}
FLOOR = 40.0
"""Width (m) of what a plane without an end becomes as triangles."""
_NUMBERS = {"PLANE": 2, "SPHERE": 1, "CAPSULE": 2, "ELLIPSOID": 3, "CYLINDER": 2, "BOX": 3, "CONE": 2}
"""How many of a shape's numbers its surface is made of."""


class NewtonScene(RayScene):
    """A ray scene of a finalized Newton model: an environment for each of its worlds, in the model's own frame.

    Shapes of no world are in every environment. Worlds have the same shapes in the same order, each where it is: sizes
    of primitives and places of what no body carries may differ. Cloth and the surfaces of soft bodies, which is what
    the model has triangles of, are deformables. Rays hit what they hit in ``newton.intersect_ray``, and height
    fields, which that one passes through; planes are hit from above alone.

    Attributes:
        shape_ids: Newton's shape of each shape, that of world 0; the deformable has none.
        body_names: Labels of the bodies of world 0 and of no world, in the order of ``body_pos``; behind them stand
            shapes that no body carries and that worlds have in different places.

    Args:
        model: The finalized model.
        class_of: Class id (>= 0) of a shape by Newton's id in world 0; 0 for all if None.
        shapes: Newton's ids of the shapes to take, of all worlds; those that are visible if None.
        num_threads: As for ``RayScene``.

    Raises:
        ValueError: Worlds differ, or a shape has no surface that rays could hit.
    """

    def __init__(
        self,
        model: newton.Model,
        class_of: Callable[[int], int] | None = None,
        shapes: Sequence[int] | None = None,
        num_threads: int | None = None,
    ) -> None:
        num_envs = max(model.world_count, 1)
        of_shape = _Shapes(model)
        taken = range(model.shape_count) if shapes is None else sorted(shapes)
        columns = of_shape.by_world([k for k in taken if shapes is not None or of_shape.visible[k]], num_envs)
        rows = np.unique(of_shape.body[columns[:, 0]])
        rows = rows[rows >= 0]
        self.shape_ids = tuple(int(k) for k in columns[:, 0])
        self.body_names = tuple(model.body_label[k] for k in rows)
        moved = [k for k, column in enumerate(columns) if of_shape.stands_elsewhere(column)]
        made = [of_shape.make(column, rows, class_of) for column in columns]
        for body, k in enumerate(moved, len(rows)):
            own = made[k]
            made[k] = Shape(own.kind, own.size, body, class_id=own.class_id, asset=own.asset)
        surface = _Surface(model, num_envs)
        if surface.mesh is not None:
            made.append(Shape(ShapeKind.DEFORMABLE, asset=surface.mesh))
        device = wp.device_to_torch(model.device)
        super().__init__(made, num_envs, len(rows) + len(moved), device, num_threads)
        carriers = of_shape.body[columns]  # (shapes, worlds)
        carriers = carriers[[int(np.flatnonzero(carriers[:, 0] == row)[0]) for row in rows]]
        self._rows = torch.as_tensor(carriers.T, dtype=torch.int64, device=device)
        self._surface = surface
        for body, k in enumerate(moved, len(rows)):
            places = torch.as_tensor(of_shape.transform[columns[k]], device=device)
            self._write(slice(body, body + 1), places[:, None])
        for k, column in enumerate(columns):
            sizes = of_shape.scale[column]
            if (sizes != sizes[0]).any():
                self.set_sizes([k], sizes[:, None])
        self.copy_state(model.state())

    def copy_state(self, state: newton.State) -> None:
        """Takes the bodies' poses, and the particles' places, from a state of the model."""
        if self._rows.shape[1]:
            assert state.body_q is not None
            self._write(slice(0, self._rows.shape[1]), wp.to_torch(state.body_q)[self._rows])
        if self._surface.mesh is not None:
            assert state.particle_q is not None
            particles = wp.to_torch(state.particle_q)[torch.as_tensor(self._surface.particles, device=self.device)]
            self.update_vertices(len(self.shapes) - 1, particles)

    def link(self, name: str) -> int:
        """Index among the bodies of the one so labelled, or whose label's last part is that."""
        return body_named(name, self.body_names)

    def _write(self, bodies: slice, poses: torch.Tensor) -> None:
        """Poses (num_envs, n, 7) of bodies, positions and quaternions (x, y, z, w)."""
        self.body_pos[:, bodies].copy_(poses[..., :3])
        self.body_quat[:, bodies].copy_(poses[..., [6, 3, 4, 5]])


class _Shapes:
    """A model's shapes as arrays, by Newton's id."""

    def __init__(self, model: Any) -> None:
        from newton import GeoType, ShapeFlags

        self.model, self.assets = model, dict[tuple, TriangleMesh | HeightField]()
        self._contents: dict[int, tuple] = {}
        arrays: list[Any] = [model.shape_type, model.shape_body, model.shape_world, model.shape_flags]
        self.type, self.body, self.world, flags = (array.numpy() for array in arrays)
        self.transform, self.scale = model.shape_transform.numpy(), model.shape_scale.numpy().astype(np.float64)
        self.visible = (flags & ShapeFlags.VISIBLE != 0) & (self.type != GeoType.NONE)
        self.names = {int(kind): kind.name for kind in GeoType}

    def by_world(self, ids: Sequence[int], num_envs: int) -> np.ndarray:
        """(shapes, worlds) Newton's ids of what is the same in all worlds, those of no world first."""
        shared = [k for k in ids if self.world[k] < 0]
        worlds = [[k for k in ids if self.world[k] == world] for world in range(num_envs)]
        for world, own in enumerate(worlds):
            if [self._likeness(k) for k in own] != [self._likeness(k) for k in worlds[0]]:
                raise ValueError(
                    f"world {world} has other shapes than world 0 ({len(own)} and {len(worlds[0])}, or of other kinds,"
                    " bodies or meshes); leave out with shapes=[...] what not all worlds have"
                )
        columns = [[k] * num_envs for k in shared] + [list(column) for column in zip(*worlds, strict=True)]
        return np.array(columns, int).reshape(-1, num_envs)

    def _likeness(self, k: int) -> tuple:
        """What of a shape has to be the same in all worlds."""
        body, source = int(self.body[k]), self.model.shape_source[k]
        if body >= 0:
            starts = self.model.body_world_start.numpy()
            body -= int(starts[self.world[k]]) if self.world[k] >= 0 else 0
        on_body = tuple(self.transform[k]) if body >= 0 else ()
        size = tuple(self.scale[k]) if source is not None or self.names[self.type[k]] == "PLANE" else ()
        return int(self.type[k]), body, on_body, size, self._content(source)

    def _content(self, source: Any) -> tuple:
        """What makes two meshes or height fields the same."""
        if id(source) not in self._contents:
            names = ("vertices", "indices", "data", "hx", "hy", "min_z", "max_z")
            parts = [np.asarray(getattr(source, name)) for name in names if hasattr(source, name)]
            self._contents[id(source)] = tuple((part.shape, part.tobytes()) for part in parts)
        return self._contents[id(source)]

    def stands_elsewhere(self, column: np.ndarray) -> bool:
        """Whether no body carries it, and it is not everywhere at the same place."""
        places = self.transform[column]
        return bool(self.body[column[0]] < 0 and (places != places[0]).any())

    def make(self, column: np.ndarray, rows: np.ndarray, class_of: Callable[[int], int] | None) -> Shape:
        """The shape as world 0 has it."""
        k = int(column[0])
        name = self.names[self.type[k]]
        if name not in _KINDS:
            raise ValueError(
                f"shape {k} ({self.model.shape_label[k]!r}) is of type {name.lower()}, which rays cannot hit: make it a"
                " mesh, or leave it out with shapes=[...]"
            )
        kind, scale = _KINDS[name], self.scale[k]
        size = tuple(scale[: _LENGTHS.get(kind, 0)])
        if kind == ShapeKind.PLANE:
            size = tuple(0.5 * scale[:2])
        x, y, z, *quat = (float(value) for value in self.transform[k])
        asset = self._asset(k, kind) if kind in (ShapeKind.MESH, ShapeKind.HEIGHTFIELD) else None
        if kind == ShapeKind.HEIGHTFIELD:
            low = float(self.model.shape_source[k].min_z * scale[2])
            turn = np.array([quat[3], *quat[:3]])
            x, y, z = np.array([x, y, z]) + quat_rotated(turn, np.array([0.0, 0.0, low]))
        body = int(np.searchsorted(rows, self.body[k])) if self.body[k] >= 0 else -1
        class_id = class_of(k) if class_of is not None else 0
        return Shape(kind, size, body, (x, y, z), (quat[3], quat[0], quat[1], quat[2]), class_id, asset)

    def _asset(self, k: int, kind: ShapeKind) -> TriangleMesh | HeightField:
        source, scale = self.model.shape_source[k], self.scale[k]
        key = id(source), *scale
        if key not in self.assets:
            if kind == ShapeKind.MESH:
                triangles = np.asarray(source.indices).reshape(-1, 3)
                self.assets[key] = TriangleMesh(np.asarray(source.vertices, np.float64) * scale, triangles)
            else:
                heights = np.asarray(source.data).reshape(source.nrow, source.ncol)
                span = float((source.max_z - source.min_z) * scale[2]) or 1.0
                self.assets[key] = HeightField(heights, source.hx * scale[0], source.hy * scale[1], 0.0, span)
        return self.assets[key]


class _Surface:
    """Triangles between particles, the same in every world.

    Attributes:
        mesh: Of world 0; None where there are none.
        particles: (num_envs, V) Newton's particle of each vertex.
    """

    def __init__(self, model: Any, num_envs: int) -> None:
        self.mesh: TriangleMesh | None = None
        self.particles = np.zeros((num_envs, 0), np.int64)
        if not model.tri_count:
            return
        corners = model.tri_indices.numpy().reshape(-1, 3)
        world = np.maximum(model.particle_world.numpy()[corners[:, 0]], 0)
        used = [np.unique(corners[world == env]) for env in range(num_envs)]
        local = [np.searchsorted(own, corners[world == env]) for env, own in enumerate(used)]
        for env in range(num_envs):
            if not np.array_equal(local[env], local[0]):
                raise ValueError(f"world {env} has other triangles of cloth or soft bodies than world 0")
        self.particles = np.stack(used)
        self.mesh = TriangleMesh(model.particle_q.numpy()[used[0]], local[0])


def model_triangles(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) float64, metres, and triangles (T, 3) of all that is visible in a robot or a world.

    Joints are at zero; round shapes become polygons of 32 sides, planes without an end squares of 40 m.

    Args:
        path: .urdf, .xml (MJCF), or .usd, .usda, .usdc, .usdz, which need newton[importers].

    Raises:
        ImportError: What Newton reads the file with is not installed.
        ValueError: Newton cannot read it.
    """
    import newton

    builder: Any = newton.ModelBuilder()
    readers = {".urdf": builder.add_urdf, ".xml": builder.add_mjcf}
    try:
        readers.get(path.suffix.lower(), builder.add_usd)(str(path))
    except ImportError as missing:
        raise ImportError(f"reading {path} needs more of Newton: pip install 'newton[importers]'") from missing
    except (
        ArithmeticError,
        AttributeError,
        LookupError,
        OSError,
        RuntimeError,
        SyntaxError,
        TypeError,
        ValueError,
    ) as e:
        said = str(e).partition("\n")[0] or type(e).__name__
        raise ValueError(f"model {path} cannot be read by Newton: {said}") from e
    model = builder.finalize(device="cpu")
    state, of_shape = model.state(), _Shapes(model)
    newton.eval_fk(model, model.joint_q, model.joint_qd, state)
    vertices, triangles, first = [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)], 0
    for k in np.flatnonzero(of_shape.visible):
        corners, own = _surface_of(newton, of_shape, int(k))
        corners = _placed(of_shape.transform[k], corners)
        if of_shape.body[k] >= 0:
            corners = _placed(state.body_q.numpy()[of_shape.body[k]], corners)
        vertices.append(corners)
        triangles.append(own + first)
        first += len(corners)
    return np.concatenate(vertices), np.concatenate(triangles)


def _surface_of(newton: Any, of_shape: _Shapes, k: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of a shape in its own frame."""
    name, scale = of_shape.names[of_shape.type[k]], of_shape.scale[k]
    source, size = of_shape.model.shape_source[k], [float(x) for x in scale]
    if name == "HFIELD":
        heights = source.min_z + np.reshape(source.data, (source.nrow, source.ncol)) * (source.max_z - source.min_z)
        rows, cols = (np.linspace(-half, half, n) for half, n in ((source.hy, source.nrow), (source.hx, source.ncol)))
        x, y = np.meshgrid(cols, rows)
        corner = (np.arange(source.nrow - 1)[:, None] * source.ncol + np.arange(source.ncol - 1)).reshape(-1, 1, 1)
        steps = np.array([[0, 1, source.ncol + 1], [0, source.ncol + 1, source.ncol]])
        return np.stack((x, y, heights), -1).reshape(-1, 3) * scale, (corner + steps).reshape(-1, 3)
    if name in ("MESH", "CONVEX_MESH"):
        made = source
    else:
        bare = {"compute_inertia": False, "compute_uvs": False, "compute_normals": False}
        if name in ("CAPSULE", "CYLINDER", "CONE"):
            bare["up_axis"] = newton.Axis.Z
        if name == "PLANE":
            size = [width or FLOOR for width in size]
        made = getattr(newton.Mesh, f"create_{name.lower()}")(*size[: _NUMBERS[name]], **bare)
        scale = 1.0
    return np.asarray(made.vertices, np.float64) * scale, np.asarray(made.indices, np.int64).reshape(-1, 3)


def _placed(place: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points (V, 3) by a transform (x, y, z, qx, qy, qz, qw)."""
    return quat_rotated(place[[6, 3, 4, 5]].astype(np.float64), points) + place[:3]
