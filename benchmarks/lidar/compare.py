"""Every method on the same scene: speed in turn, error against float64, and the targets that ours has to reach."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from benchmarks.harness.table import Table
from benchmarks.harness.timing import Timing, paired_ratio, paired_timings

from .baselines import BASELINES, BATCH_RAY, EMBREE, MUJOCO_LIDAR, NEWTON, NOT_COMPARED, ONE_MESH, OPEN3D
from .methods import Checker, Entry, build_all
from .ours import OURS, OURS_NAME, TERRAIN_FORMS, Ours, buffer_sizes, feature_cases, mid360_scan, terrain_entries
from .scenes import MOTIONS, BenchmarkScene, obstacle_scene, terrain_scene

COLUMNS = (
    "method",
    "Mrays/s",
    "Mrays per CPU s",
    "ms per frame",
    "times slower than ours",
    "smallest",
    "largest",
    "median error",
    "99 % error",
    "largest error",
    "beyond 1e-3, %",
    "hit/miss wrong, %",
)
STATIC_BASELINES = (EMBREE, OPEN3D, ONE_MESH)
"""Baselines for a scene in which nothing moves: they look at triangles in a tree that is built once."""


@dataclass(frozen=True)
class Options:
    """How much is measured, and where.

    Attributes:
        num_envs, num_rays, num_bodies: size of the scene.
        num_frames: frames after which poses and rays repeat.
        rounds: how often each method is timed.
        num_samples: rays compared with the reference.
        num_threads: CPU threads of each method.
        device: "cpu" or "cuda:<index>".
        seed: seed of the scene.
    """

    num_envs: int = 256
    num_rays: int = 1000
    num_bodies: int = 40
    num_frames: int = 8
    rounds: int = 7
    num_samples: int = 20_000
    num_threads: int = 2
    device: str = "cpu"
    seed: int = 0


@dataclass(frozen=True)
class Target:
    """``ours`` shall be at least ``factor`` times as fast as the fastest of the methods whose names start so."""

    factor: float
    names: tuple[str, ...]
    ours: str = OURS_NAME

    def verdict(self, timings: Mapping[str, Timing]) -> str:
        """Whether it is met, from the rounds' ratios."""
        own, wanted = timings.get(self.ours), f"target: {self.ours} >= {self.factor:g}x {' / '.join(self.names)}"
        rivals = {name: paired_ratio(t, own) for name, t in timings.items() if own and name.startswith(self.names)}
        if not rivals:
            return f"{wanted}: not measured, does not run here"
        name, ratio = min(rivals.items(), key=lambda item: item[1].median)
        met = "MET" if ratio.median >= self.factor else "NOT MET"
        by_cpu = timings[name].median_cpu_s / own.median_cpu_s
        return f"{wanted}: {met}, {ratio.median:.2f}x {name} (rounds {ratio}; by CPU time {by_cpu:.2f}x)"


MOVING_TARGETS = (Target(3.0, (BATCH_RAY,)), Target(2.0, (MUJOCO_LIDAR, NEWTON)))
STATIC_TARGETS = (Target(0.8, (EMBREE,)),)
TERRAIN_TARGETS = tuple(Target(0.5, (EMBREE,), f"{OURS_NAME}, {form}") for form in TERRAIN_FORMS)


def compare_baselines(
    options: Options, motions: Sequence[str] = MOTIONS, baselines: Sequence[Entry] = BASELINES
) -> list[Table]:
    """One table per motion of the obstacles."""
    tables = []
    for motion in motions:
        scan = mid360_scan(options.num_envs, options.num_rays, seed=options.seed)
        scene = obstacle_scene(scan, options.num_bodies, options.num_frames, motion, options.seed)
        moving = motion != "static"
        rivals = [baseline for baseline in baselines if moving or baseline.name in STATIC_BASELINES]
        title = (
            f"{options.num_envs} environments, a plane and {options.num_bodies} obstacles ({motion}), "
            f"{options.num_rays} Mid-360 rays to {scene.max_range:g} m, {options.num_threads} threads, "
            f"{'pose update included' if moving else 'building of trees not counted'}"
        )
        targets = MOVING_TARGETS if moving else STATIC_TARGETS
        tables.append(compare(f"baselines_{motion}", title, scene, [OURS, *rivals], targets, options))
    return tables


