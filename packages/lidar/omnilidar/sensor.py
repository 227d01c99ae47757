"""The LiDAR: a scan pattern on a moving mount, cast through a scene at its own rate."""

import itertools
import math
import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import get_args

import numpy as np
import torch
import warp as wp

from .frame import INTEGERS, OUTPUTS, VECTORS, LidarFrame
from .kernels.march_block import BLOCK
from .kernels.motion import Track
from .kernels.noise import noise_parameters
from .kernels.scan import Labels, Rays, ScanOutputs, scan_kernel
from .launch import SplitLaunch
from .motion import PoseTrack, SweptShapes
from .noise import Noise, max_deviation, noise_by_name
from .patterns.selection import Strategy, make_selection
from .patterns.table import ROW_SLACK, ScanPattern
from .rotations import quat_from_rpy
from .scan_table import ScanTable
from .scene import PlacedShapes, RayScene, SensorView
from .shapes import ShapeKind, finite_tuple

_COVERED = 0.8
"""Share of a frame that evenly kept points should span."""
_SEEDS = 0x7FFFFFFF
"""Bits of a seed that the kernels read."""

RAYS_PER_TASK = BLOCK
"""Rays of one environment that a CPU thread casts in one go."""


@dataclass(frozen=True)
class LidarConfig:
    """Mount of a LiDAR, and what of its scan is kept.

    Attributes:
        num_rays: Points kept per frame.
        period_s: Seconds from frame to frame.
        min_range: Nearer surfaces return nothing, metres.
        max_range: Farther surfaces return nothing, metres.
        mount_pos: Sensor position in the mount body's frame, metres.
        mount_rpy: Sensor orientation in the mount body's frame, roll-pitch-yaw about fixed axes, rad.
        mount_quat: The same as (w, x, y, z), in place of ``mount_rpy``.
        selection: Which points of a frame are kept: "every_kth" or "stratified", see ``make_selection``.
        reference_range: Distance at which a white wall seen perpendicularly has intensity 1, metres.
        motion_segments: Segments into which a frame is cut for motion distortion: each point is cast from the sensor's
            and the bodies' poses at its own time, interpolated between the ends of its segment. 0: every point is cast
            from the poses at the frame's end. Vertices of deformables are in either case those at the frame's end.
        motion_jump: A body that moves farther than this within a segment has jumped and does not sweep, metres.
    """

    num_rays: int = 1000
    period_s: float = 0.1
    min_range: float = 0.1
    max_range: float = 40.0
    mount_pos: tuple[float, float, float] = (0.0, 0.0, 0.0)
    mount_rpy: tuple[float, float, float] | None = None
    mount_quat: tuple[float, float, float, float] | None = None
    selection: Strategy = "every_kth"
    reference_range: float = 10.0
    motion_segments: int = 0
    motion_jump: float = math.inf

    def __post_init__(self) -> None:
        _require_whole("lidar.num_rays", self.num_rays, 1)
        if not (self.period_s > 0.0 and math.isfinite(self.period_s)):
            raise ValueError(f"lidar.period_s={self.period_s} must be positive and finite")
        if not self.min_range >= 0.0:
            raise ValueError(f"lidar.min_range={self.min_range} must be >= 0")
        if not (self.max_range > self.min_range and math.isfinite(self.max_range)):
            raise ValueError(f"lidar.max_range={self.max_range} must be > lidar.min_range={self.min_range} and finite")
        if not (self.reference_range > 0.0 and math.isfinite(self.reference_range)):
            raise ValueError(f"lidar.reference_range={self.reference_range} must be positive and finite")
        if self.selection not in get_args(Strategy):
            known = ", ".join(get_args(Strategy))
            raise ValueError(f"lidar.selection={self.selection!r} must be one of {known}")
        _require_whole("lidar.motion_segments", self.motion_segments, 0)
        if not self.motion_jump > 0.0:
            raise ValueError(f"lidar.motion_jump={self.motion_jump} must be a positive distance in metres")
        object.__setattr__(self, "mount_pos", finite_tuple("lidar.mount_pos", self.mount_pos, 3))
        if self.mount_rpy is not None and self.mount_quat is not None:
            raise ValueError("lidar.mount_rpy and lidar.mount_quat are both given; set one of them to null")
        if self.mount_rpy is not None:
            object.__setattr__(self, "mount_rpy", finite_tuple("lidar.mount_rpy", self.mount_rpy, 3))
        if self.mount_quat is not None:
            quat = finite_tuple("lidar.mount_quat", self.mount_quat, 4)
            object.__setattr__(self, "mount_quat", quat)
            if abs(math.hypot(*quat) - 1.0) > 1e-3:
                raise ValueError(f"lidar.mount_quat={quat} must be a unit quaternion (w, x, y, z)")

    @property
    def quat(self) -> tuple[float, float, float, float]:
        """Sensor orientation in the mount body's frame, (w, x, y, z)."""
        return self.mount_quat or quat_from_rpy(*(self.mount_rpy or (0.0, 0.0, 0.0)))


