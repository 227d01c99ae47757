"""The paper's own measurements repeated: its appendix case and its rendering-time table."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import replace

from benchmarks.harness.table import Table
from benchmarks.harness.timing import Timing, paired_timings

from .baselines import BASELINES, BATCH_RAY, MUJOCO_LIDAR
from .compare import Options
from .methods import Checker, build_all
from .ours import OURS, OURS_NAME, long_scan
from .scenes import obstacle_scene, spinning_scan

APPENDIX_GEOMS = 199
PAPER_HZ, PAPER_SHARE = 500.0, 60.0
"""The appendix: 'fewer than 200 geoms', 115,200 rays, 500 Hz and more, preparation more than 60 % of the time."""

ENVIRONMENTS = (256, 512, 1024, 2048, 4096)
PAPER_MS = {
    1_000: (2.5, 2.1, 2.2, 3.4, 3.3),
    4_000: (3.3, 5.7, 16.2, 49.9, 117.9),
    16_000: (3.7, 11.2, 30.4, 118.3, 220.0),
    32_000: (5.8, 22.9, 47.9, 133.5, 273.0),
}
"""Table 'Rendering time (ms) for static scenes': the paper's toolkit, rays by environments."""
ISAAC_SIM_MS = {
    1_000: (21.0, 19.0, 32.0, 40.0, 95.0),
    4_000: (28.0, 39.0, 81.0, 146.0, 308.0),
    16_000: (81.0, 142.0, 317.0, 600.0, math.nan),
    32_000: (148.0, 286.0, 569.0, 1133.0, math.nan),
}
"""The same table: Isaac Sim; out of memory where there is no number."""
CPU_RAYS = 8_400_000
"""Casts of more rays than this are left out on a CPU."""


def measure_appendix(options: Options, scale: float = 1.0, rivals: Sequence[str] = (BATCH_RAY, MUJOCO_LIDAR)) -> Table:
    """One environment with 199 moving geoms and the 64 x 1800 rays of a spinning sensor.

    Preparation is everything that does not depend on the number of rays, poses in and placement: the time of a frame
    with one ray.
    """
    columns, bodies = round(1800 * scale), round((APPENDIX_GEOMS - 1) * scale)
    scan = spinning_scan(1, columns=columns)
    scene = obstacle_scene(scan, bodies, options.num_frames, seed=options.seed, mount_rpy=(0.0, 0.0, 0.0))
    lone = replace(scene, scan=replace(scan, num_rays=1, stride=scan.num_rays))
    entries = [OURS, *(baseline for baseline in BASELINES if baseline.name.startswith(tuple(rivals)))]
    whole, skipped = build_all(entries, scene, options.num_threads, options.device)
    single, _ = build_all(entries, lone, options.num_threads, options.device)
    casts = {name: method.cast for name, method in whole.items()}
    casts |= {f"1 {name}": single[name].cast for name in whole}
    checker = Checker(1 % scene.num_frames, options.num_samples)
    found = {name: checker.errors(method) for name, method in whole.items()}
    timings = paired_timings(casts, options.rounds, options.device)
    table = Table(
        "paper_appendix",
        f"1 environment, {bodies + 1} geoms moving every frame, {scan.num_rays:,} rays, {options.num_threads} threads",
        (
            "method",
            "Hz",
            "ms per frame",
            "ms of preparation",
            "preparation, %",
            "99 % error",
            "largest error",
            "hit/miss wrong, %",
        ),
    )
    for name in whole:
        frame, preparation = 1e3 * timings[name].median_s, 1e3 * timings[f"1 {name}"].median_s
        speed = (1e3 / frame, frame, preparation, 100.0 * preparation / frame)
        table.rows.append((name, *speed, found[name].p99, found[name].largest, found[name].disagree))
    theirs = (PAPER_HZ, 1e3 / PAPER_HZ, math.nan, PAPER_SHARE)
    table.rows.append(("the paper's, on its machines", *theirs, math.nan, math.nan, math.nan))
    table.notes = [f"left out: {name}: {reason}" for name, reason in skipped.items()] + [
        f"medians of {options.rounds} rounds; preparation: the time of a frame with one ray; a baseline that spreads "
        "environments over threads has one thread here",
        "the paper states 500 Hz and more, and more than 60 % preparation",
    ]
    return table


def measure_table(options: Options, max_rays: float | None = None, rivals: Sequence[str] = ()) -> Table:
    """The paper's rendering times beside ours, for a plane and 40 obstacles that stand still.

    Args:
        options: Threads, device, rounds.
        max_rays: Casts of more rays are left out; None for all on a GPU and ``CPU_RAYS`` on a CPU.
        rivals: Names of baselines that get a column of their own.
    """
    on_gpu = options.device.startswith("cuda")
    limit = max_rays or (math.inf if on_gpu else CPU_RAYS)
    table = Table(
        "paper_table",
        f"ms per frame of a static scene (a plane and {options.num_bodies} obstacles), on {options.device}",
        ("rays", "environments", "ours", "smallest", "largest", "paper", "Isaac Sim in the paper", "Mrays/s", *rivals),
    )
    for rays, theirs in PAPER_MS.items():
        for num_envs, paper_ms, isaac_ms in zip(ENVIRONMENTS, theirs, ISAAC_SIM_MS[rays], strict=True):
            if rays * num_envs <= limit:
                times = _table_times(rays, num_envs, options, rivals)
                ours = [1e3 * seconds for seconds in times[OURS_NAME].wall_s]
                middle = statistics.median(ours)
                beside = [1e3 * times[name].median_s if name in times else math.nan for name in rivals]
                speed = rays * num_envs / middle / 1e3
                row = (rays, num_envs, middle, min(ours), max(ours), paper_ms, isaac_ms, speed, *beside)
                table.rows.append(row)
    table.notes = [f"medians of {options.rounds} rounds; the paper does not describe its scene or name its GPU"]
    if not on_gpu:
        table.notes.append(
            f"no CUDA device: the GPU's table is left out; CPU, {options.num_threads} threads, up to {limit:,} rays"
        )
    return table


def _table_times(rays: int, num_envs: int, options: Options, rivals: Sequence[str]) -> dict[str, Timing]:
    scan = long_scan(num_envs, rays, options.seed)
    scene = obstacle_scene(scan, options.num_bodies, 1, "static", options.seed)
    entries = [OURS, *(replace(baseline, own_threads=True) for baseline in BASELINES if baseline.name in rivals)]
    methods, _ = build_all(entries, scene, options.num_threads, options.device)
    return paired_timings({name: method.cast for name, method in methods.items()}, options.rounds, options.device)
