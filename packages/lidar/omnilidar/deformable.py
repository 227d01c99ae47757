"""A mesh whose vertices are each environment's own and move from frame to frame: its tree is refitted, not rebuilt."""

import torch
import warp as wp

from .kernels.geometry import Geometry
from .kernels.mesh import MeshPart
from .kernels.tree import gather_leaves, refit_nodes
from .launch import SplitLaunch
from .meshes import TriangleMesh


class Deformable:
    """The vertices of one deformable shape and the launches that bring its trees up to date.

    Attributes:
        vertices: In the frame of the shape, metres, (num_envs, V, 3) float32.
    """

    def __init__(
        self,
        mesh: TriangleMesh,
        part: MeshPart,
        geometry: Geometry,
        num_envs: int,
        device: torch.device,
        num_threads: int,
    ) -> None:
        self.vertices = torch.from_numpy(mesh.vertices).to(device).repeat(num_envs, 1, 1)
        tree, leaf_vertex = mesh.tree, mesh.leaf_vertex
        num_leaves = len(leaf_vertex)
        wp_device = geometry.mesh_child.device
        vertices = wp.from_torch(self.vertices, dtype=wp.vec3)
        self._corners: wp.array = wp.array(leaf_vertex, dtype=wp.vec4i, device=wp_device)
        self._child: wp.array = wp.array(tree.child, dtype=wp.int32, device=wp_device)
        gather = [vertices, self._corners, part.first_leaf, geometry.mesh_triangle]
        self._launches = [
            SplitLaunch(gather_leaves, num_envs, (num_leaves,), gather, device, num_threads, 64 * num_leaves)
        ]
        for first, count in reversed(tree.levels):
            refit = [first, self._child, geometry.mesh_triangle, part.first_leaf, num_leaves, part.first_node]
            args = [*refit, geometry.mesh_bounds]
            self._launches.append(SplitLaunch(refit_nodes, num_envs, (count,), args, device, num_threads, 64 * count))

    def refit(self) -> None:
        """Brings the trees of all environments up to date with ``vertices``."""
        for launch in self._launches:
            launch()
