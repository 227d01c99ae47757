"""Every method on the same scene: speed in turn, error against float64, and the bars that ours has to clear."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from .methods import Entry, build_all
from .ours import OURS, OURS_NAME, TERRAIN_FORMS, mid360_scan, terrain_entries
from .peers import BATCH_RAY, EMBREE, MUJOCO_LIDAR, NEWTON, NOT_COMPARED, ONE_MESH, OPEN3D, PEERS
from .reference import Checker, Errors
from .report import Table
from .scenes import MOTIONS, BenchmarkScene, obstacle_scene, terrain_scene
from .timing import Ratio, Timing, paired_ratio, paired_timings

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
BRIEF = ("method", "Mrays/s", "times slower than ours", "99 % error", "largest error", "hit/miss wrong, %")
STANDING = (EMBREE, OPEN3D, ONE_MESH)
"""Peers for a scene in which nothing moves: they look at triangles in a tree that is built once."""


@dataclass(frozen=True)
class Options:
    """How much is measured, and where.

    Attributes:
        num_envs, num_rays, num_bodies: Size of the scene.
        num_frames: Frames after which poses and rays repeat.
        rounds: How often each method is timed.
        num_samples: Rays compared with the reference.
        num_threads: CPU threads of each method.
        device: "cpu" or "cuda:<index>".
        seed: Seed of the scene.
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
class Bar:
    """``ours`` shall be at least ``factor`` times as fast as the fastest of the methods whose names start so."""

    factor: float
    names: tuple[str, ...]
    ours: str = OURS_NAME

    def verdict(self, timings: Mapping[str, Timing]) -> str:
        """Whether it is met, from the rounds' ratios."""
        own = timings.get(self.ours)
        rivals = {name: paired_ratio(t, own) for name, t in timings.items() if own and name.startswith(self.names)}
        if not rivals:
            return f"bar: {self.ours} >= {self.factor:g}x {' / '.join(self.names)}: not measured, does not run here"
        name, ratio = min(rivals.items(), key=lambda item: item[1].median)
        met = "MET" if ratio.median >= self.factor else "NOT MET"
        among = " the fastest of" if len(rivals) > 1 else ""
        by_cpu = timings[name].median_cpu_s / own.median_cpu_s
        return (
            f"bar: {self.ours} >= {self.factor:g}x{among} {' / '.join(self.names)}: {met}, {ratio.median:.2f}x {name} "
            f"(rounds {ratio.smallest:.2f} to {ratio.largest:.2f}; by CPU time {by_cpu:.2f}x)"
        )


MOVING_BARS = (Bar(3.0, (BATCH_RAY,)), Bar(2.0, (MUJOCO_LIDAR, NEWTON)))
STANDING_BARS = (Bar(0.8, (EMBREE,)),)
TERRAIN_BARS = tuple(Bar(0.5, (EMBREE,), f"{OURS_NAME}, {form}") for form in TERRAIN_FORMS)


def compare_peers(options: Options, motions: Sequence[str] = MOTIONS, peers: Sequence[Entry] = PEERS) -> list[Table]:
    """One table per motion of the obstacles."""
    tables = []
    for motion in motions:
        scan = mid360_scan(options.num_envs, options.num_rays, seed=options.seed)
        scene = obstacle_scene(scan, options.num_bodies, options.num_frames, motion, options.seed)
        moving = motion != "static"
        rivals = [peer for peer in peers if moving or peer.name in STANDING]
        title = (
            f"{options.num_envs} environments, a plane and {options.num_bodies} obstacles ({motion}), "
            f"{options.num_rays} Mid-360 rays to {scene.max_range:g} m, {options.num_threads} threads, "
            f"{'pose update included' if moving else 'building of trees not counted'}"
        )
        bars = MOVING_BARS if moving else STANDING_BARS
        tables.append(compare(f"peers_{motion}", title, scene, [OURS, *rivals], bars, options))
    return tables


def compare_terrain(options: Options, cells: int = 200, peers: Sequence[Entry] = PEERS) -> list[Table]:
    """Triangles of one terrain that all environments share."""
    scene = terrain_scene(mid360_scan(options.num_envs, options.num_rays, seed=options.seed), cells=cells)
    rivals = [peer for peer in peers if peer.name in STANDING]
    title = (
        f"a terrain of {2 * cells * cells:,} triangles, {options.num_envs} environments, {options.num_rays} Mid-360 "
        f"rays to {scene.max_range:g} m, {options.num_threads} threads, building of trees not counted"
    )
    return [compare("terrain", title, scene, [*terrain_entries(), *rivals], TERRAIN_BARS, options)]


def compare(
    name: str, title: str, scene: BenchmarkScene, entries: Sequence[Entry], bars: Sequence[Bar], options: Options
) -> Table:
    """Times all methods of ``entries`` in turn; ratios and bars are those of the first one."""
    methods, skipped = build_all(entries, scene, options.num_threads, options.device)
    table = Table(name, title, COLUMNS, brief=BRIEF)
    table.notes += [f"left out: {peer}: {reason}" for peer, reason in (skipped | NOT_COMPARED).items()]
    if not any(method.startswith(OURS_NAME) for method in methods):
        return table
    # All triangles are met one by one by every ray of the reference: fewer rays, so that it takes seconds.
    num_samples = options.num_samples // 10 if scene.terrain else options.num_samples
    checker = Checker(1 % scene.num_frames, num_samples)
    found = {method: checker.errors(cast) for method, cast in methods.items()}
    casts = {method: cast.cast for method, cast in methods.items()}
    timings = paired_timings(casts, options.rounds, options.device)
    ours = next(iter(timings.values()))
    ratios = {method: paired_ratio(timing, ours) for method, timing in timings.items()}
    rays = scene.num_envs * scene.num_rays
    for method, timing in timings.items():
        speed = (rays / timing.median_s / 1e6, rays / timing.median_cpu_s / 1e6, 1e3 * timing.median_s)
        table.rows.append((method, *speed, *_ratio(ratios[method]), *_errors(found[method])))
    table.details = {"seconds per frame": {method: vars(timing) for method, timing in timings.items()}}
    table.notes += [
        f"medians of {options.rounds} rounds in which every method took its turn; ratios of one round each",
        f"relative errors against float64 over {next(iter(found.values())).num_rays:,} rays per method",
        *(bar.verdict(timings) for bar in bars),
    ]
    return table


def _ratio(ratio: Ratio) -> tuple[float, ...]:
    return ratio.median, ratio.smallest, ratio.largest


def _errors(found: Errors) -> tuple[float, ...]:
    return found.median, found.p99, found.largest, found.gross, found.disagree
