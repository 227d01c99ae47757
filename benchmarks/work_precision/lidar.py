"""Work and precision of the LiDAR: shapes, updates, rays, rates, motion within a frame, and precision of the output."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
import torch

from benchmarks.harness.meshes import join, tessellate_to
from benchmarks.harness.pareto import Choice, Study
from benchmarks.harness.rotations import matrices
from benchmarks.harness.timing import paired_timings
from omnilidar import (
    Lidar,
    LidarConfig,
    LidarFrame,
    RayScene,
    ScanPattern,
    SectorDistances,
    Shape,
    ShapeKind,
    TriangleMesh,
)
from omniperception.build import RunConfig

from .scene import GROUND, OBSTACLE, MovingScene, Truth, dense_directions, moving_scene

COST = "CPU time per frame (us per environment)"
RANGE = "range RMSE (m)"
SECTOR = "sector distance RMSE (m)"
OUTPUTS = ("ranges", "true_ranges", "class_id", "directions_s", "elevation", "azimuth")
"""What the task reads of a frame when a network looks at it."""
NEAR = 4.0
"""Sector distances count up to here, metres, as in the networks' supervision."""
OVERLOOKED = (1.5, 0.3)
"""An obstacle nearer than the first (m) is overlooked in a sector if it seems more than the second (m) farther."""


@dataclass(frozen=True)
class Sizes:
    """How much is measured.

    Attributes:
        num_envs: Environments of a frame.
        num_frames: Frames over which errors are taken, and poses repeat for timing.
        rounds: How often each choice is timed, in turn.
        block_s: About how long at once, s.
        dense_deg: Spacing of the rays of the dense reference.
    """

    num_envs: int = 8
    num_frames: int = 4
    rounds: int = 9
    block_s: float = 0.1
    dense_deg: float = 0.5


SMALL = Sizes(num_envs=2, num_frames=2, rounds=2, block_s=0.005, dense_deg=2.0)


class Bench:
    """The moving scene of a configuration, its sensor and the truth about both."""

    def __init__(self, run: RunConfig, sizes: Sizes) -> None:
        self.sizes, self.sensor = sizes, run.env.lidar
        self.pattern: ScanPattern = run.env.lidar.scan_pattern()
        self.num_sectors = run.env.rewards.avoidance.num_sectors
        self.scene: MovingScene = moving_scene(run.env.obstacles, sizes.num_envs)
        self.truth = Truth(self.scene, self.sensor)
        self.times = [(k + 1) * self.sensor.period_s for k in range(sizes.num_frames)]

    @cached_property
    def dense(self) -> np.ndarray:
        """Directions of the dense reference, (N, 3)."""
        return self.dense_at(self.sizes.dense_deg)

    def dense_at(self, step_deg: float) -> np.ndarray:
        """Directions over the sensor's field of view, (N, 3)."""
        elevation = self.pattern.elevation
        return dense_directions((float(elevation.min()), float(elevation.max())), step_deg)

    def true_ranges(self, time_s: float, directions_s: np.ndarray) -> np.ndarray:
        """Of rays (E, N, 3) in the sensors' frames, (E, N)."""
        return np.stack([self.truth.scan(time_s, env, d)[0] for env, d in enumerate(directions_s)])

    def true_sectors(self, time_s: float, step_deg: float | None = None) -> np.ndarray:
        """By the dense reference, (E, num_sectors)."""
        directions = self.dense if step_deg is None else self.dense_at(step_deg)
        return self.truth.sectors(time_s, [directions] * self.scene.num_envs, self.num_sectors, NEAR)

    def costs(self, casts: Mapping[str, Callable[[int], None]]) -> dict[str, float]:
        """CPU time of a call, us per environment, timed in turn."""
        timings = paired_timings(casts, self.sizes.rounds, block_s=self.sizes.block_s)
        return {name: 1e6 * timing.least_cpu_s / self.scene.num_envs for name, timing in timings.items()}