def compare_terrain(options: Options, cells: int = 200, baselines: Sequence[Entry] = BASELINES) -> list[Table]:
    """Triangles of one terrain that all environments share."""
    scene = terrain_scene(mid360_scan(options.num_envs, options.num_rays, seed=options.seed), cells=cells)
    rivals = [baseline for baseline in baselines if baseline.name in STATIC_BASELINES]
    title = (
        f"a terrain of {2 * cells * cells:,} triangles, {options.num_envs} environments, {options.num_rays} Mid-360 "
        f"rays to {scene.max_range:g} m, {options.num_threads} threads, building of trees not counted"
    )
    return [compare("terrain", title, scene, [*terrain_entries(), *rivals], TERRAIN_TARGETS, options)]


def compare(
    name: str, title: str, scene: BenchmarkScene, entries: Sequence[Entry], targets: Sequence[Target], options: Options
) -> Table:
    """Times all methods of ``entries`` in turn; ratios and targets are those of the first one."""
    methods, skipped = build_all(entries, scene, options.num_threads, options.device)
    table = Table(name, title, COLUMNS)
    table.notes += [f"left out: {baseline}: {reason}" for baseline, reason in (skipped | NOT_COMPARED).items()]
    if not any(method.startswith(OURS_NAME) for method in methods):
        return table
    # Every ray of the reference is intersected with all triangles of a terrain: fewer rays, so that it takes seconds.
    num_samples = options.num_samples // 10 if scene.terrain else options.num_samples
    checker = Checker(1 % scene.num_frames, num_samples)
    found = {method: checker.errors(cast) for method, cast in methods.items()}
    timings = paired_timings({m: cast.cast for m, cast in methods.items()}, options.rounds, options.device)
    ours, rays = next(iter(timings.values())), scene.num_envs * scene.num_rays
    for method, timing in timings.items():
        ratio, e = paired_ratio(timing, ours), found[method]
        speed = (rays / timing.median_s / 1e6, rays / timing.median_cpu_s / 1e6, 1e3 * timing.median_s)
        ratios = (ratio.median, ratio.smallest, ratio.largest)
        table.rows.append((method, *speed, *ratios, e.median, e.p99, e.largest, e.gross, e.disagree))
    table.details = {"seconds per frame": {method: vars(timing) for method, timing in timings.items()}}
    table.notes += [
        f"medians of {options.rounds} rounds in which every method took its turn; ratios of one round each",
        f"relative errors against float64 over {next(iter(found.values())).num_rays:,} rays per method",
        *(target.verdict(timings) for target in targets),
    ]
    return table


def measure_features(options: Options, chosen: Sequence[str] | None = None) -> list[Table]:
    """Time and memory of the bare scan and of every feature on top of it, in turn; ``chosen``: some of them."""
    scan = mid360_scan(options.num_envs, options.num_rays, seed=options.seed)

    def scene(num_bodies: int, motion: str) -> BenchmarkScene:
        return obstacle_scene(scan, num_bodies, options.num_frames, motion, options.seed)

    moving, known = scene(options.num_bodies, "smooth"), feature_cases()
    cases = {"bare: ranges, obstacles and sensor moving": (moving, {})}
    cases["nothing moves"] = (scene(options.num_bodies, "static"), {})
    cases["no bodies, only the ground"] = (scene(0, "smooth"), {})
    cases |= {name: (moving, known[name]) for name in (known if chosen is None else chosen)}
    casts = {
        name: Ours(seen, options.num_threads, options.device, **features).cast
        for name, (seen, features) in cases.items()
    }
    timings = paired_timings(casts, options.rounds, options.device)
    bare = next(iter(timings.values()))
    table = Table(
        "features",
        f"{options.num_envs} environments, {options.num_bodies} obstacles, {options.num_rays} Mid-360 rays, "
        f"{options.num_threads} threads",
        ("feature", "ms per frame", "CPU ms per frame", "CPU time over the bare scan's", "bytes per environment"),
    )
    for name, timing in timings.items():
        per_env, _ = buffer_sizes(cases[name][0], **cases[name][1])
        times = (1e3 * timing.median_s, 1e3 * timing.median_cpu_s)
        table.rows.append((name, *times, timing.median_cpu_s / bare.median_cpu_s, per_env))
    table.notes = [f"medians of {options.rounds} rounds in turn; bytes that one more environment adds to all buffers"]
    return [table]
