"""Robustness of a policy: every row of the randomization alone, over a multiple of its range."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import torch
from omegaconf import OmegaConf

from omniperception import config
from omniperception.common.tables import markdown
from omniperception.config import ConfigError
from omniperception.evaluation.report.gaits import Part
from omniperception.evaluation.report.records import Record
from omniperception.evaluation.report.tables import rate_cell
from omniperception.evaluation.suite import Evaluation, Task, measure_all
from omniperception.evaluation.trials.statistics import rate
from omnirobot.common.errors import check_known
from omnirobot.common.figures import new_figure, save_figure

NEUTRAL = {"ground_friction": 0.8, "motor_strength": 1.0, "velocity_scale": 1.0}
"""Values about which a range is stretched, where it is not 0: those of a robot and a ground without randomization."""
BOUNDS = {
    "ground_friction": (0.05, math.inf),
    "ground_restitution": (0.0, 1.0),
    "motor_strength": (0.0, math.inf),
    "velocity_scale": (0.0, math.inf),
    "frames_lost": (0.0, 0.99),
}
"""Values beyond which a range cannot be stretched."""
SIZES = {"pushes": "speed", "velocity_drift": "sd"}
"""The number that says how large a row with several settings is."""


def stretched(row: str, value: object, factor: float) -> str:
    """The override that gives a row a multiple of its range.

    Args:
        row: of `randomization`.
        value: its value in the preset: a range, a number, or a group of settings.
        factor: 1 keeps it; 0 leaves only the value about which it is stretched.

    Raises:
        ConfigError: the row has no size that could be stretched.
    """
    if isinstance(value, Mapping) and row in SIZES:
        size = SIZES[row]
        settings = ", ".join(f"{k}: {float(v) * factor if k == size else v}" for k, v in value.items())
        return f"randomization.{row}={{{settings}}}"
    least, most = BOUNDS.get(row, (-math.inf, math.inf))
    if isinstance(value, float | int) and not isinstance(value, bool):
        return f"randomization.{row}={min(value * factor, most):.6g}"
    if isinstance(value, Sequence) and not isinstance(value, str) and len(value) == 2:
        neutral = NEUTRAL.get(row, 0.0)
        ends = [min(max(neutral + factor * (end - neutral), least), most) for end in value]
        return f"randomization.{row}=[{ends[0]:.6g},{ends[1]:.6g}]"
    raise ConfigError(f"randomization.{row}={value} has no range to stretch; choose other rows")


@dataclass(frozen=True)
class Stretch:
    """One measurement: a row, or none, at a multiple of its range.

    Attributes:
        row: of `randomization`; empty: nothing is randomized.
        factor: of its range.
        task: what is measured.
    """

    row: str
    factor: float
    task: Task


def stretches(evaluation: Evaluation, preset: str, rows: Sequence[str], factors: Sequence[float]) -> list[Stretch]:
    """All measurements: one without randomization, and each row with each factor above 0 that stretches its range.

    Args:
        evaluation: of one run with one policy in one world; its condition is replaced.
        preset: of `randomization`, with the ranges.
        rows: of it.
        factors: of the ranges.
    """
    values = _rows(preset, config.search_path(evaluation.overrides, config.read(evaluation.runs[0])))
    check_known("rows", rows, tuple(values))
    if min(factors, default=0.0) < 0:
        raise ConfigError(f"factors={','.join(f'{factor:g}' for factor in factors)} must not be negative")
    parts = [("", 0.0)] + [(row, factor) for row in rows for factor in sorted(set(factors)) if factor > 0]
    if len(parts) == 1:
        raise ConfigError(f"nothing to measure: preset={preset} has no rows of the robot, or no factor is above 0")
    found: list[Stretch] = []
    seen: set[tuple[str, ...]] = set()
    for row, factor in parts:
        override = (stretched(row, values[row], factor),) if row else ()
        if override in seen:
            continue  # its BOUNDS are reached: the same range again
        seen.add(override)
        changed = replace(
            evaluation, condition=None, overrides=(*evaluation.overrides, "randomization=none", *override)
        )
        found += [Stretch(row, factor, task) for task in changed.tasks()]
    return found


def rows_of_the_robot(preset: str, folders: Sequence[Path] = ()) -> tuple[str, ...]:
    """Rows of a preset that are there and change the robot, its ground or what it measures of itself.

    Args:
        preset: of `randomization`.
        folders: the user's, of presets.
    """
    others = ("payload_position", "frames_lost", "frames_late_s")
    rows = _rows(preset, folders).items()
    return tuple(row for row, value in rows if value is not None and row not in others and row[:6] != "lidar_")


def measure(measurements: Sequence[Stretch]) -> list[tuple[Stretch, Record]]:
    """A record for each measurement; what has been measured before is kept.

    Raises:
        ConfigError: a row cannot be stretched so far, such as a mass that would be negative.
    """
    for widest in {stretch.row: stretch for stretch in measurements}.values():
        widest.task.check()
    return list(zip(measurements, measure_all([one.task for one in measurements]), strict=True))


def table(measured: Sequence[tuple[Stretch, Record]]) -> str:
    """Falls and error by row and factor."""
    factors = sorted({stretch.factor for stretch, _ in measured if stretch.row})
    by_place = {(stretch.row, stretch.factor): record for stretch, record in measured}
    names = dict.fromkeys(stretch.row for stretch, _ in measured if stretch.row)
    rows = [[row, *(_cell(by_place.get((row, factor))) for factor in factors)] for row in names]
    nothing = _cell(by_place.get(("", 0.0)))
    head = f"falls, % / velocity error, m/s (–: no wider than before); nothing randomized: {nothing}"
    return f"{head}\n\n{markdown(['row', *(f'x {factor:g}' for factor in factors)], rows)}\n"


def draw(measured: Sequence[tuple[Stretch, Record]], path: Path) -> None:
    """A panel for each row: falls with their intervals, and the velocity error, over the multiple of the range."""
    rows = list(dict.fromkeys(stretch.row for stretch, _ in measured if stretch.row))
    columns = min(5, len(rows))
    lines = -(-len(rows) // columns)
    figure = new_figure(2.6 * columns, 2.0 * lines + 0.4)
    axes = figure.subplots(lines, columns, squeeze=False, sharex=True, sharey=True).ravel()
    for axis, row in zip(axes, rows, strict=False):
        points = sorted(((s.factor, r) for s, r in measured if s.row in (row, "")), key=lambda point: point[0])
        at = [factor for factor, _ in points]
        falls = [rate(_part(record).fell) for _, record in points]
        middle = [100 * fall["rate"] for fall in falls]
        ends = [[m - 100 * f["low"] for m, f in zip(middle, falls, strict=True)]]
        ends.append([100 * f["high"] - m for m, f in zip(middle, falls, strict=True)])
        axis.errorbar(at, middle, yerr=ends, color="#d62728", marker="o", markersize=3, linewidth=1, capsize=2)
        errors = axis.twinx()
        errors.plot(at, [_error(record) for _, record in points], color="#3b6fb6", linewidth=1)
        errors.set_ylim(0, 1)
        errors.tick_params(labelsize=6, colors="#3b6fb6")
        axis.axvline(1.0, color="0.8", linewidth=0.8)
        axis.set_title(row.replace("_", " "), fontsize=8)
        axis.set_ylim(-3, 103)
        axis.tick_params(labelsize=6)
    for axis in axes[len(rows) :]:
        axis.set_axis_off()
    figure.suptitle("falls, % (red) and velocity error, m/s (blue) over multiples of each row's range", fontsize=9)
    save_figure(figure, path)


def _part(record: Record) -> Part:
    return Part(record, torch.ones(len(record.episodes), dtype=torch.bool))


def _error(record: Record) -> float:
    return _part(record).settled("settled_velocity_error")


def _cell(record: Record | None) -> str:
    return "–" if record is None else f"{rate_cell([_part(record).fell])} / {_error(record):.2f}"


def _rows(preset: str, folders: Sequence[Path] = ()) -> dict[str, Any]:
    """The rows of a preset of `randomization`, as plain data; `folders`: the user's, of presets."""
    composed = config.compose([*config.as_override(folders), f"randomization={preset}", "~experiment"])
    return cast(dict, OmegaConf.to_container(composed["randomization"]))