class Lidar:
    """Casts one LiDAR per environment along its scan pattern.

    A surface nearer than ``min_range`` blocks the ray and returns nothing. A ray that starts inside a closed
    shape hits its exit surface, as in ``mj_ray``; give the shapes of the sensor's own housing in
    ``exclude_shapes``. A robot with several sensors has one ``Lidar`` for each on the same scene: they share the
    bodies' poses and nothing else, so each has its own mount, rate and outputs.

    Motion distortion, ``config.motion_segments = K > 0``: the segments of a frame lie between K + 1 evenly spaced
    moments, which are the end of the last frame, K - 1 moments at which the caller writes the scene's poses and calls
    ``record_poses``, and this frame's end, for which ``cast`` takes the scene's poses itself. With a frame of five
    control steps and K = 5, call it after each of the first four. Bodies that were put somewhere else, as by a reset,
    have not moved there: call ``reset``.

    Attributes:
        config, pattern, scene: As given.
        outputs: Names of the fields of ``frame`` that are computed.
        env_slices: Runs of environments that are cast at the same time.
        slice_frames: Of each of them, as many rows of ``frame``.
        frame: The frame that ``cast`` fills and returns; with several ``env_slices``, that of the slice cast last.
        features: What the scan's kernel was compiled for, see ``scan_kernel``.
        phase_rows: Rows by which each environment's device is ahead, (num_envs,) int64, from the seed.
        frame_count: Frames cast by each environment since it was given a seed, (num_envs,) int32; the noise and a
            stratified selection are functions of it, of the seed and, without a seed of its own, of the environment.
    """

    def __init__(
        self,
        config: LidarConfig,
        pattern: ScanPattern,
        scene: RayScene,
        mount_body: int,
        exclude_shapes: Sequence[int] = (),
        noise: Sequence[Noise] = (),
        seed: int = 0,
        outputs: Sequence[str] = ("ranges",),
        reflectivity: Mapping[int, float] | None = None,
        envs_at_once: int | None = None,
    ) -> None:
        """Sets up the sensor; casting allocates nothing more.

        Args:
            config: Mount, rate and limits.
            pattern: Where the device looks, as a function of time.
            scene: Shapes and poses that rays are cast at.
            mount_body: Body of the scene that carries the sensor; -1 for a sensor fixed in each environment.
            exclude_shapes: Indices of shapes that the rays pass through.
            noise: At most one model of each kind.
            seed: Of the device's phases and of the noise. Sensors with the same seed draw the same ones: give each
                sensor of a robot a seed of its own.
            outputs: What to compute, names from ``OUTPUTS``.
            reflectivity: Of each class of shapes, 0 to 1 for matt surfaces; 1 for classes not named. Read by
                the output ``intensity`` only.
            envs_at_once: Environments whose frames exist at the same time; None for all. With fewer, ``cast_slices``
                takes the place of ``cast``.
        """
        if isinstance(mount_body, str):
            raise ValueError(
                f"lidar.mount_body={mount_body!r} must be a body's index: of a MujocoScene, "
                f"scene.body_names.index({mount_body!r})"
            )
        if not -1 <= mount_body < scene.num_bodies:
            raise ValueError(
                f"lidar.mount_body={mount_body} must be in 0..{scene.num_bodies - 1}, or -1 (fixed sensor)"
            )
        self.config, self.pattern, self.scene = config, pattern, scene
        if envs_at_once is not None and envs_at_once < 1:
            raise ValueError(f"lidar.envs_at_once={envs_at_once} must be at least 1, or None for all")
        self.outputs = _known_outputs(outputs)
        self.env_slices = env_slices(scene.num_envs, envs_at_once or scene.num_envs)
        self._selection = make_selection(pattern, config.period_s, config.num_rays, config.selection, seed)
        generator = torch.Generator().manual_seed(seed)
        self.phase_rows = self._selection.draw_phases(scene.num_envs, generator).to(scene.device)
        self._first_row = torch.zeros(scene.num_envs, dtype=torch.int64, device=scene.device)
        self._scratch = torch.zeros(scene.num_envs, dtype=torch.float64, device=scene.device)
        self.frame_count = torch.zeros(scene.num_envs, dtype=torch.int32, device=scene.device)
        self._noise_seed = torch.full_like(self.frame_count, seed & _SEEDS)
        self._noise_stream = torch.arange(scene.num_envs, dtype=torch.int32, device=scene.device)
        self._noise = noise_by_name(noise)
        self.frame = self._allocate_frame()
        self.slice_frames = tuple(self._first_rows(envs.stop - envs.start) for envs in self.env_slices)
        self._track: PoseTrack | None = None
        self._rays = self._lay_out_rays()
        self._view, self._placed = self._place(mount_body, exclude_shapes)
        self._is_marched = self._marches_blocks(exclude_shapes)
        if self._is_marched:
            self._allocate_marched()
        num_viewed = len(scene.shapes) - len(set(exclude_shapes))
        self._casts = self._record_casts(reflectivity or {}, num_viewed)

    def cast(self, time_s: torch.Tensor | np.ndarray | float) -> LidarFrame:
        """Casts the frame that ends at ``time_s`` from the scene's poses and, with motion, those recorded before.

        Args:
            time_s: Each environment's time, s, finite, (num_envs,) float64, or one number for all of them.

        Returns:
            ``self.frame``, every element of it rewritten.
        """
        if len(self.env_slices) > 1:
            raise ValueError(
                f"this lidar's frames come in {len(self.env_slices)} slices; use cast_slices, or envs_at_once=None"
            )
        for _ in self.cast_slices(time_s):
            pass
        return self.frame

    def cast_slices(self, time_s: torch.Tensor | np.ndarray | float) -> Iterator[tuple[slice, LidarFrame]]:
        """``cast``, some environments after the others, so that the frames of all never exist at the same time.

        The iterator has to be run to its end; bodies stay where they are until then.

        Yields:
            Which environments, and their frame with as many rows. It lasts until the next slice.
        """
        if not isinstance(time_s, torch.Tensor):
            _check_finite(time_s)
            time_s = torch.as_tensor(time_s, dtype=torch.float64, device=self.scene.device)
            time_s = time_s.expand(self.scene.num_envs) if time_s.ndim == 0 else time_s
        if time_s.dtype != torch.float64 or time_s.shape != (self.scene.num_envs,):
            raise ValueError(
                f"time_s must be float64 ({self.scene.num_envs},), got {time_s.dtype} {tuple(time_s.shape)}"
            )
        if time_s.device.type == "cpu":  # the host would wait for a GPU
            _check_finite(time_s.numpy())
        self._seek(time_s)
        if self._track is not None:
            self._track.record_end()
        self._placed.refresh()
        for envs, cast, frame in zip(self.env_slices, self._casts, self.slice_frames, strict=True):
            cast()
            yield envs, frame
        self.frame_count.add_(1)

    def reset(self, env_ids: torch.Tensor | None = None, seeds: torch.Tensor | None = None) -> None:
        """Begins an episode in some environments, or in all: their bodies have been all along where they are next.

        Args:
            env_ids: Indices, (n,) int64; None for all, whose next frame may then be recorded from its start.
            seeds: (n,) int64, of the noise and of the device's phase from now on, whichever environment it is; None:
                both go on, so that no episode repeats another's noise.
        """
        for name, given in (("env_ids", env_ids), ("seeds", seeds)):
            if given is not None and (given.dtype != torch.int64 or given.ndim != 1):
                raise ValueError(f"{name} must be int64 (n,), got {given.dtype} {tuple(given.shape)}")
        count = self.scene.num_envs if env_ids is None else len(env_ids)
        if seeds is not None and len(seeds) != count:
            raise ValueError(f"seeds must be one for each of {count} environments, got {len(seeds)}")
        if self._track is not None:
            self._track.forget(env_ids)
        if seeds is not None and count:
            which = slice(None) if env_ids is None else env_ids
            self._noise_seed[which] = (seeds & _SEEDS).int().to(self._noise_seed.device)
            self._noise_stream[which] = 0
            self.frame_count[which] = 0
            generators = (torch.Generator().manual_seed(seed & _SEEDS) for seed in seeds.tolist())
            phases = torch.cat([self._selection.draw_phases(1, generator) for generator in generators])
            self.phase_rows[which] = phases.to(self.phase_rows.device)

    def record_poses(self) -> None:
        """Takes the scene's poses as those at the end of a segment within the frame, for all environments.

        Needed K - 1 times, evenly spaced, between two casts with ``motion_segments = K > 1``; may be called as well
        at the start of the very first frame.
        """
        if self._track is not None:
            self._track.record()

    def state_dict(self) -> dict:
        """State that the next frames depend on beside the scene's poses and the time."""
        track = None if self._track is None else self._track.state_dict()
        seeded = torch.stack((self._noise_seed.long(), self._noise_stream.long(), self.phase_rows))
        return {"frame_count": self.frame_count.clone(), "seeded": seeded, "track": track}

    def load_state_dict(self, state: dict) -> None:
        """Resumes where ``state_dict`` was taken.

        Raises:
            ValueError: It was taken of another number of environments.
        """
        if state["frame_count"].shape != self.frame_count.shape:
            raise ValueError(
                f"the state is of {len(state['frame_count'])} environments, this lidar has {self.scene.num_envs}"
            )
        self.frame_count.copy_(state["frame_count"])
        if "seeded" in state:  # of the processes of one training all but the first go on with streams of their own
            self._noise_seed.copy_(state["seeded"][0])
            self._noise_stream.copy_(state["seeded"][1])
            self.phase_rows.copy_(state["seeded"][2])
        if self._track is not None:
            self._track.load_state_dict(state["track"])

    def _seek(self, time_s: torch.Tensor) -> None:
        """Finds the rows of the frame that ends at ``time_s``."""
        self.pattern.first_rows(time_s, self.config.period_s, self.phase_rows, self._first_row, self._scratch)
        self._rows.seek(self._first_row)
        if self._variant is not None:
            self._selection.variants(self._first_row, self.frame_count, self._variant)
        if self._lag is not None:
            rate = self.pattern.points_per_second
            start = torch.sub(time_s, self.config.period_s, out=self._scratch).mul_(rate)
            lag = torch.sub(start, ROW_SLACK, out=self._lag_scratch).ceil_().sub_(start).clamp_(min=0.0)
            self._lag.copy_(lag.div_(rate))

    def _allocate_frame(self) -> LidarFrame:
        most = max(envs.stop - envs.start for envs in self.env_slices)
        shape, device = (most, self.config.num_rays), self.scene.device

        def tensor(name: str) -> torch.Tensor:
            if name == "valid":
                return torch.zeros(shape, dtype=torch.bool, device=device)
            if name in INTEGERS:
                return torch.zeros(shape, dtype=torch.int32, device=device)
            return torch.zeros(*shape, 3, device=device) if name in VECTORS else torch.zeros(shape, device=device)

        tensors = {name: tensor(name) for name in self.outputs}
        if not self._noise and {"ranges", "true_ranges"} <= self.outputs:
            tensors["true_ranges"] = tensors["ranges"]
        return LidarFrame(**tensors)

    def _first_rows(self, count: int) -> LidarFrame:
        """As many rows of ``frame``."""
        return LidarFrame(**{name: getattr(self.frame, name)[:count] for name in self.outputs})

    def _place(self, mount_body: int, exclude_shapes: Sequence[int]) -> tuple[SensorView, PlacedShapes | SweptShapes]:
        """Pose from which the sensor looks, and what places the shapes that it may see."""
        config, reach = self.config, self._reach()
        elevation = None
        if reach == 0.0:
            angles = torch.asin(self.pattern.directions_s[:, 2].double().clamp(-1.0, 1.0))
            margin = max_deviation(tuple(self._noise.values()))
            elevation = (float(angles.min()) - margin, float(angles.max()) + margin)
        view = SensorView(mount_body, config.mount_pos, config.quat, config.max_range, reach, elevation)
        if not config.motion_segments:
            return view, PlacedShapes(self.scene, exclude_shapes, view)
        self._track = PoseTrack(self.scene, config.motion_segments, config.motion_jump)
        return view, SweptShapes(self.scene, exclude_shapes, view, self._track)

    def _reach(self) -> float:
        """Distance from the sensor's origin at which its rays start, metres."""
        origins = self.pattern.origins_s
        return 0.0 if origins is None else float(torch.linalg.vector_norm(origins.double(), dim=1).max())

    def _marches_blocks(self, exclude_shapes: Sequence[int]) -> bool:
        """Tell whether a block's rays march through the height field at once: on a CPU, from one place, along rows."""
        scene = self.scene
        viewed = (shape for k, shape in enumerate(scene.shapes) if k not in exclude_shapes)
        return (
            scene.device.type == "cpu"
            and sum(shape.kind == ShapeKind.HEIGHTFIELD for shape in viewed) == 1
            and self._track is None
            and self._variant is None
            and self.pattern.origins_s is None
            and "jitter" not in self._noise
        )

    def _allocate_marched(self) -> None:
        slots, shape = self._placed.slots, (self.scene.num_envs, self.config.num_rays)
        slots.marched_t = wp.zeros(shape, wp.float32, device=self.scene.wp_device)
        slots.marched_face = wp.zeros(shape, wp.int32, device=self.scene.wp_device)
        slots.marched_uncertain = wp.zeros(shape, wp.bool, device=self.scene.wp_device)

    def _record_casts(self, reflectivity: Mapping[int, float], num_viewed: int) -> list[SplitLaunch]:
        """A launch for each slice."""
        config, scene, rays = self.config, self.scene, self._rays
        noise = noise_parameters(self._noise, config.min_range, config.max_range)
        noise.seed, noise.stream = wp.from_torch(self._noise_seed), wp.from_torch(self._noise_stream)
        written = self.outputs - ({"true_ranges"} if self.frame.true_ranges is self.frame.ranges else set())
        args = [
            rays,
            self._view.viewpoint,
            noise,
            scene.geometry,
            self._placed.slots,
            self._track.arrays if self._track is not None else Track(),
            self._labels(reflectivity),
        ]
        special = {
            "motion": self._track is not None,
            "origins": self.pattern.origins_s is not None,
            "offsets": self._variant is not None,
            "mesh": scene.has_mesh,
            "heightfield": scene.has_heightfield,
            "marched": self._is_marched,
        }
        self.features = frozenset({name for name, is_there in special.items() if is_there} | written | set(self._noise))
        kernel = scan_kernel(self.features)
        work = rays.block * (min(num_viewed, 64) + 4)

        def record(envs: slice) -> SplitLaunch:
            first, tasks = envs.start * rays.num_blocks, (envs.stop - envs.start) * rays.num_blocks
            given = [*args, self._output_arrays(written, envs.start)]
            return SplitLaunch(kernel, tasks, (), given, scene.device, scene.num_threads, work, first=first)

        return [record(envs) for envs in self.env_slices]

    def _stride(self) -> int:
        """The pattern's; warns if the last fifth of a frame, or more, is then not seen."""
        pattern, period_s, num_rays = self.pattern, self.config.period_s, self.config.num_rays
        stride, points = pattern.stride(period_s, num_rays), pattern.points_per_frame(period_s)
        if stride * num_rays < _COVERED * points:
            wider = next(k for k in itertools.count(stride + 1) if math.gcd(k, pattern.num_lasers) == 1)
            warnings.warn(
                f"lidar.num_rays={num_rays} keeps 1 in {stride} of the first {stride * num_rays / points:.0%} of each"
                f" frame's {points}; num_rays={points // wider} or selection=stratified see all of it",
                stacklevel=4,
            )
        return stride

    def _lay_out_rays(self) -> Rays:
        """Brings the pattern onto the device."""
        pattern, config, scene = self.pattern, self.config, self.scene
        every_kth = self._selection.strategy == "every_kth"
        angles = bool(self.outputs & {"elevation", "azimuth"})
        rays = Rays()
        rays.stride = self._stride() if every_kth else 1
        self._rows = ScanTable(pattern, rays.stride, scene.num_envs, angles, scene.device)
        rays.directions = wp.from_torch(self._rows.directions, dtype=wp.vec3)
        if self._rows.origins is not None:
            rays.origins = wp.from_torch(self._rows.origins, dtype=wp.vec3)
        if self._rows.angles is not None:
            rays.angles = wp.from_torch(self._rows.angles, dtype=wp.vec2)
        rays.cycle, rays.num_rows = self._rows.cycle, pattern.num_rows
        rays.start, rays.first_row = wp.from_torch(self._rows.start), wp.from_torch(self._first_row)
        self._variant: torch.Tensor | None = None
        if not every_kth:
            self._offsets = self._selection.offsets.to(scene.device).contiguous()
            self._variant = torch.zeros_like(self._first_row)
            rays.offsets, rays.variant = wp.from_torch(self._offsets), wp.from_torch(self._variant)
        self._lag: torch.Tensor | None = None
        if "time_s" in self.outputs or config.motion_segments:
            self._lag = torch.zeros(scene.num_envs, device=scene.device)
            self._lag_scratch = torch.zeros_like(self._scratch)
            rays.lag = wp.from_torch(self._lag)
        rays.seconds_per_row, rays.rows_per_shot = 1.0 / pattern.points_per_second, pattern.rows_per_shot
        rays.period, rays.count = config.period_s, config.num_rays
        rays.block = 1 if scene.device.type == "cuda" else min(RAYS_PER_TASK, config.num_rays)
        rays.num_blocks = -(-rays.count // rays.block)
        rays.min_range, rays.max_range = config.min_range, config.max_range
        return rays

    def _labels(self, reflectivity: Mapping[int, float]) -> Labels:
        labels, scene = Labels(), self.scene
        labels.frame = wp.from_torch(self.frame_count)
        if "intensity" in self.outputs:
            table = _reflectivity_table(reflectivity, [shape.class_id for shape in scene.shapes])
            scaled = [value * self.config.reference_range**2 for value in table]
            labels.reflectivity = wp.array(scaled, dtype=wp.float32, device=scene.wp_device)
        return labels

    def _output_arrays(self, written: set[str] | frozenset[str], first_env: int) -> ScanOutputs:
        arrays = ScanOutputs()
        arrays.first_env = first_env
        for name in written:
            tensor = getattr(self.frame, name)
            setattr(arrays, name, wp.from_torch(tensor, dtype=wp.vec3) if name in VECTORS else wp.from_torch(tensor))
        return arrays


def ray_bytes(outputs: Collection[str]) -> int:
    """Memory for one ray of a frame with these outputs, bytes."""
    return sum(1 if name == "valid" else 12 if name in VECTORS else 4 for name in outputs)


def env_slices(num_envs: int, most: int) -> tuple[slice, ...]:
    """Runs of environments, none longer than ``most`` and all of nearly one length."""
    count = -(-num_envs // most)
    edges = [num_envs * k // count for k in range(count + 1)]
    return tuple(slice(low, high) for low, high in itertools.pairwise(edges))


def _require_whole(name: str, value: object, least: int) -> None:
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise ValueError(f"{name}={value!r} must be a whole number >= {least}")


def _check_finite(time_s: np.ndarray | float) -> None:
    wrong = np.asarray(time_s)[~np.isfinite(time_s)]
    if wrong.size:
        raise ValueError(f"time_s={wrong.flat[0]} must be finite, in seconds")


def _known_outputs(outputs: Sequence[str]) -> frozenset[str]:
    unknown = sorted(set(outputs) - set(OUTPUTS))
    if unknown or not outputs:
        raise ValueError(f"lidar.outputs={unknown or list(outputs)} must be names out of {', '.join(OUTPUTS)}")
    return frozenset(outputs)


def _reflectivity_table(reflectivity: Mapping[int, float], class_ids: Sequence[int]) -> list[float]:
    """Reflectivity by class id, 1 where none is given."""
    for class_id, value in reflectivity.items():
        if class_id < 0 or not (value >= 0.0 and math.isfinite(value)):
            raise ValueError(
                f"lidar.reflectivity={{{class_id}: {value}}} must map class ids >= 0 to finite numbers >= 0"
            )
    return [float(reflectivity.get(k, 1.0)) for k in range(max((*class_ids, 0)) + 1)]