class Caster:
    """The sensor in a ray scene of the moving scene, on one thread; body k is obstacle k, the last one the base."""

    def __init__(
        self, bench: Bench, config: LidarConfig | None = None, triangles: int = 0, outputs: Sequence[str] = OUTPUTS
    ) -> None:
        self.bench, self.config = bench, config or bench.sensor
        scene = bench.scene
        self.rays = RayScene(ray_shapes(scene, triangles), scene.num_envs, len(scene.kinds) + 1, num_threads=1)
        self.lidar = Lidar(self.config, bench.pattern, self.rays, mount_body=len(scene.kinds), outputs=outputs)
        frame, base = self.lidar.frame, len(scene.kinds)
        place = (self.rays.body_pos, self.rays.body_quat, base, self.config.mount_pos, self.config.quat)
        rays = (frame.true_ranges, frame.directions_s, frame.class_id)
        self.sectors = SectorDistances(*rays, *place, OBSTACLE, NEAR, bench.num_sectors, num_threads=1)
        self._poses: dict[float, tuple[torch.Tensor, torch.Tensor]] = {}

    def poses(self, time_s: float) -> tuple[torch.Tensor, torch.Tensor]:
        """Positions and quaternions of all bodies, worked out once."""
        key = round(time_s, 9)
        if key not in self._poses:
            obstacles, base = self.bench.scene.obstacles(time_s), self.bench.scene.base(time_s)
            both = (np.concatenate([o, b[:, None]], axis=1) for o, b in zip(obstacles, base, strict=True))
            self._poses[key] = tuple(torch.from_numpy(part).float() for part in both)
        return self._poses[key]

    def cast(self, time_s: float) -> LidarFrame:
        """The frame that ends at ``time_s``, with the poses of that time."""
        self.rays.set_poses(*self.poses(time_s))
        return self.lidar.cast(time_s)

    def distorted(self, time_s: float) -> LidarFrame:
        """The frame that ends at ``time_s``, with the poses at the ends of all its segments."""
        period, segments = self.config.period_s, self.config.motion_segments
        self.lidar.reset()
        for k in range(segments):
            self.rays.set_poses(*self.poses(time_s - period + k * period / segments))
            self.lidar.record_poses()
        return self.cast(time_s)

    def frame(self, number: int) -> LidarFrame:
        """The frame of a given number, again and again those of the bench."""
        return self.cast(self.bench.times[number % len(self.bench.times)])


def ray_shapes(scene: MovingScene, triangles: int = 0) -> list[Shape]:
    """The ground and the obstacles: exact, or of about so many triangles each."""
    obstacles = []
    for k, (kind, size) in enumerate(zip(scene.kinds, scene.sizes, strict=True)):
        if triangles:
            mesh = TriangleMesh(*tessellate_to(kind, size, triangles))
            obstacles.append(Shape(ShapeKind.MESH, asset=mesh, body=k, class_id=OBSTACLE))
        else:
            sizes = tuple(size[size > 0.0])
            obstacles.append(Shape(ShapeKind[kind.upper()], sizes, body=k, class_id=OBSTACLE))
    return [Shape(ShapeKind.PLANE, class_id=GROUND), *obstacles]


