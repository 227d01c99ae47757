"""A scene of analytic shapes for many environments at once, and general rays through it."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import warp as wp

from .kernels.geometry import Geometry
from .kernels.place import place_shapes
from .kernels.rays import rays_kernel
from .launch import SplitLaunch, default_num_threads, wp_device
from .shapes import Shape

IDENTITY_QUAT = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class RayHits:
    """What general rays met.

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
class View:
    """From where, how far and in which elevations a sensor looks; what is outside need not be tested."""

    body: int = -1
    pos: tuple[float, float, float] = (0.0, 0.0, 0.0)
    quat: tuple[float, float, float, float] = IDENTITY_QUAT
    max_range: float = float("inf")
    elevation: tuple[float, float] | None = None


class PlacedShapes:
    """A scene's shapes in a viewer's frame, nearest first, refreshed by calling it.

    ``bound`` (num_envs, S) holds centre and rejection threshold, ``near`` the distance to the shape, ``axes``
    its axes in rows, ``shape`` its index, ``count`` (num_envs,) how many of the S slots are in use.
    """

    def __init__(self, scene: "RayScene", exclude_shapes: Sequence[int], view: View | None) -> None:
        excluded = scene.check_shape_ids(exclude_shapes)
        viewed = [k for k in range(len(scene.shapes)) if k not in excluded]
        slots = (scene.num_envs, max(len(viewed), 1))
        device = scene.wp_device
        self.bound = wp.zeros(slots, dtype=wp.vec4, device=device)
        self.near = wp.zeros(slots, dtype=wp.float32, device=device)
        self.shape = wp.zeros(slots, dtype=wp.int32, device=device)
        self.axes = wp.zeros(slots, dtype=wp.mat33, device=device)
        self.count = wp.zeros(scene.num_envs, dtype=wp.int32, device=device)
        cull = view is not None
        view = view or View()
        low, high = view.elevation or (-4.0, 4.0)
        args = [
            scene.wp_body_pos,
            scene.wp_body_quat,
            scene.geometry.kind,
            scene.body,
            scene.pos,
            scene.quat,
            scene.geometry.size,
            scene.geometry.radius,
            wp.array(viewed or [0], dtype=wp.int32, device=device),
            len(viewed),
            view.body,
            wp.vec3(*view.pos),
            wp.vec4(*view.quat),
            int(cull),
            view.max_range,
            low,
            high,
            self.bound,
            self.near,
            self.shape,
            self.axes,
            self.count,
        ]
        self.refresh = scene.launch(place_shapes, (), args, work_per_env=20 * len(viewed))


