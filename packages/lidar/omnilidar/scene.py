"""A scene of shapes for many environments at once, and general rays through it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args
from weakref import WeakSet

import numpy as np
import torch
import warp as wp

from .assets import lay_out, wp_pose
from .deformable import Deformable
from .kernels.place import GROUP_SIZE, Limits, bound_groups, place_shapes
from .kernels.rays import rays_kernel
from .kernels.slots import WORD, Slots, Viewpoint
from .launch import SplitLaunch, default_num_threads, wp_device
from .meshes import TriangleMesh
from .shapes import Shape, ShapeKind
from .sizes import ShapeSizes

Array = torch.Tensor | np.ndarray
QuatOrder = Literal["wxyz", "xyzw"]

IDENTITY_QUAT = (1.0, 0.0, 0.0, 0.0)
POSE_TYPES = {torch.float32: wp.float32, torch.float64: wp.float64}


@dataclass(frozen=True)
class RayHits:
    """Hits of general rays.

    Attributes:
        ranges: Distance along each ray, metres, ``inf`` for a miss, (num_envs, R).
        shape_id: Index of the shape that was hit, -1 for a miss, (num_envs, R) int32.
        normals_w: Outward unit normal of the surface that was hit, environment frame, zero for a miss,
            (num_envs, R, 3); None unless asked for.
    """

    ranges: torch.Tensor
    shape_id: torch.Tensor
    normals_w: torch.Tensor | None


@dataclass(frozen=True)
class SensorView:
    """From where, how far and in which elevations a sensor looks; what is outside need not be tested.

    Attributes:
        body: That carries the sensor; -1: in the environment.
        pos, quat: Of the sensor in the body's frame, metres and (w, x, y, z).
        max_range: Of its rays, metres.
        reach: How far from the sensor's origin rays start, metres.
        elevation: Lowest and highest of its rays, rad; None: any.
    """

    body: int = -1
    pos: tuple[float, float, float] = (0.0, 0.0, 0.0)
    quat: tuple[float, float, float, float] = IDENTITY_QUAT
    max_range: float = float("inf")
    reach: float = 0.0
    elevation: tuple[float, float] | None = None

    @property
    def viewpoint(self) -> Viewpoint:
        """Pose of the sensor, as the kernels read it."""
        viewpoint = Viewpoint()
        viewpoint.body, viewpoint.pose = self.body, wp_pose(self.pos, self.quat)
        return viewpoint


class PlacedShapes:
    """A scene's shapes in a viewer's frame, nearest first, refreshed by ``refresh``.

    Without a view the frame is the environment's, nothing is left out, and neighbours stand together.

    Attributes:
        slots: The shapes as the kernels read them.
        group: Centre and radius of a sphere around each GROUP_SIZE slots, (num_envs, G) vec4d; None with a view.
    """

    def __init__(self, scene: "RayScene", exclude_shapes: Sequence[int], view: SensorView | None) -> None:
        self._scene, self._view = scene, view or SensorView()
        self.slots, viewed = empty_slots(scene, exclude_shapes, self._view)
        shape, device = self.slots.shape.shape, scene.wp_device
        self.slots.axes = wp.zeros(shape, dtype=wp.mat33, device=device)
        self.slots.pose = wp.zeros(shape, dtype=wp.transformd, device=device)
        self.slots.view = wp.zeros(scene.num_envs, dtype=wp.transformd, device=device)
        self._order = wp.zeros(shape, dtype=wp.int32, device=device)
        self._spare = wp.zeros(shape, dtype=wp.float32, device=device)
        self._limits = limits = Limits()
        limits.viewed, limits.num_viewed = wp.array(viewed or [0], dtype=wp.int32, device=device), len(viewed)
        limits.cull, limits.max_range = view is not None, self._view.max_range + self._view.reach
        limits.elevation_min, limits.elevation_max = self._view.elevation or (-4.0, 4.0)
        self.group: wp.array | None = None
        if view is None:
            groups = (scene.num_envs, -(-shape[1] // GROUP_SIZE))
            self.group = wp.zeros(groups, dtype=wp.vec4d, device=device)
        carriers = {scene.shapes[k].body for k in viewed} | {self._view.body}
        self._moves = carriers != {-1}
        self._launches: list[SplitLaunch] = []
        self._visible: torch.Tensor | None = None
        if not self._moves:
            scene.placed_once.add(self)

    def refresh(self) -> None:
        """Places the shapes where their bodies are now.

        What no body carries is placed once, and by ``place_again``, unless ``visible`` is in use.
        """
        if not self._launches or self._visible is not self._scene.visible_if_used:
            self._visible = self._scene.visible_if_used
            self._launches = self._record()
        elif not self._moves and self._visible is None:
            return
        self.place_again()

    def place_again(self) -> None:
        """Places what has been placed before, though no body may have moved: sizes have changed."""
        for launch in self._launches:
            launch()

    def _record(self) -> list[SplitLaunch]:
        scene, slots, count = self._scene, self.slots, self._limits.num_viewed
        place: list[object] = [scene.wp_body_pos, scene.wp_body_quat, scene.geometry, scene.wp_visible]
        place += [self._view.viewpoint, self._limits, self._order, self._spare, slots]
        launches = [scene.launch(place_shapes, (), place, work_per_env=120 * count)]
        if self.group is not None:
            args = [scene.geometry.radius, slots, self.group]
            launches.append(scene.launch(bound_groups, (), args, work_per_env=4 * count))
        return launches


def check_kept(pos: torch.Tensor, dtype: torch.dtype) -> None:
    """Refuses positions in float64 of which float32 would lose millimetres; on a GPU nobody looks."""
    if pos.is_cpu and pos.dtype == torch.float64 and dtype == torch.float32 and pos.numel():
        lost = float((pos - pos.float()).abs().max())
        if lost > 1e-3:
            raise ValueError(
                f"pos goes up to {float(pos.abs().max()):.10g} m, of which float32 loses {lost:.2g} m: make the scene"
                " with pose_dtype=torch.float64, or subtract each environment's origin"
            )


def body_named(name: str, labels: Sequence[str]) -> int:
    """Index of the one body with that label, or whose label ends in it after a "/".

    Raises:
        ValueError: There is none, or more than one.
    """
    found = [k for k, label in enumerate(labels) if name in (label, label.rpartition("/")[2])]
    if len(found) != 1:
        raise ValueError(f"link {name!r} must be one of the bodies {', '.join(labels)}")
    return found[0]


def empty_slots(scene: "RayScene", exclude_shapes: Sequence[int], view: SensorView) -> tuple[Slots, list[int]]:
    """Slots for the shapes of a scene that are not excluded, and the indices of these shapes."""
    excluded = scene.check_shape_ids(exclude_shapes)
    viewed = [k for k in range(len(scene.shapes)) if k not in excluded]
    shape, device, slots = (scene.num_envs, max(len(viewed), 1)), scene.wp_device, Slots()
    slots.bound = wp.zeros(shape, dtype=wp.vec4, device=device)
    slots.near = wp.zeros(shape, dtype=wp.float32, device=device)
    slots.shape = wp.zeros(shape, dtype=wp.int32, device=device)
    slots.count = wp.zeros(scene.num_envs, dtype=wp.int32, device=device)
    slots.reach = view.reach
    if view.reach == 0.0:
        words = (scene.num_envs, -(-shape[1] // int(WORD)), 4 * int(WORD))
        slots.words = wp.zeros(words, dtype=wp.float32, device=device)
    return slots, viewed


class RayScene:
    """Shapes in ``num_envs`` environments, carried by bodies whose poses are each environment's own.

    Every environment has its own origin, and a ray hits only the shapes of its own environment. Write ``body_pos`` and
    ``body_quat`` in place before a cast, and ``visible`` to hide shapes or to have them in some environments only;
    ``set_sizes`` gives environments sizes of their own.

    Attributes:
        shapes: The shapes; a shape id is an index into this tuple.
        device: Where the tensors live.
        num_threads: CPU threads per cast; unused on a GPU.

    What rays hit is what they hit in ``mj_ray``:
        - A plane is hit from the side of its normal only, and ends where its half extents do. Other surfaces are hit
          from both sides: a ray that starts inside a closed shape hits its exit surface.
        - Where two surfaces coincide, either is reported. A ray that starts on a surface, which is within 1e-7 of the
          shape's size, hits it at 0 or passes on to the next one, as rounding decides.
        - A ray along a face of a box or a triangle may hit it or miss it; its range is that of a point on it.
        - Meshes and height fields have no gaps at edges and corners. A triangle without area is never hit.

    Accuracy: what float32 leaves uncertain is computed again in float64, so that ranges are right to 1e-5 of their
    value plus 1e-5 m for shapes of 1 mm to 1 km. Poses are composed in float64 and made relative to the viewer before
    they are rounded: with ``pose_dtype=torch.float64`` that holds at any distance from the origin, with float32 the
    caller's own rounding (6e-5 m at 1 km) comes on top.

    What cannot be placed is not there: a ray passes through a shape whose body has a position or a quaternion that is
    not finite, a position 1e15 m or more from the origin, or a quaternion whose norm is 1e-6 or less, or 1e6 or more; a
    sensor on such a body misses everything; ``broken_poses`` finds them. A quaternion of any other norm is normalised.
    A triangle of a deformable with a vertex that is not finite is not there. A ray whose origin or direction is not
    finite, or whose direction has length 0, misses.

    Args:
        shapes: The shapes; may be empty.
        num_envs: Number of environments.
        num_bodies: Bodies of an environment.
        device: Of the tensors.
        num_threads: CPU threads per cast, None for all cores.
        pose_dtype: Of ``body_pos`` and ``body_quat``, torch.float32 or torch.float64.

    Raises:
        ValueError: An argument is out of its bounds; the message names it.
    """

    def __init__(
        self,
        shapes: Sequence[Shape],
        num_envs: int,
        num_bodies: int,
        device: str | torch.device = "cpu",
        num_threads: int | None = None,
        pose_dtype: torch.dtype = torch.float32,
    ) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs={num_envs} must be at least 1")
        if num_bodies < 0:
            raise ValueError(f"num_bodies={num_bodies} must not be negative")
        if num_threads is not None and num_threads < 1:
            raise ValueError(f"num_threads={num_threads} must be at least 1, or None for all cores")
        if pose_dtype not in POSE_TYPES:
            raise ValueError(f"pose_dtype={pose_dtype} must be torch.float32 or torch.float64")
        for k, shape in enumerate(shapes):
            if shape.body >= num_bodies:
                raise ValueError(f"shapes[{k}].body={shape.body} must be < num_bodies={num_bodies}")
        self.shapes = tuple(shapes)
        self.num_envs = num_envs
        self.num_bodies = num_bodies
        self.device = torch.empty(0, device=device).device
        self.wp_device = wp_device(self.device)
        self.num_threads = num_threads or default_num_threads()
        self._place_bodies(pose_dtype)
        self.geometry, parts = lay_out(self.shapes, num_envs, self.wp_device)
        self._deformables: dict[int, Deformable] = {}
        for k, part in parts.items():
            mesh = self.shapes[k].asset
            assert isinstance(mesh, TriangleMesh)  # of a deformable
            self._deformables[k] = Deformable(mesh, part, self.geometry, num_envs, self.device, self.num_threads)
        self._sizes = tuple(wp.to_torch(array) for array in (self.geometry.size, self.geometry.exact_size))
        self._radius = wp.to_torch(self.geometry.radius)
        self._sized: dict[tuple[int, ...], tuple[torch.Tensor, ShapeSizes]] = {}
        self.placed_once: WeakSet[PlacedShapes] = WeakSet()
        self._visible: torch.Tensor | None = None
        self._placed: dict[frozenset[int], PlacedShapes] = {}

    @property
    def body_pos(self) -> torch.Tensor:
        """Body positions in the environment's frame, metres, (num_envs, num_bodies, 3); write in place."""
        return self._body_pos

    @property
    def body_quat(self) -> torch.Tensor:
        """Body orientations in the environment's frame, (w, x, y, z), (num_envs, num_bodies, 4); in place."""
        return self._body_quat

    @property
    def visible(self) -> torch.Tensor:
        """Shapes that exist, by environment, (num_envs, num_shapes) bool, all at first; write in place.

        Allocated, and looked at, from the first use on.
        """
        if self._visible is None:
            self._visible = torch.ones(self.num_envs, len(self.shapes), dtype=torch.bool, device=self.device)
        return self._visible

    @property
    def visible_if_used(self) -> torch.Tensor | None:
        """``visible``, or None until it is first read."""
        return self._visible

    @property
    def wp_visible(self) -> wp.array | None:
        """The same for the kernels."""
        if self._visible is None:
            return None
        visible = wp.from_torch(self._visible)
        assert isinstance(visible, wp.array)
        return visible

    def shapes_of(self, body: int) -> tuple[int, ...]:
        """Indices of the shapes that a body carries; -1 for those fixed in the environment."""
        return tuple(k for k, shape in enumerate(self.shapes) if shape.body == body)

    def set_poses(self, pos: Array, quat: Array, order: QuatOrder = "wxyz") -> None:
        """Copies poses from another simulator's arrays, of any float type and on any device.

        Args:
            pos: Positions in the environment's frame, metres, (num_envs, num_bodies, 3), or (num_bodies, 3) for all
                environments. Where the simulator has one world for all, subtract each environment's origin.
            quat: Orientations, (num_envs, num_bodies, 4) or (num_bodies, 4).
            order: Of a quaternion's numbers: "wxyz" (MuJoCo, Genesis, Isaac Lab 2) or "xyzw" (Isaac Gym, Isaac Lab 3,
                Newton, PyBullet, ROS).
        """
        if order not in get_args(QuatOrder):
            raise ValueError(f"order={order!r} must be one of {', '.join(get_args(QuatOrder))}")
        pos, quat = torch.as_tensor(pos), torch.as_tensor(quat)
        for name, given, own in (("pos", pos, self.body_pos), ("quat", quat, self.body_quat)):
            if given.shape not in (own.shape, own.shape[1:]):
                raise ValueError(f"{name} {tuple(given.shape)} must be {tuple(own.shape)} or {tuple(own.shape[1:])}")
        check_kept(pos, self.body_pos.dtype)
        self.body_pos.copy_(pos)
        if order == "wxyz":
            self.body_quat.copy_(quat)
        else:
            self.body_quat[..., 0].copy_(quat[..., 3])
            self.body_quat[..., 1:].copy_(quat[..., :3])

    def sizes(self, shape_ids: Sequence[int]) -> torch.Tensor:
        """A copy of the present sizes of shapes, metres, as in ``set_sizes``, (num_envs, k, 3) float64."""
        return self._sizes[1][:, list(shape_ids)]

    def set_sizes(
        self, shape_ids: Sequence[int], sizes: Array, env_ids: torch.Tensor | None = None, check: bool = True
    ) -> None:
        """Gives boxes, spheres, cylinders, capsules and ellipsoids sizes of their own in some environments.

        It writes into memory that casts read: those that are recorded, in graphs too, go on with the new sizes.

        Args:
            shape_ids: The k shapes.
            sizes: Metres, as ``Shape.size`` with the unused of three values ignored, (n, k, 3), or (k, 3) for all n
                environments.
            env_ids: Which environments, (n,) int64; None for all.
            check: Whether the values are looked at, for which the host waits for a GPU. Without it they have to be
                positive and finite.

        Raises:
            ValueError: A shape has no such size, ``sizes`` has the wrong shape, or a value is not positive and finite.
        """
        index, shapes = self._sized_shapes(shape_ids)
        num_envs, count = self.num_envs if env_ids is None else len(env_ids), len(index)
        sizes = torch.as_tensor(sizes, device=self.device).double()
        if sizes.shape not in ((num_envs, count, 3), (count, 3)):
            raise ValueError(f"sizes {tuple(sizes.shape)} must be {(num_envs, count, 3)} or {(count, 3)}")
        if check and not bool(shapes.are_valid(sizes)):
            raise ValueError("sizes must be positive and finite where the kind of their shape reads them")
        sizes = shapes.read(sizes).expand(num_envs, count, 3)
        rows = slice(None) if env_ids is None else env_ids.to(self.device)[:, None]
        for own in self._sizes:
            own[rows, index] = sizes.to(own.dtype)
        self._radius[rows, index] = shapes.bounding_radii(sizes).float()
        for placed in self.placed_once:
            placed.place_again()

    def _sized_shapes(self, shape_ids: Sequence[int]) -> tuple[torch.Tensor, ShapeSizes]:
        """Indices (k,) of primitives, and how they read their sizes."""
        key = tuple(int(k) for k in shape_ids)
        if key not in self._sized:
            self._check_known("shape_ids", key)
            names, kinds = [f"shapes[{k}]" for k in key], [self.shapes[k].kind for k in key]
            index = torch.tensor(key, dtype=torch.int64, device=self.device)
            self._sized[key] = index, ShapeSizes(names, kinds, self.device)
        return self._sized[key]

    def broken_poses(self) -> torch.Tensor:
        """Bodies that cannot be placed, see the class, (num_envs, num_bodies) bool."""
        norm, away = (values.double().square().sum(-1) for values in (self.body_quat, self.body_pos))
        return ~((norm > 1e-12) & (norm < 1e12) & (away < 1e30))  # as the kernels' is_pose

    def vertices(self, shape_id: int) -> torch.Tensor:
        """Vertices of a deformable shape in its frame, metres, (num_envs, V, 3) float32.

        Write in place, then call ``refit``.
        """
        return self._deformable(shape_id).vertices

    def update_vertices(self, shape_id: int, vertices: torch.Tensor) -> None:
        """Moves the vertices of a deformable shape and refits its trees, once per frame.

        Args:
            shape_id: The shape.
            vertices: In the frame of the shape, metres, (num_envs, V, 3), or (V, 3) for all environments.
        """
        own = self._deformable(shape_id).vertices
        if vertices.shape not in (own.shape, own.shape[1:]):
            raise ValueError(f"vertices {tuple(vertices.shape)} must be {tuple(own.shape)} or {tuple(own.shape[1:])}")
        own.copy_(vertices)
        self._deformables[shape_id].refit()

    def refit(self) -> None:
        """Brings the trees of all deformable shapes up to date with their vertices."""
        for deformable in self._deformables.values():
            deformable.refit()

    def _deformable(self, shape_id: int) -> Deformable:
        if shape_id not in self._deformables:
            raise ValueError(f"shape_id={shape_id} must be a deformable shape, one of {sorted(self._deformables)}")
        return self._deformables[shape_id]

    def _place_bodies(self, dtype: torch.dtype) -> None:
        rows = max(self.num_bodies, 1)  # Warp needs an address even where there is no body
        pos = torch.zeros(self.num_envs, rows, 3, device=self.device, dtype=dtype)
        quat = torch.tensor(IDENTITY_QUAT, device=self.device, dtype=dtype).repeat(self.num_envs, rows, 1)
        self._body_pos, self._body_quat = pos[:, : self.num_bodies], quat[:, : self.num_bodies]
        real = POSE_TYPES[dtype]
        self.wp_body_pos = wp.from_torch(pos, dtype=wp.types.vector(3, real))
        self.wp_body_quat = wp.from_torch(quat, dtype=wp.types.vector(4, real))

    @property
    def has_mesh(self) -> bool:
        """Tell whether any shape is a mesh or a deformable."""
        return any(shape.kind in (ShapeKind.MESH, ShapeKind.DEFORMABLE) for shape in self.shapes)

    @property
    def has_heightfield(self) -> bool:
        """Tell whether any shape is a height field."""
        return any(shape.kind == ShapeKind.HEIGHTFIELD for shape in self.shapes)

    def launch(self, kernel: wp.Kernel, inner: Sequence[int], args: Sequence, work_per_env: int = 1) -> SplitLaunch:
        """A replayable launch of ``kernel`` over ``(num_envs, *inner)`` on this scene's device."""
        return SplitLaunch(kernel, self.num_envs, inner, args, self.device, self.num_threads, work_per_env)

    def check_shape_ids(self, shape_ids: Sequence[int]) -> frozenset[int]:
        """``shape_ids`` as a set, or a ValueError if one of them is no shape of this scene."""
        self._check_known("exclude_shapes", shape_ids)
        return frozenset(int(k) for k in shape_ids)

    def _check_known(self, name: str, shape_ids: Sequence[int]) -> None:
        unknown = [k for k in shape_ids if not 0 <= k < len(self.shapes)]
        if unknown:
            raise ValueError(f"{name}={unknown} must be shape indices in 0..{len(self.shapes) - 1}")

    def cast(
        self,
        origins_w: Array,
        directions_w: Array,
        max_range: float = float("inf"),
        exclude_shapes: Sequence[int] = (),
        normals: bool = False,
    ) -> RayHits:
        """Casts general rays, for cameras and checks.

        Args:
            origins_w: Start of each ray in its environment's frame, metres, (num_envs, R, 3), float32 or float64, a
                tensor or a NumPy array.
            directions_w: Direction of each ray, any length > 0, likewise.
            max_range: Rays end here, metres.
            exclude_shapes: Indices of shapes that these rays pass through.
            normals: Whether to compute the normals as well.

        Returns:
            Freshly allocated hits.
        """
        origins_w, directions_w = torch.as_tensor(origins_w), torch.as_tensor(directions_w)
        if origins_w.shape != directions_w.shape or origins_w.ndim != 3 or origins_w.shape[::2] != (self.num_envs, 3):
            raise ValueError(
                f"origins_w {tuple(origins_w.shape)} and directions_w {tuple(directions_w.shape)} "
                f"must both be (num_envs={self.num_envs}, R, 3)"
            )
        if not max_range > 0.0:
            raise ValueError(f"max_range={max_range} must be > 0")
        num_rays = origins_w.shape[1]
        ranges = torch.empty(self.num_envs, num_rays, device=self.device)
        shape_id = torch.empty(self.num_envs, num_rays, device=self.device, dtype=torch.int32)
        normals_w = torch.empty(self.num_envs, num_rays, 3, device=self.device) if normals else None
        if num_rays:
            dtype = torch.promote_types(torch.promote_types(origins_w.dtype, directions_w.dtype), torch.float32)
            origins_w, directions_w = (x.to(self.device, dtype).contiguous() for x in (origins_w, directions_w))
            placed = self._placed_without(exclude_shapes)
            placed.refresh()
            vec3 = wp.types.vector(3, POSE_TYPES[dtype])
            rays = [wp.from_torch(origins_w, dtype=vec3), wp.from_torch(directions_w, dtype=vec3), float(max_range)]
            out: list[object] = [wp.from_torch(ranges), wp.from_torch(shape_id)]
            out.append(None if normals_w is None else wp.from_torch(normals_w, dtype=wp.vec3))
            args = [*rays, self.geometry, placed.group, placed.slots, *out]
            kernel = rays_kernel(self.has_mesh, self.has_heightfield)
            self.launch(kernel, (num_rays,), args, work_per_env=num_rays * max(len(self.shapes), 1))()
        return RayHits(ranges, shape_id, normals_w)

    def _placed_without(self, exclude_shapes: Sequence[int]) -> PlacedShapes:
        key = self.check_shape_ids(exclude_shapes)
        if key not in self._placed:
            self._placed[key] = PlacedShapes(self, exclude_shapes, view=None)
        return self._placed[key]
