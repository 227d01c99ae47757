"""A ray scene from a Genesis scene. Genesis is imported by who made that, not here."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch

from .meshes import TriangleMesh
from .rotations import quat_from_z, quat_product, quat_rotated
from .scene import RayScene, body_named
from .shapes import Shape, ShapeKind

_SIZES: dict[str, tuple[ShapeKind, tuple[float, ...]]] = {
    "SPHERE": (ShapeKind.SPHERE, (1.0,)),
    "ELLIPSOID": (ShapeKind.ELLIPSOID, (1.0, 1.0, 1.0)),
    "CYLINDER": (ShapeKind.CYLINDER, (1.0, 0.5)),
    "CAPSULE": (ShapeKind.CAPSULE, (1.0, 0.5)),
    "BOX": (ShapeKind.BOX, (0.5, 0.5, 0.5)),
}
"""Kind of a primitive, and what Genesis's numbers (radii, whole lengths) are multiplied by."""


class GenesisScene(RayScene):
    """A ray scene of a built Genesis scene: its environments, in the frame that its poses are in.

    Shapes are the collision geoms of rigid entities, which Genesis's own ray caster hits as well: primitives as they
    are (there, spheres and cylinders are cast as meshes), meshes and terrains by their triangles, planes without an
    end and from above alone. Links are bodies; links that are fixed to the world and stand at the same place in all
    environments stay where they are now. FEM entities and cloth of PBD are deformables.

    Attributes:
        geoms: Genesis's geom of each shape; None for a deformable.
        body_names: Name of the link that is each body, "<entity>/<link>".

    Args:
        scene: The built scene.
        class_of: Class id (>= 0) of a geom; 0 for all if None.
        entities: The entities to take; all if None.
        num_threads: As for ``RayScene``.

    Raises:
        ValueError: It is not built, entities differ between environments, or one has no surface that rays could hit.
    """

    def __init__(
        self,
        scene: Any,
        class_of: Callable[[Any], int] | None = None,
        entities: Sequence[Any] | None = None,
        num_threads: int | None = None,
    ) -> None:
        if not scene.is_built:
            raise ValueError("the Genesis scene has no environments yet: call scene.build(n_envs=...) before")
        if scene.rigid_solver._enable_heterogeneous:
            raise ValueError(
                "an entity of several morphs is another in each environment: make a Genesis scene for each"
            )
        taken = list(scene.entities if entities is None else entities)
        rigid = [entity for entity in taken if hasattr(entity, "links")]
        self._soft = [_Surface(entity) for entity in taken if not hasattr(entity, "links")]
        self._solver = scene.rigid_solver if rigid else None
        num_envs = max(scene.n_envs, 1)
        links = [link for entity in rigid for link in entity.links if link.geoms]
        pos, quat = self._link_poses(num_envs)
        alike = ((pos == pos[:1]).all(2) & (quat == quat[:1]).all(2)).all(0).tolist()
        stands = {link.idx for link in links if link.is_fixed and alike[link.idx]}
        moving = [link for link in links if link.idx not in stands]
        self.body_names = tuple(f"{link.entity.name}/{link.name}" for link in moving)
        body_of = {link.idx: body for body, link in enumerate(moving)}
        shapes, geoms = [], []
        for link in links:
            for geom in link.geoms:
                at = (pos[0, link.idx], quat[0, link.idx]) if link.idx in stands else None
                shapes.append(_shape(geom, body_of.get(link.idx, -1), at, class_of(geom) if class_of else 0))
                geoms.append(geom)
        self.geoms = (*geoms, *(None for _ in self._soft))
        shapes += [Shape(ShapeKind.DEFORMABLE, asset=surface.mesh) for surface in self._soft]
        device = self._soft[0].places().device if not rigid else pos.device
        self._rows = torch.tensor([link.idx for link in moving], dtype=torch.int64, device=device)
        super().__init__(shapes, num_envs, len(moving), device, num_threads)
        self.copy_state()

    def copy_state(self) -> None:
        """Takes the links' poses, and the places of what is soft, as they are in the scene now."""
        if len(self._rows):
            pos, quat = self._link_poses(self.num_envs)
            self.body_pos.copy_(pos[:, self._rows])
            self.body_quat.copy_(quat[:, self._rows])
        for k, surface in enumerate(self._soft, len(self.shapes) - len(self._soft)):
            self.update_vertices(k, surface.places())

    def link(self, name: str) -> int:
        """Index among the bodies of the link so named, alone or as "<entity>/<link>"."""
        return body_named(name, self.body_names)

    def _link_poses(self, num_envs: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Positions (num_envs, links, 3) and quaternions (w, x, y, z) of all links."""
        if self._solver is None:
            return torch.zeros(num_envs, 0, 3), torch.zeros(num_envs, 0, 4)
        pos, quat = self._solver.get_links_pos(), self._solver.get_links_quat()
        return pos.reshape(num_envs, -1, 3), quat.reshape(num_envs, -1, 4)


class _Surface:
    """The triangles of a soft entity.

    Attributes:
        mesh: Where it is now, in environment 0.
    """

    def __init__(self, entity: Any) -> None:
        self._entity = entity
        self._used: torch.Tensor | None = None  # the vertices outside; all if None
        if hasattr(entity, "surface_triangles"):  # FEM: elements are tetrahedra, whose outside is hit
            corners = np.asarray(entity.surface_triangles)
            used, triangles = np.unique(corners, return_inverse=True)
            self._used, triangles = torch.as_tensor(used), triangles.reshape(corners.shape)
        elif getattr(entity, "mesh", None) is not None and len(entity.mesh.verts) == entity.n_particles:
            triangles = np.asarray(entity.mesh.faces)  # PBD cloth: a particle for each vertex
        else:
            raise ValueError(
                f"entity {entity.name!r} is of particles ({type(entity).__name__}) without triangles between them,"
                " which rays cannot hit: make it cloth or FEM, or leave it out with entities=[...]"
            )
        self.mesh = TriangleMesh(self.places()[0].cpu().numpy(), triangles)

    def places(self) -> torch.Tensor:
        """(num_envs, V, 3) m, of the vertices."""
        if self._used is None:
            pos = self._entity.get_particles_pos()
        else:
            pos = self._entity.get_state().pos[..., self._used, :]
        return pos.reshape(-1, *pos.shape[-2:])


def _shape(geom: Any, body: int, at: tuple[torch.Tensor, torch.Tensor] | None, class_id: int) -> Shape:
    """A geom on its link, or where its link is ``at``."""
    pos, quat = np.asarray(geom.init_pos, np.float64), np.asarray(geom.init_quat, np.float64)
    name, data = geom.type.name, np.asarray(geom.data, np.float64)
    asset, size = None, tuple[float, ...]()
    if name == "PLANE":
        kind, quat = ShapeKind.PLANE, quat_product(quat, quat_from_z(data[:3]))
    elif name in _SIZES:
        kind, factors = _SIZES[name]
        size = tuple(float(x) * factor for x, factor in zip(data, factors, strict=False))
    else:
        kind, asset = ShapeKind.MESH, TriangleMesh(np.asarray(geom.init_verts), np.asarray(geom.init_faces))
    if at is not None:
        link_pos, link_quat = (part.cpu().numpy().astype(np.float64) for part in at)
        pos, quat = link_pos + quat_rotated(link_quat, pos), quat_product(link_quat, quat)
    return Shape(kind, size, body, tuple(pos), tuple(quat), class_id, asset)
