"""Work and precision of the LiDAR: shapes, stale poses, rays, rates and motion within a frame."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch

from benchmarks.harness.pareto import Choice, Study
from benchmarks.harness.timing import paired_timings
from benchmarks.lidar.ours import obstacle_shapes
from omnilidar import Lidar, LidarFrame, RayScene, ScanPattern, SectorDistances, Shape, ShapeKind
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
        self.sizes, self.motion_segments = sizes, run.env.lidar.motion_segments
        self.sensor = replace(run.env.lidar, motion_segments=0)
        self.pattern: ScanPattern = run.env.lidar.scan_pattern()
        self.num_sectors = run.env.rewards.avoidance.num_sectors
        self.scene: MovingScene = moving_scene(run.env.obstacles, sizes.num_envs)
        self.truth = Truth(self.scene, self.sensor)
        self.times = [(k + 1) * self.sensor.period_s for k in range(sizes.num_frames)]

    def dense(self, step_deg: float) -> np.ndarray:
        """Directions over the sensor's field of view, (N, 3)."""
        elevation = self.pattern.elevation
        return dense_directions((float(elevation.min()), float(elevation.max())), step_deg)

    def true_sectors(self, times: Sequence[float], step_deg: float) -> np.ndarray:
        """By dense rays at each time, (T, E, num_sectors)."""
        rays = [self.dense(step_deg)] * self.scene.num_envs
        return np.stack([self.truth.sectors(t, rays, self.num_sectors, NEAR) for t in times])

    def costs(self, casts: Mapping[str, Callable[[int], object]]) -> dict[str, float]:
        """CPU time of a call, us per environment, timed in turn."""
        timings = paired_timings(casts, self.sizes.rounds, block_s=self.sizes.block_s)
        return {name: 1e6 * timing.least_cpu_s / self.scene.num_envs for name, timing in timings.items()}

    def reference(self) -> str:
        frames, envs = self.sizes.num_frames, self.scene.num_envs
        return f"Reference: mj_ray in float64 along the same rays; {frames} frames, {envs} environments."


class Caster:
    """The sensor in a ray scene of the moving scene, on one thread; body k is obstacle k, the last one the base.

    Obstacles are exact, or of about so many `triangles` each.
    """

    def __init__(self, bench: Bench, triangles: int = 0, outputs: Sequence[str] = OUTPUTS, **changes: object) -> None:
        self.bench, self.config = bench, replace(bench.sensor, **changes)
        scene, base = bench.scene, len(bench.scene.kinds)
        shapes = [Shape(ShapeKind.PLANE, class_id=GROUND), *obstacle_shapes(scene, triangles, class_id=OBSTACLE)]
        self.rays = RayScene(shapes, scene.num_envs, base + 1, num_threads=1)
        self.lidar = Lidar(self.config, bench.pattern, self.rays, mount_body=base, outputs=outputs)
        place = (self.rays.body_pos, self.rays.body_quat, base, self.config.mount_pos, self.config.quat)
        rays = (self.lidar.frame.true_ranges, self.lidar.frame.directions_s, self.lidar.frame.class_id)
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
        """The frame that ends at ``time_s``, with the poses of that time, or those at the ends of all its segments."""
        period, segments = self.config.period_s, self.config.motion_segments
        if segments:
            self.lidar.reset()
        for k in range(segments):
            self.rays.set_poses(*self.poses(time_s - period + k * period / segments))
            self.lidar.record_poses()
        self.rays.set_poses(*self.poses(time_s))
        return self.lidar.cast(time_s)

    def frame(self, number: int) -> LidarFrame:
        """The frame of a given number, again and again those of the bench."""
        return self.cast(self.bench.times[number % len(self.bench.times)])

    def sectors_at(self, times: Sequence[float]) -> np.ndarray:
        """Sector distances of the frames that end at these times, (T, E, num_sectors)."""
        return np.stack([(self.cast(time_s), self.sectors().numpy().copy())[1] for time_s in times])


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
        true.append([bench.truth.scan(time_s, env, d)[0] for env, d in enumerate(directions)])
        sectors.append(caster.sectors().numpy().copy())
        true_sectors.append(bench.truth.sectors(time_s, directions, bench.num_sectors, NEAR))
    errors = sector_errors(np.stack(sectors), np.stack(true_sectors))
    return range_errors(np.stack(found), np.array(true)) | {SECTOR: errors[SECTOR]}


def shapes_study(bench: Bench, triangles: Sequence[int] = (8, 32, 128, 512, 2048, 4096)) -> Study:
    """Exact shapes against tessellations."""
    casters = {"exact": Caster(bench)} | {f"{n} triangles": Caster(bench, n) for n in triangles}
    costs = bench.costs({name: caster.frame for name, caster in casters.items()})
    choices = [
        Choice(name, costs[name], frame_errors(bench, caster, caster.frame), name == "exact", name.split(" ")[-1])
        for name, caster in casters.items()
    ]
    note = "Corners of a tessellation lie on the true surface. Boxes have 12 triangles, which are exact."
    return Study("shapes", "Exact shapes against triangles", COST, RANGE, choices, 1e-6, (note, bench.reference()))


