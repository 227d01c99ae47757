"""Time and memory of a frame with and without each feature: what is not asked for costs nothing."""

from __future__ import annotations

from collections.abc import Sequence

from .compare import Options
from .memory import buffer_sizes
from .ours import Ours, feature_cases, mid360_scan
from .report import Table
from .scenes import obstacle_scene
from .timing import paired_timings

COLUMNS = (
    "feature",
    "ms per frame",
    "CPU ms per frame",
    "CPU time over the bare scan's",
    "bytes per environment",
)


def measure_features(options: Options, chosen: Sequence[str] | None = None) -> list[Table]:
    """The bare scan and every feature on top of it, one at a time, in turn; only the ``chosen`` ones if given."""
    scan = mid360_scan(options.num_envs, options.num_rays, seed=options.seed)
    scene = obstacle_scene(scan, options.num_bodies, options.num_frames, "smooth", options.seed)
    standing = obstacle_scene(scan, options.num_bodies, options.num_frames, "static", options.seed)
    empty = obstacle_scene(scan, 0, options.num_frames, "smooth", options.seed)
    cases = {"bare: ranges, obstacles and sensor moving": (scene, {})}
    cases["nothing moves"] = (standing, {})
    cases["no bodies, only the ground"] = (empty, {})
    known = feature_cases()
    cases |= {name: (scene, known[name]) for name in (known if chosen is None else chosen)}
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
        COLUMNS,
    )
    for name, timing in timings.items():
        held, _ = buffer_sizes(cases[name][0], **cases[name][1])
        times = (1e3 * timing.median_s, 1e3 * timing.median_cpu_s)
        table.rows.append((name, *times, timing.median_cpu_s / bare.median_cpu_s, held))
    table.notes = [f"medians of {options.rounds} rounds in turn; bytes that one more environment adds to all buffers"]
    return [table]
