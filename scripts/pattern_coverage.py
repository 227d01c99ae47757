"""How well the closed-form Livox scans match the manufacturer's tables, and what each way of keeping fewer rays sees.

    python scripts/pattern_coverage.py [sensors=mid360,avia,...|all] [num_rays=1000] [period_s=0.1] [cell_deg=2]
                                       [strategies=true] [out=outputs/pattern_coverage.png]

Any name of a preset of a LiDAR will do; only Livox scanners have tables (extra `tables`), which are left out where
they are not installed. The picture (extra `plots`) shows each pattern after 0.1, 0.5 and 1 s.
"""

from __future__ import annotations

import sys
from pathlib import Path

from benchmarks.figures import PlotsUnavailable, new_figure
from benchmarks.pattern_coverage import DURATIONS_S, angle_to_table, compare, strategy_coverage
from omniperception import config
from omniperception.lidar import DEVICES, LIVOX, ScanPattern

ARGUMENTS = {
    "sensors": ",".join(LIVOX),
    "num_rays": "1000",
    "period_s": "0.1",
    "cell_deg": "2",
    "strategies": "true",
    "out": "outputs/pattern_coverage.png",
}
SLACK_ROWS = {"hap": 1000}
"""Sensors whose model fires in an order that drifts from the table's, and by how many rows at most."""


def load(name: str) -> tuple[ScanPattern, ScanPattern | None]:
    """A sensor's closed form, and its table where there is one."""
    if name not in LIVOX:
        return DEVICES[name].pattern(), None
    try:
        return LIVOX[name]("model"), LIVOX[name]("table")
    except ModuleNotFoundError as error:
        print(f"{name}: {error}")
        return LIVOX[name]("model"), None


def print_comparison(name: str, model: ScanPattern, table: ScanPattern, cell_deg: float) -> None:
    mean, largest = angle_to_table(model, table, SLACK_ROWS.get(name, 0))
    print(f"{name}: model against table, angle mean {mean:.4f} deg, largest {largest:.4f} deg")
    for row in compare(model, table, cell_deg=cell_deg):
        print(
            f"  {row.seconds:4.1f} s  overlap {row.overlap:7.2%}   field of view seen: model {row.seen_model:6.1%},"
            f" table {row.seen_table:6.1%}"
        )


def print_strategies(name: str, pattern: ScanPattern, num_rays: int, period_s: float, cell_deg: float) -> None:
    print(f"{name}: {num_rays} of {pattern.points_per_frame(period_s)} points every {period_s:g} s")
    for strategy, rows in strategy_coverage(pattern, period_s, num_rays, cell_deg=cell_deg).items():
        figures = "   ".join(f"{row.seconds:g} s: seen {row.seen:6.1%}, gap {row.gap_deg:5.2f} deg" for row in rows)
        print(f"  {strategy:<11} {figures}")


def draw(patterns: dict[str, tuple[ScanPattern, ScanPattern | None]], path: Path) -> None:
    """Azimuth and elevation of each pattern's points after each duration."""
    figure = new_figure(5.0 * len(DURATIONS_S), 3.2 * len(patterns))
    axes = figure.subplots(len(patterns), len(DURATIONS_S), squeeze=False)
    for (name, (model, table)), line in zip(patterns.items(), axes, strict=True):
        for seconds, axis in zip(DURATIONS_S, line, strict=True):
            for label, pattern, colour, size in (("table", table, "orange", 1.2), ("model", model, "navy", 0.15)):
                if pattern is not None:
                    count = pattern.points_per_frame(seconds)
                    rows = slice(0, min(count, pattern.num_rows), max(1, count // 60_000))
                    azimuth = (pattern.azimuth[rows].rad2deg() + 180.0) % 360.0 - 180.0
                    elevation = pattern.elevation[rows].rad2deg()
                    axis.scatter(azimuth, elevation, s=size, c=colour, linewidths=0, label=f"{label}, {count:,} points")
            axis.set(title=f"{name}, {seconds:g} s", xlabel="azimuth, deg", ylabel="elevation, deg")
            axis.legend(loc="lower right", fontsize=6, markerscale=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    print(f"picture: {path}")


def main() -> None:
    with config.one_line_errors(PlotsUnavailable, ValueError):
        own, unknown = config.split_arguments(sys.argv[1:], ARGUMENTS)
        names = list(DEVICES) if own["sensors"] == "all" else own["sensors"].split(",")
        for name in names:
            if name not in DEVICES:
                raise config.ConfigError(f"sensors={name} is not one of {', '.join(DEVICES)}")
        if unknown:
            raise config.ConfigError(f"{unknown[0]} is not one of {', '.join(f'{key}=' for key in ARGUMENTS)}")
        cell_deg = float(own["cell_deg"])
        patterns = {name: load(name) for name in names}
        for name, (model, table) in patterns.items():
            if table is not None:
                print_comparison(name, model, table, cell_deg)
            if own["strategies"] == "true":
                print_strategies(name, model, int(own["num_rays"]), float(own["period_s"]), cell_deg)
        if own["out"]:
            draw(patterns, Path(own["out"]))


if __name__ == "__main__":
    main()