def staleness_study(bench: Bench, every: Sequence[int] = (1, 2, 5, 10)) -> Study:
    """Poses brought up to date in every n-th frame only."""
    period, num_frames, caster = bench.sensor.period_s, 10, Caster(bench)
    times = [(k + 1) * period for k in range(num_frames)]

    def cast(n: int, k: int) -> LidarFrame:
        time_s = times[k % num_frames]
        return caster.lidar.cast(time_s) if k % num_frames % n else caster.cast(time_s)

    casts = {f"every {n}": partial(cast, n) for n in every}
    costs = bench.costs(casts)
    choices = [
        Choice(name, costs[name], frame_errors(bench, caster, cast, times), name == "every 1")
        for name, cast in casts.items()
    ]
    note = f"Frames of {period:g} s; the robot walks at 0.8 m/s. The cost includes copying the poses."
    return Study("poses", "Poses updated in every n-th frame", COST, SECTOR, choices, 1e-6, (note, bench.reference()))


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
            casters[f"{count} {strategy}"] = Caster(bench, num_rays=count, selection=strategy)
    costs = bench.costs({name: caster.frame for name, caster in casters.items()})
    true, choices = bench.true_sectors(bench.times, bench.sizes.dense_deg), []
    for name, caster in casters.items():
        errors, config = sector_errors(caster.sectors_at(bench.times), true), caster.config
        default = (config.num_rays, config.selection) == (bench.sensor.num_rays, bench.sensor.selection)
        choices.append(Choice(name, costs[name], errors, default, config.selection, {"rays": config.num_rays}))
    note = (
        f"Reference: {len(bench.dense(bench.sizes.dense_deg)):,} rays {bench.sizes.dense_deg:g} degrees apart over the"
        " field of view, mj_ray in float64. One frame; a later one fills gaps."
    )
    return Study("rays", "Rays kept of a frame, and which", COST, SECTOR, choices, 1e-4, (note,))


def rates_study(
    bench: Bench, periods_s: Sequence[float] = (0.2, 0.1, 0.06, 0.04, 0.02), control_dt: float = 0.02
) -> Study:
    """Frames per second: what the newest frame says against what is there, at the control steps in between."""
    instants = [7 * k * control_dt for k in range(2, 2 + 5 * bench.sizes.num_frames)]  # every seventh: all ages occur
    apart = bench.sizes.dense_deg
    true, coarse = bench.true_sectors(instants, 2.0 * apart), bench.true_sectors(instants, 4.0 * apart)
    casters = {p: Caster(bench, period_s=p, motion_segments=0) for p in periods_s}
    costs = bench.costs({str(p): caster.frame for p, caster in casters.items()})
    choices = []
    for period, caster in casters.items():
        newest = [math.floor(now / period + 1e-6) * period for now in instants]
        errors = sector_errors(caster.sectors_at(newest), true)
        stale = bench.true_sectors(newest, 4.0 * apart) - coarse
        errors["staleness alone, RMSE (m)"] = math.sqrt(float(np.mean(stale**2)))
        default = math.isclose(period, bench.sensor.period_s)
        choices.append(Choice(f"{1.0 / period:.3g} Hz", costs[str(period)] / period, errors, default))
    notes = (
        f"{bench.sensor.num_rays} rays of every frame, whatever the rate. Reference: rays {2 * apart:g} degrees apart"
        f" at each of {len(instants)} control steps; staleness alone: the reference at the newest frame against the"
        " reference now.",
        "Obstacles and robot move; the newest frame serves until the next one.",
    )
    cost = "CPU time per second (us per environment)"
    return Study("rates", "Frames per second", cost, SECTOR, choices, 1e-4, notes)


def motion_study(bench: Bench, segments: Sequence[int] = (0, 1, 2, 5, 10)) -> Study:
    """Each point cast from the poses at its own time, against all from those at the frame's end."""
    casters = {n: Caster(bench, outputs=(*OUTPUTS, "time_s"), motion_segments=n) for n in segments}
    costs = bench.costs({str(n): caster.frame for n, caster in casters.items()})
    choices = []
    for n, caster in casters.items():
        found, true = [], []
        for time_s in bench.times[: max(1, bench.sizes.num_frames // 2)]:
            frame = caster.cast(time_s)
            emitted = time_s - caster.config.period_s + frame.time_s.double().numpy()
            found.append(frame.true_ranges.double().numpy())
            directions = frame.directions_s.numpy()
            true.append([bench.truth.distorted(emitted[e], e, directions[e]) for e in range(len(emitted))])
        name = f"{n} pieces" if n > 1 else ("1 piece" if n else "off")
        errors = range_errors(np.stack(found), np.array(true))
        choices.append(Choice(name, costs[str(n)], errors, n == bench.motion_segments))
    notes = (
        "Reference: every ray from the poses at its own moment, mj_ray in float64. The cost includes recording the"
        " poses at the ends of the pieces.",
    )
    return Study("motion", "Motion within a frame", COST, RANGE, choices, 1e-6, notes)


STUDIES: dict[str, Callable[[Bench], Study]] = {
    "shapes": shapes_study,
    "poses": staleness_study,
    "rays": rays_study,
    "rates": rates_study,
    "motion": motion_study,
}


def measure(run: RunConfig, sizes: Sizes, only: Sequence[str] = ()) -> Iterator[Study]:
    """All studies, or some by name, as they are done."""
    bench = Bench(run, sizes)
    yield from (study(bench) for name, study in STUDIES.items() if not only or name in only)
