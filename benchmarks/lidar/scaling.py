"""What a frame costs as rays, environments, bodies and triangles grow, and how much memory an environment takes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.harness.table import Table
from benchmarks.harness.timing import paired_timings
from omnirobot.common.figures import new_figure

from .baselines import BASELINES, BATCH_RAY, EMBREE
from .compare import Options
from .methods import Entry, build_all
from .ours import OURS, OURS_NAME, buffer_sizes, long_scan, terrain_entries
from .scenes import BenchmarkScene, obstacle_scene, terrain_scene

COLUMNS = (
    "sweep",
    "value",
    "method",
    "ms per frame",
    "ns per ray",
    "CPU ns per ray",
    "bytes per environment",
    "shared bytes",
    "rounds",
)


@dataclass(frozen=True)
class Sweep:
    """One quantity that grows while the others stay.

    Attributes:
        name: Quantity and unit.
        values: Its values.
        scene: Scene for a value.
        fixed: What the other quantities are.
    """

    name: str
    values: Sequence[int]
    scene: Callable[[int], BenchmarkScene]
    fixed: str


def sweeps(quick: bool = False) -> list[Sweep]:
    """The sweeps of the report; a few small values of each if ``quick``."""
    sizes = {
        "rays": (100, 300) if quick else (100, 300, 1000, 3000, 10_000, 30_000, 100_000),
        "environments": (1, 3) if quick else (1, 4, 16, 64, 256, 1024, 4096),
        "bodies per environment": (0, 8) if quick else (0, 10, 20, 50, 100, 200, 500, 1000),
        "triangles": (50, 200) if quick else (1_000, 10_000, 100_000, 1_000_000),
    }
    envs, rays = (2, 100) if quick else (64, 1000)
    few = 2 if quick else 16
    return [
        Sweep("rays", sizes["rays"], lambda n: obstacle_scene(long_scan(few, n), num_frames=2), f"{few} environments"),
        Sweep(
            "environments",
            sizes["environments"],
            lambda n: obstacle_scene(long_scan(n, rays), num_frames=2),
            f"{rays} rays, 40 bodies",
        ),
        Sweep(
            "bodies per environment",
            sizes["bodies per environment"],
            lambda n: obstacle_scene(long_scan(envs, rays), num_bodies=n, num_frames=2),
            f"{envs} environments, {rays} rays, constant density",
        ),
        Sweep(
            "triangles",
            sizes["triangles"],
            lambda n: terrain_scene(long_scan(envs, rays), cells=_cells(n), cell=20.0 / _cells(n), num_frames=2),
            f"{envs} environments, {rays} rays, 20 m square",
        ),
    ]


def measure_scaling(options: Options, chosen: Sequence[Sweep], rivals: Sequence[str] = (BATCH_RAY, EMBREE)) -> Table:
    """Ours, and the named baselines where they can show the scene, at every value of every sweep."""
    table = Table("scaling", f"cost of a frame, {options.num_threads} threads", COLUMNS)
    baselines = [baseline for baseline in BASELINES if baseline.name in rivals]
    for sweep in chosen:
        for value in sweep.values:
            table.rows += _measure(sweep, value, baselines, options)
        table.notes += [f"{sweep.name}: {sweep.fixed}"]
    slope = growth(table, "bodies per environment", 100)
    if not math.isnan(slope):
        met = "MET" if slope < 1.0 else "NOT MET"
        table.notes.append(f"target: better than linear past 100 bodies: {met}, CPU time grows as bodies^{slope:.2f}")
    return table


def growth(table: Table, sweep: str, start: int, method: str = OURS_NAME) -> float:
    """Exponent with which the CPU time of a ray grows from ``start`` to the last value of a sweep."""
    times = {row[1]: row[5] for row in table.rows if row[0] == sweep and row[2] == method and row[1] >= start}
    if start not in times or len(times) < 2:
        return math.nan
    last = max(times)
    return math.log(times[last] / times[start]) / math.log(last / start)


def _measure(sweep: Sweep, value: int, baselines: Sequence[Entry], options: Options) -> list[tuple]:
    scene = sweep.scene(value)
    ours = [OURS] if scene.terrain is None else terrain_entries()
    methods, _ = build_all([*ours, *baselines], scene, options.num_threads, options.device)
    timings = paired_timings({name: method.cast for name, method in methods.items()}, options.rounds, options.device)
    per_ray = 1e9 / (scene.num_envs * scene.num_rays)
    rows = []
    for name, timing in timings.items():
        speed = (1e3 * timing.median_s, per_ray * timing.median_s, per_ray * timing.median_cpu_s)
        form = {"terrain": name.removeprefix(f"{OURS_NAME}, ")} if scene.terrain else {}
        memory = buffer_sizes(scene, **form) if name.startswith(OURS_NAME) else (None, None)
        rows.append((sweep.name, value, name, *speed, *memory, options.rounds))
    return rows


def plot_scaling(table: Table, chosen: Sequence[Sweep], file: Path, about: str) -> None:
    """CPU time per ray above, which other work on the machine disturbs least, and our memory below; by sweep."""
    samples = f"median of n = {table.rows[0][-1]} rounds"
    figure = new_figure(4.2 * len(chosen), 7.0)
    axes = figure.subplots(2, len(chosen), squeeze=False)
    for sweep, (time_axis, memory_axis) in zip(chosen, axes.T, strict=True):
        for method in dict.fromkeys(row[2] for row in table.rows):
            rows = [row for row in table.rows if row[0] == sweep.name and row[2] == method]
            values = [max(row[1], 1) for row in rows]  # 0 has no place on a logarithmic axis
            if rows:
                time_axis.plot(values, [row[5] for row in rows], marker="o", markersize=3, label=method)
            if rows and rows[0][6] is not None:
                (line,) = memory_axis.plot(values, [row[6] for row in rows], marker="o", markersize=3, label=method)
                shared = [row[7] for row in rows]
                memory_axis.plot(values, shared, "--", color=line.get_color(), label=f"{method}, shared by all")
        time_axis.set(ylabel="CPU time per ray, ns", title=sweep.fixed)
        time_axis.title.set_fontsize(9)
        memory_axis.set_ylabel("memory per environment, bytes")
        for axis, title in ((time_axis, samples), (memory_axis, "n = 1, exact")):
            axis.set(xscale="log", yscale="log", xlabel=sweep.name)
            axis.grid(True, alpha=0.3)
            axis.legend(fontsize=7, title=title, title_fontsize=7)
    figure.text(0.01, 0.005, about, fontsize=6)
    figure.get_layout_engine().set(rect=(0.0, 0.02, 1.0, 0.98))
    figure.savefig(file, dpi=80)


def _cells(num_triangles: int) -> int:
    return max(1, round(math.sqrt(num_triangles / 2.0)))