def range_errors(ranges: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    """RMSE and 99th percentile over rays that hit in both, and the share that hits in one only."""
    hit, true_hit = np.isfinite(ranges), np.isfinite(truth)
    error = np.abs(ranges[hit & true_hit] - truth[hit & true_hit])
    return {
        RANGE: math.sqrt(float(np.mean(error**2))),
        "range 99 % (m)": float(np.quantile(error, 0.99)),
        "wrong hit or miss (%)": 100.0 * float(np.mean(hit != true_hit)),
    }


def sector_errors(distances: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    """RMSE and 99th percentile of all sectors, and the share of those with something near that overlook it."""
    error = np.abs(distances - truth)
    near = truth < OVERLOOKED[0]
    overlooked = (distances > truth + OVERLOOKED[1])[near]
    return {
        SECTOR: math.sqrt(float(np.mean(error**2))),
        "sector 99 % (m)": float(np.quantile(error, 0.99)),
        "near sectors overlooked (%)": 100.0 * float(np.mean(overlooked)) if near.any() else 0.0,
    }


def frame_errors(
    bench: Bench, caster: Caster, cast: Callable[[int], LidarFrame], times: Sequence[float] = ()
) -> dict[str, float]:
    """Of ranges and sector distances against the truth along the very rays that were cast in each of the frames."""
    found, true, sectors, true_sectors = [], [], [], []
    for k, time_s in enumerate(times or bench.times):
        frame = cast(k)
        directions = frame.directions_s.numpy()
        found.append(frame.true_ranges.double().numpy())
        true.append(bench.true_ranges(time_s, directions))
        sectors.append(caster.sectors().numpy().copy())
        true_sectors.append(bench.truth.sectors(time_s, directions, bench.num_sectors, NEAR))
    errors = sector_errors(np.stack(sectors), np.stack(true_sectors))
    return range_errors(np.stack(found), np.stack(true)) | {SECTOR: errors[SECTOR]}


def shapes_study(bench: Bench, triangles: Sequence[int] = (8, 32, 128, 512, 2048, 4096)) -> Study:
    """Exact shapes against tessellations."""
    casters = {"exact": Caster(bench)} | {f"{n} triangles": Caster(bench, triangles=n) for n in triangles}
    costs = bench.costs({name: caster.frame for name, caster in casters.items()})
    choices = [
        Choice(name, costs[name], frame_errors(bench, caster, caster.frame), name == "exact", name.split(" ")[-1])
        for name, caster in casters.items()
    ]
    note = "Corners of a tessellation lie on the true surface. Boxes have 12 triangles, which are exact."
    return Study("shapes", "Exact shapes against triangles", COST, RANGE, choices, 1e-6, (note, _reference(bench)))


def updates_study(bench: Bench, triangles: int = 128) -> Study:
    """Bodies that move as instances with a pose, against one mesh that is refitted, against trees that are rebuilt."""
    methods = {"exact shapes": Instances(bench, 0), "instances": Instances(bench, triangles)}
    methods |= {"refit": Refitted(bench, triangles), "rebuild": Rebuilt(bench, triangles)}
    rays = [_general_rays(bench, time_s) for time_s in bench.times]

    def cast(method: Instances | Refitted | Rebuilt, frame: int) -> torch.Tensor:
        k = frame % len(bench.times)
        return method(bench.times[k], *rays[k])

    costs = bench.costs({name: lambda frame, m=method: cast(m, frame) for name, method in methods.items()})
    directions = _scan_directions(bench)
    choices = []
    for name, method in methods.items():
        pairs = [
            (cast(method, k).double().numpy(), bench.true_ranges(time_s, directions[k]))
            for k, time_s in enumerate(bench.times)
        ]
        errors = range_errors(*(np.stack(column) for column in zip(*pairs, strict=True)))
        choices.append(Choice(name, costs[name], errors, name == "exact shapes"))
    notes = (
        f"{triangles} triangles per body; poses or vertices are new in every frame and their making is counted;"
        " `refit` and `rebuild` have one mesh per environment. All cast the same general rays.",
        _reference(bench),
    )
    return Study("updates", "How moving bodies are brought up to date", COST, RANGE, choices, 1e-6, notes)


def staleness_study(bench: Bench, every: Sequence[int] = (1, 2, 5, 10)) -> Study:
    """Poses brought up to date in every n-th frame only."""
    period, num_frames, caster = bench.sensor.period_s, 10, Caster(bench)
    times = [(k + 1) * period for k in range(num_frames)]

    def cast(n: int, k: int) -> LidarFrame:
        time_s = times[k % num_frames]
        return caster.lidar.cast(time_s) if k % num_frames % n else caster.cast(time_s)

    costs = bench.costs({f"every {n}": partial(cast, n) for n in every})
    choices = [
        Choice(f"every {n}", costs[f"every {n}"], frame_errors(bench, caster, partial(cast, n), times), n == 1)
        for n in every
    ]
    note = f"Frames of {period:g} s; the robot walks at 0.8 m/s. The cost includes copying the poses."
    return Study("poses", "Poses updated in every n-th frame", COST, SECTOR, choices, 1e-6, (note, _reference(bench)))


def rays_study(
    bench: Bench,
    counts: Sequence[int] = (100, 200, 500, 1000, 2000, 5000, 20_000),
    strategies: Sequence[str] = ("every_kth", "stratified"),
) -> Study:
    """How many rays are kept, and which."""
    points = bench.pattern.points_per_frame(bench.sensor.period_s)
    casters = {}
    for count in sorted({min(count, points) for count in (*counts, bench.sensor.num_rays)}):
        for strategy in strategies[:1] if count == points else strategies:
            config = replace(bench.sensor, num_rays=count, selection=strategy, motion_segments=0)
            casters[f"{count} {strategy}"] = Caster(bench, config)
    costs = bench.costs({name: caster.frame for name, caster in casters.items()})
    true = np.stack([bench.true_sectors(time_s) for time_s in bench.times])
    choices = []
    for name, caster in casters.items():
        sectors = []
        for time_s in bench.times:
            caster.cast(time_s)
            sectors.append(caster.sectors().numpy().copy())
        errors, config = sector_errors(np.stack(sectors), true), caster.config
        default = (config.num_rays, config.selection) == (bench.sensor.num_rays, bench.sensor.selection)
        choices.append(Choice(name, costs[name], errors, default, config.selection, {"rays": config.num_rays}))
    note = (
        f"Reference: {len(bench.dense):,} rays {bench.sizes.dense_deg:g} degrees apart over the field of view, mj_ray"
        " in float64. One frame; a later one fills gaps."
    )
    return Study("rays", "Rays kept of a frame, and which", COST, SECTOR, choices, 1e-4, (note,))


def rates_study(
    bench: Bench, periods_s: Sequence[float] = (0.2, 0.1, 0.06, 0.04, 0.02), control_dt: float = 0.02
) -> Study:
    """Frames per second: what the newest frame says against what is there, at the control steps in between."""
    instants = [7 * k * control_dt for k in range(2, 2 + 5 * bench.sizes.num_frames)]  # every seventh: all ages occur
    true = np.stack([bench.true_sectors(t, 2.0 * bench.sizes.dense_deg) for t in instants])
    coarse: dict[float, np.ndarray] = {}

    def still_true(time_s: float) -> np.ndarray:
        key = round(time_s, 9)
        if key not in coarse:
            coarse[key] = bench.true_sectors(time_s, 4.0 * bench.sizes.dense_deg)
        return coarse[key]

    casters = {p: Caster(bench, replace(bench.sensor, period_s=p, motion_segments=0)) for p in periods_s}
    costs = bench.costs({str(p): caster.frame for p, caster in casters.items()})
    choices = []
    for period, caster in casters.items():
        sectors, stale = [], []
        for now in instants:
            newest = math.floor(now / period + 1e-6) * period
            caster.cast(newest)
            sectors.append(caster.sectors().numpy().copy())
            stale.append(still_true(newest) - still_true(now))
        errors = sector_errors(np.stack(sectors), true)
        errors["staleness alone, RMSE (m)"] = math.sqrt(float(np.mean(np.stack(stale) ** 2)))
        name = f"{1.0 / period:.3g} Hz"
        default = math.isclose(period, bench.sensor.period_s)
        choices.append(Choice(name, costs[str(period)] / period, errors, default))
    notes = (
        f"{bench.sensor.num_rays} rays of every frame, whatever the rate. Reference: rays {2 * bench.sizes.dense_deg:g}"
        f" degrees apart at each of {len(instants)} control steps; staleness alone: the reference at the newest frame"
        " against the reference now.",
        "Obstacles and robot move; the newest frame serves until the next one.",
    )
    cost = "CPU time per second (us per environment)"
    return Study("rates", "Frames per second", cost, SECTOR, choices, 1e-4, notes)


def motion_study(bench: Bench, segments: Sequence[int] = (0, 1, 2, 5, 10)) -> Study:
    """Each point cast from the poses at its own time, against all from those at the frame's end."""
    casters = {
        n: Caster(bench, replace(bench.sensor, motion_segments=n), outputs=(*OUTPUTS, "time_s")) for n in segments
    }
    cast = {n: caster.distorted if n else caster.cast for n, caster in casters.items()}
    times = bench.times
    costs = bench.costs({str(n): lambda k, n=n: cast[n](times[k % len(times)]) for n in casters})
    choices = []
    for n, caster in casters.items():
        found, true = [], []
        for time_s in bench.times[: max(1, bench.sizes.num_frames // 2)]:
            frame = cast[n](time_s)
            emitted = time_s - caster.config.period_s + frame.time_s.double().numpy()
            found.append(frame.true_ranges.double().numpy())
            directions = frame.directions_s.numpy()
            true.append([bench.truth.distorted(emitted[e], e, directions[e]) for e in range(len(emitted))])
        name = f"{n} pieces" if n > 1 else ("1 piece" if n else "off")
        errors = range_errors(np.stack(found), np.array(true))
        choices.append(Choice(name, costs[str(n)], errors, n == bench.sensor.motion_segments))
    notes = (
        "Reference: every ray from the poses at its own moment, mj_ray in float64. The cost includes recording the"
        " poses at the ends of the pieces.",
    )
    return Study("motion", "Motion within a frame", COST, RANGE, choices, 1e-6, notes)


def precision_study(bench: Bench) -> Study:
    """Ranges kept in float32 against a copy in half precision."""
    caster = Caster(bench)
    half = torch.empty_like(caster.lidar.frame.ranges, dtype=torch.float16)
    costs = bench.costs({"float32": caster.frame, "float16": lambda k: half.copy_(caster.frame(k).ranges)})
    found, true = [], []
    for time_s in bench.times:
        frame = caster.cast(time_s)
        found.append(frame.true_ranges.clone())
        true.append(bench.true_ranges(time_s, frame.directions_s.numpy()))
    choices = []
    for name, dtype in (("float32", torch.float32), ("float16", torch.float16)):
        ranges = torch.stack(found).to(dtype)
        facts = {"bytes per environment": ranges.element_size() * caster.config.num_rays}
        errors = range_errors(ranges.double().numpy(), np.stack(true))
        choices.append(Choice(name, costs[name], errors, name == "float32", facts=facts))
    note = "float16 is a copy: the sensor itself writes float32 only. It halves what a stored frame takes."
    return Study("precision", "Precision of the ranges", COST, RANGE, choices, 1e-6, (note, _reference(bench)))


STUDIES: dict[str, Callable[[Bench], Study]] = {
    "shapes": shapes_study,
    "updates": updates_study,
    "poses": staleness_study,
    "rays": rays_study,
    "rates": rates_study,
    "motion": motion_study,
    "precision": precision_study,
}


def measure(run: RunConfig, sizes: Sizes, only: Sequence[str] = ()) -> Iterator[Study]:
    """All studies, or some by name, as they are done."""
    bench = Bench(run, sizes)
    yield from (study(bench) for name, study in STUDIES.items() if not only or name in only)


class Instances:
    """Bodies with a pose each: exact shapes, or rigid meshes."""

    def __init__(self, bench: Bench, triangles: int) -> None:
        self._scene, self._reach, num_bodies = bench.scene, bench.sensor.max_range, len(bench.scene.kinds)
        self._rays = RayScene(ray_shapes(bench.scene, triangles), bench.scene.num_envs, num_bodies, num_threads=1)

    def __call__(self, time_s: float, origins: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
        """Ranges (E, N), m."""
        self._rays.set_poses(*self._scene.obstacles(time_s))
        return self._rays.cast(origins, directions, self._reach).ranges


class Refitted:
    """All bodies of an environment as one mesh, whose vertices are moved and whose tree is refitted."""

    def __init__(self, bench: Bench, triangles: int) -> None:
        self._bodies, self._reach = Vertices(bench.scene, triangles), bench.sensor.max_range
        mesh = TriangleMesh(self._bodies.at(0.0)[0], self._bodies.faces)
        shapes = [Shape(ShapeKind.PLANE), Shape(ShapeKind.DEFORMABLE, asset=mesh)]
        self._rays = RayScene(shapes, bench.scene.num_envs, 0, num_threads=1)

    def __call__(self, time_s: float, origins: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
        """Ranges (E, N), m."""
        self._rays.update_vertices(1, torch.from_numpy(self._bodies.at(time_s)))
        return self._rays.cast(origins, directions, self._reach).ranges


class Rebuilt:
    """All bodies of an environment as one mesh, whose tree is rebuilt for every frame."""

    def __init__(self, bench: Bench, triangles: int) -> None:
        self._bodies, self._reach = Vertices(bench.scene, triangles), bench.sensor.max_range

    def __call__(self, time_s: float, origins: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
        """Ranges (E, N), m."""
        ranges = []
        for env, vertices in enumerate(self._bodies.at(time_s)):
            mesh = Shape(ShapeKind.MESH, asset=TriangleMesh(vertices, self._bodies.faces))
            rays = RayScene([Shape(ShapeKind.PLANE), mesh], 1, 0, num_threads=1)
            ranges.append(rays.cast(origins[env : env + 1], directions[env : env + 1], self._reach).ranges)
        return torch.cat(ranges)


class Vertices:
    """The triangles of all bodies of a scene and where their vertices are."""

    def __init__(self, scene: MovingScene, triangles: int) -> None:
        parts = [tessellate_to(kind, size, triangles) for kind, size in zip(scene.kinds, scene.sizes, strict=True)]
        self._scene, self._parts = scene, [vertices for vertices, _ in parts]
        self.faces = join(parts)[1]

    def at(self, time_s: float) -> np.ndarray:
        """(E, V, 3) float32, metres."""
        pos, quat = self._scene.obstacles(time_s)
        turn = matrices(quat)
        moved = [v @ turn[:, k].transpose(0, 2, 1) + pos[:, k, None] for k, v in enumerate(self._parts)]
        return np.concatenate(moved, axis=1).astype(np.float32)


def _scan_directions(bench: Bench) -> list[np.ndarray]:
    """The sensor's own rays of each frame, (E, N, 3) in its frame."""
    caster = Caster(bench)
    return [caster.cast(time_s).directions_s.numpy().copy() for time_s in bench.times]


def _general_rays(bench: Bench, time_s: float) -> tuple[torch.Tensor, torch.Tensor]:
    """The sensor's rays of a frame in the environments' frames: origins and directions, (E, N, 3) float32."""
    directions = Caster(bench).cast(time_s).directions_s.numpy().astype(np.float64)
    pos, turn = bench.scene.sensor(time_s, bench.sensor)
    turned = torch.from_numpy(np.einsum("eij,enj->eni", turn, directions)).float()
    return torch.from_numpy(pos).float()[:, None].expand_as(turned).contiguous(), turned


def _reference(bench: Bench) -> str:
    envs = bench.scene.num_envs
    return f"Reference: mj_ray in float64 along the same rays; {bench.sizes.num_frames} frames, {envs} environments."
