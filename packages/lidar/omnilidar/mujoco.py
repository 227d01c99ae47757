"""A ray scene from a compiled MuJoCo model. MuJoCo is imported when a function is called, not before."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from .heightfield import HeightField
from .meshes import TriangleMesh
from .scene import RayScene, check_kept
from .shapes import SIZE_NAMES, Shape, ShapeKind

if TYPE_CHECKING:
    import mujoco

_SIZED = (ShapeKind.SPHERE, ShapeKind.CAPSULE, ShapeKind.CYLINDER, ShapeKind.ELLIPSOID, ShapeKind.BOX)
Assets = dict[tuple[ShapeKind, int, bool], TriangleMesh | HeightField]


@dataclass(frozen=True)
class GeomShapes:
    """The geoms of a model as shapes, in the model's order, and the bodies that carry them.

    Attributes:
        shapes: One for each geom; ``shape.body`` is an index into ``body_ids``, -1 where the geom cannot move.
        geom_ids: The geom of each shape.
        body_ids: MuJoCo's ids of the bodies that move and have such geoms, ascending.
    """

    shapes: tuple[Shape, ...]
    geom_ids: tuple[int, ...]
    body_ids: tuple[int, ...]


def geom_shapes(
    model: mujoco.MjModel,
    class_of: Callable[[int], int] | None = None,
    geoms: Sequence[int] | None = None,
    hulls: Collection[int] = (),
) -> GeomShapes:
    """Every geom of a model as the exact shape that ``mj_ray`` intersects.

    A body moves if it has a joint above it or is a mocap body; geoms of the others are placed where the model's
    reference configuration has them.

    Args:
        model: The compiled model.
        class_of: Class id (>= 0) of a geom by its id; 0 for all if None.
        geoms: Ids of the geoms to take; all that ``mj_ray`` hits if None, which leaves out the fully transparent.
        hulls: Ids of geoms of which a mesh is taken as its convex hull, which is what MuJoCo collides.

    Raises:
        ValueError: A geom is a signed distance field, which has no surface that rays could be cast at.
    """
    import mujoco

    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    geom_ids = [k for k in range(model.ngeom) if _is_seen(model, k)] if geoms is None else [int(k) for k in geoms]
    body_ids = tuple(sorted({int(model.geom_bodyid[k]) for k in geom_ids if _moves(model, int(model.geom_bodyid[k]))}))
    assets: Assets = {}
    shapes = []
    for k in geom_ids:
        kind = geom_kind(model, k)
        body = int(model.geom_bodyid[k])
        moves = body in body_ids
        quat = np.empty(4)
        mujoco.mju_mat2Quat(quat, data.geom_xmat[k])
        shapes.append(
            Shape(
                kind=kind,
                size=tuple(model.geom_size[k][: len(SIZE_NAMES[kind])]),
                body=body_ids.index(body) if moves else -1,
                pos=tuple(model.geom_pos[k] if moves else data.geom_xpos[k]),
                quat=tuple(model.geom_quat[k] if moves else quat),
                class_id=class_of(k) if class_of is not None else 0,
                asset=_asset(model, kind, int(model.geom_dataid[k]), k in hulls, assets),
            )
        )
    return GeomShapes(tuple(shapes), tuple(geom_ids), body_ids)


class MujocoScene(RayScene):
    """A ray scene of a compiled model's geoms; rays hit what they hit in ``mj_ray``.

    Attributes:
        geom_ids: The geom of each shape.
        body_ids: MuJoCo's id of each body of the scene.
        body_names: Its name.

    Args:
        model: The compiled model.
        num_envs: Environments, each with poses of its own.
        class_of: Class id (>= 0) of a geom by its id; 0 for all if None.
        geoms: Ids of the geoms to take; all that ``mj_ray`` hits if None.
        device, num_threads, pose_dtype: As for ``RayScene``; poses are MuJoCo's float64 by default.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        num_envs: int = 1,
        class_of: Callable[[int], int] | None = None,
        geoms: Sequence[int] | None = None,
        device: str | torch.device = "cpu",
        num_threads: int | None = None,
        pose_dtype: torch.dtype = torch.float64,
    ) -> None:
        found = geom_shapes(model, class_of, geoms)
        self.geom_ids, self.body_ids = found.geom_ids, found.body_ids
        self.body_names = tuple(model.body(k).name for k in found.body_ids)
        self._nbody, self._ngeom = model.nbody, model.ngeom
        self._rows = torch.tensor(found.body_ids, dtype=torch.int64, device=device)
        super().__init__(found.shapes, num_envs, len(found.body_ids), device, num_threads, pose_dtype)

    def copy_poses(self, xpos: Any, xquat: Any) -> None:
        """Takes the bodies' poses from those of all bodies of the model.

        Args:
            xpos: Positions, metres, (nbody, 3), or (num_envs, nbody, 3): of NumPy, PyTorch, Warp or JAX, of which all
                but NumPy's are read where they are.
            xquat: Orientations, (w, x, y, z), (nbody, 4), or (num_envs, nbody, 4).

        Raises:
            ValueError: They are not of this model's bodies, or of another number of environments.
        """
        for name, own, given in (("xpos", self.body_pos, xpos), ("xquat", self.body_quat, xquat)):
            rows, width = _tensor(given, self.device), own.shape[-1]
            if tuple(rows.shape) not in ((self._nbody, width), (self.num_envs, self._nbody, width)):
                raise ValueError(
                    f"{name} must be ({self._nbody}, {width}) or ({self.num_envs}, {self._nbody}, {width}),"
                    f" got {tuple(rows.shape)}"
                )
            if name == "xpos":
                check_kept(rows, own.dtype)
            own.copy_(rows[..., self._rows, :])

    def copy_data(self, data: Any) -> None:
        """Takes the bodies' poses from a simulation: an ``MjData``, the same for all environments, or one of
        ``mujoco_warp`` or of a batch of ``mujoco.mjx``, whose worlds are the environments."""
        self.copy_poses(data.xpos, data.xquat)

    def copy_sizes(self, geom_size: Any) -> None:
        """Gives primitives the sizes that worlds have of their own.

        Args:
            geom_size: (ngeom, 3), or (num_envs or 1, ngeom, 3): ``geom_size`` of a model of ``mujoco_warp`` or ``mjx``.

        Raises:
            ValueError: It is not of this model's geoms, or of another number of environments.
        """
        sizes = _tensor(geom_size, self.device)
        if tuple(sizes.shape) not in [(*worlds, self._ngeom, 3) for worlds in ((), (1,), (self.num_envs,))]:
            raise ValueError(
                f"geom_size must be ({self._ngeom}, 3) or ({self.num_envs}, {self._ngeom}, 3), got {tuple(sizes.shape)}"
            )
        sizes = sizes.expand(self.num_envs, self._ngeom, 3)
        own = [k for k, shape in enumerate(self.shapes) if shape.kind in _SIZED]
        self.set_sizes(own, sizes[:, [self.geom_ids[k] for k in own]].float())