class RayScene:
    """Shapes shared by ``num_envs`` environments, carried by bodies whose poses are each environment's own.

    Every environment has its own origin, and a ray meets only the shapes of its own environment. Write
    ``body_pos`` and ``body_quat`` in place before a cast; a body moved far below is as good as absent.

    Attributes:
        shapes: The shapes; a shape id is an index into this tuple.
        device: Where the tensors live.
        num_threads: CPU threads per cast; unused on a GPU.

    Conventions are those of ``mj_ray``: a plane is infinite and hit from the side of its normal only; a ray
    that starts inside a closed shape hits its exit surface.
    """

    def __init__(
        self,
        shapes: Sequence[Shape],
        num_envs: int,
        num_bodies: int,
        device: str | torch.device = "cpu",
        num_threads: int | None = None,
    ) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs={num_envs} must be at least 1")
        if num_bodies < 0:
            raise ValueError(f"num_bodies={num_bodies} must not be negative")
        if num_threads is not None and num_threads < 1:
            raise ValueError(f"num_threads={num_threads} must be at least 1, or None for all cores")
        for k, shape in enumerate(shapes):
            if shape.body >= num_bodies:
                raise ValueError(f"shapes[{k}].body={shape.body} must be < num_bodies={num_bodies}")
        self.shapes = tuple(shapes)
        self.num_envs = num_envs
        self.num_bodies = num_bodies
        self.device = torch.empty(0, device=device).device
        self.wp_device = wp_device(self.device)
        self.num_threads = num_threads or default_num_threads()
        self._place_bodies()
        self._upload_shapes()
        self._placed: dict[frozenset[int], PlacedShapes] = {}

    @property
    def body_pos(self) -> torch.Tensor:
        """Body positions in the environment's frame, metres, (num_envs, num_bodies, 3); write in place."""
        return self._body_pos

    @property
    def body_quat(self) -> torch.Tensor:
        """Body orientations in the environment's frame, (w, x, y, z), (num_envs, num_bodies, 4); in place."""
        return self._body_quat

    def _place_bodies(self) -> None:
        rows = max(self.num_bodies, 1)  # Warp needs an address even where there is no body
        pos = torch.zeros(self.num_envs, rows, 3, device=self.device)
        quat = torch.tensor(IDENTITY_QUAT, device=self.device).repeat(self.num_envs, rows, 1)
        self._body_pos, self._body_quat = pos[:, : self.num_bodies], quat[:, : self.num_bodies]
        self.wp_body_pos = wp.from_torch(pos, dtype=wp.vec3)
        self.wp_body_quat = wp.from_torch(quat, dtype=wp.vec4)

    def _upload_shapes(self) -> None:
        def upload(values: list, dtype: type) -> wp.array:
            return wp.array(values or [dtype()], dtype=dtype, device=self.wp_device)

        self.geometry = Geometry()
        self.geometry.kind = upload([int(shape.kind) for shape in self.shapes], wp.int32)
        self.body = upload([shape.body for shape in self.shapes], wp.int32)
        self.pos = upload([wp.vec3(*shape.pos) for shape in self.shapes], wp.vec3)
        self.quat = upload([wp.vec4(*shape.quat) for shape in self.shapes], wp.vec4)
        self.geometry.size = upload([wp.vec3(*(shape.size + (0.0,) * 3)[:3]) for shape in self.shapes], wp.vec3)
        self.geometry.radius = upload([shape.bounding_radius for shape in self.shapes], wp.float32)
        self.geometry.class_id = upload([shape.class_id for shape in self.shapes], wp.int32)

    @property
    def kinds(self) -> frozenset[int]:
        """The kinds of shapes that this scene has."""
        return frozenset(int(shape.kind) for shape in self.shapes)

    def launch(self, kernel: wp.Kernel, inner: Sequence[int], args: Sequence, work_per_env: int = 1) -> SplitLaunch:
        """A replayable launch of ``kernel`` over ``(num_envs, *inner)`` on this scene's device."""
        return SplitLaunch(kernel, self.num_envs, inner, args, self.device, self.num_threads, work_per_env)

    def check_shape_ids(self, shape_ids: Sequence[int]) -> frozenset[int]:
        """``shape_ids`` as a set, or a ValueError if one of them is no shape of this scene."""
        unknown = [k for k in shape_ids if not 0 <= k < len(self.shapes)]
        if unknown:
            raise ValueError(f"exclude_shapes={unknown} must be shape indices in 0..{len(self.shapes) - 1}")
        return frozenset(int(k) for k in shape_ids)

    def cast(
        self,
        origins_w: torch.Tensor,
        directions_w: torch.Tensor,
        max_range: float = float("inf"),
        exclude_shapes: Sequence[int] = (),
        normals: bool = False,
    ) -> RayHits:
        """Casts general rays, for cameras and checks.

        Args:
            origins_w: Start of each ray in its environment's frame, metres, (num_envs, R, 3).
            directions_w: Direction of each ray, any length, (num_envs, R, 3).
            max_range: Rays end here, metres.
            exclude_shapes: Indices of shapes that these rays pass through.
            normals: Whether to compute the normals as well.

        Returns:
            Freshly allocated hits.
        """
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
        normals_w = torch.empty(self.num_envs, num_rays if normals else 1, 3, device=self.device)
        if num_rays:
            placed = self._placed_without(exclude_shapes)
            placed.refresh()
            args = [
                wp.from_torch(self._contiguous(origins_w), dtype=wp.vec3),
                wp.from_torch(self._contiguous(directions_w), dtype=wp.vec3),
                float(max_range),
                int(normals),
                self.geometry,
                placed.bound,
                placed.shape,
                placed.axes,
                placed.count,
                wp.from_torch(ranges),
                wp.from_torch(shape_id),
                wp.from_torch(normals_w, dtype=wp.vec3),
            ]
            self.launch(rays_kernel(self.kinds), (num_rays,), args, work_per_env=num_rays * max(len(self.shapes), 1))()
        return RayHits(ranges, shape_id, normals_w if normals else None)

    def _contiguous(self, tensor: torch.Tensor) -> torch.Tensor:
        return tensor.to(device=self.device, dtype=torch.float32).contiguous()

    def _placed_without(self, exclude_shapes: Sequence[int]) -> PlacedShapes:
        key = self.check_shape_ids(exclude_shapes)
        if key not in self._placed:
            self._placed[key] = PlacedShapes(self, exclude_shapes, view=None)
        return self._placed[key]