def convex_hull(model: mujoco.MjModel, mesh: int) -> tuple[np.ndarray, np.ndarray]:
    """The convex hull with which MuJoCo collides a mesh.

    Returns:
        Vertices (V, 3) in the frame of the mesh's geoms, metres, and triangles (T, 3) that turn counter-clockwise
        seen from outside.

    Raises:
        ValueError: The model has no hull of it, because no geom with that mesh collides.
    """
    first = int(model.mesh_graphadr[mesh])
    if first < 0:
        raise ValueError(f"mesh {mesh} ({model.mesh(mesh).name!r}) has no convex hull: none of its geoms collides")
    num_vertices, num_faces = (int(n) for n in model.mesh_graph[first : first + 2])
    vertex_ids = first + 2 + num_vertices  # after the addresses of the vertices' edges
    ids = model.mesh_graph[vertex_ids : vertex_ids + num_vertices]
    faces = first + 2 + 3 * num_vertices + 3 * num_faces  # after the edges
    corners = model.mesh_graph[faces : faces + 3 * num_faces].reshape(-1, 3)
    vertices = model.mesh_vert[int(model.mesh_vertadr[mesh]) + ids]
    place = {int(k): row for row, k in enumerate(ids)}
    return vertices, np.array([[place[int(k)] for k in corner] for corner in corners], np.int32)


def _tensor(given: Any, device: torch.device) -> torch.Tensor:
    """An array of any library, without a copy where it is on the device already."""
    if isinstance(given, np.ndarray | torch.Tensor | list):
        return torch.as_tensor(given, device=device)
    return torch.from_dlpack(given).to(device)


def _is_seen(model: mujoco.MjModel, geom: int) -> bool:
    material = int(model.geom_matid[geom])
    return bool((model.geom_rgba[geom] if material < 0 else model.mat_rgba[material])[3] != 0.0)


def _moves(model: mujoco.MjModel, body: int) -> bool:
    return bool(model.body_mocapid[model.body_rootid[body]] >= 0 or model.body_weldid[body] != 0)


def geom_kind(model: mujoco.MjModel, geom: int) -> ShapeKind:
    """Kind of the shape that rays hit for a geom."""
    import mujoco

    name = mujoco.mjtGeom(int(model.geom_type[geom])).name.removeprefix("mjGEOM_")
    kind = "HEIGHTFIELD" if name == "HFIELD" else name
    if kind not in ShapeKind.__members__:
        raise ValueError(
            f"geom {geom} ({model.geom(geom).name!r}) is of type {name.lower()}, which rays cannot hit: "
            "make it a mesh, or leave it out with geoms=[...]"
        )
    return ShapeKind[kind]


def _asset(
    model: mujoco.MjModel,
    kind: ShapeKind,
    data_id: int,
    as_hull: bool,
    assets: Assets,
) -> TriangleMesh | HeightField | None:
    """The mesh or the height field of a geom, one object for all geoms that share it."""
    if kind not in (ShapeKind.MESH, ShapeKind.HEIGHTFIELD):
        return None
    key = kind, data_id, as_hull
    if key not in assets:
        if kind == ShapeKind.MESH and as_hull:
            assets[key] = TriangleMesh(*convex_hull(model, data_id))
        elif kind == ShapeKind.MESH:
            vertices, faces = int(model.mesh_vertadr[data_id]), int(model.mesh_faceadr[data_id])
            assets[key] = TriangleMesh(
                model.mesh_vert[vertices : vertices + model.mesh_vertnum[data_id]],
                model.mesh_face[faces : faces + model.mesh_facenum[data_id]],
            )
        else:
            rows, cols = int(model.hfield_nrow[data_id]), int(model.hfield_ncol[data_id])
            first = int(model.hfield_adr[data_id])
            half_x, half_y, scale, base = (float(x) for x in model.hfield_size[data_id])
            heights = np.array(model.hfield_data[first : first + rows * cols]).reshape(rows, cols)
            assets[key] = HeightField(heights, half_x, half_y, base, scale)
    return assets[key]
