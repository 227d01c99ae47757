"""Draws worlds from above: the ways of the robots, touched ones in red, and the obstacles of one trial."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import torch

from omniperception.evaluation.report.records import Record
from omniperception.evaluation.report.tables import rate_cell
from omniperception.evaluation.trials.tracks import Tracks
from omnirobot.common.figures import new_figure, plain, save_figure

UNTOUCHED, TOUCHED, FAILED = "#1b7f4d", "#d62728", "#3b6fb6"
"""Colours of ways: reached and untouched; touched, wherever they end; neither touched nor at the goal."""
SHOWN = 25
"""Ways drawn of each world, the first ones."""
OVERHEAD = 0.45
"""Obstacles whose lower edge is higher (m) are drawn as outlines: the robot passes below."""
_MARGIN = 0.6
_PANEL = 4.6, 2.6
"""Width and height of a panel (inches)."""


def draw_worlds(path: Path, records: Sequence[Record]) -> None:
    """A panel for each world: the first trial with its obstacles where they were at the start, and more ways.

    Args:
        path: the picture.
        records: with tracks.
    """
    columns = min(len(records), 2 if len(records) <= 10 else 4)
    rows = -(-len(records) // columns)
    figure = new_figure(columns * _PANEL[0], rows * _PANEL[1] + 0.9)
    axes = figure.subplots(rows, columns, squeeze=False)
    for axis in axes.ravel()[len(records) :]:
        axis.set_axis_off()
    for axis, record in zip(axes.ravel(), records, strict=False):
        _draw(axis, record)
    for axis in axes[-1]:
        axis.set_xlabel("x (m)", fontsize=8)
    for axis in axes[:, 0]:
        axis.set_ylabel("y (m)", fontsize=8)
    first, ways = records[0], min(SHOWN, max(len(record.episodes) for record in records))
    what = f"{first.policy} of {plain(first.run)}, split {first.split}, condition {first.condition}"
    key = "thick: the first trial, obstacles where they were at its start (dashed: moving)"
    figure.suptitle(f"{what}\n{key}; thin: {ways - 1} more", fontsize=9)
    figure.legend(handles=_legend(), loc="outside lower center", ncols=5, fontsize=8, frameon=False)
    save_figure(figure, path)


def _draw(axis, record: Record) -> None:
    from matplotlib.collections import LineCollection

    episodes, tracks = record.episodes, record.episodes.tracks
    assert tracks is not None  # recorded for pictures
    for part in tracks.parts[0].tolist():
        if not math.isnan(part[0]):
            axis.add_patch(_footprint(*part))
    colours = [
        TOUCHED if touched else UNTOUCHED if clean else FAILED
        for touched, clean in zip(episodes.collided.tolist(), episodes.clean.tolist(), strict=True)
    ]
    ways = [way.numpy() for way in tracks.xy[:SHOWN]]
    axis.add_collection(LineCollection(ways[1:], colors=colours[1 : len(ways)], linewidths=0.8, alpha=0.45))
    axis.plot(ways[0][:, 0], ways[0][:, 1], color=colours[0], linewidth=2.2)
    axis.plot(*ways[0][0].tolist(), "o", color="black", markersize=4)
    axis.plot(*tracks.contact[0].tolist(), "x", color="black", markersize=7, markeredgewidth=1.6)
    if tracks.goal is not None:
        axis.plot(*tracks.goal[0].tolist(), "*", color="black", markersize=9)
    axis.set_title(f"{record.place}: untouched {rate_cell([episodes.clean])} % of {len(episodes)}", fontsize=9)
    axis.tick_params(labelsize=7)
    low_x, high_x, low_y, high_y = _bounds(tracks)
    wide, high = _PANEL
    size = max(high_x - low_x, (high_y - low_y) * wide / high)  # of the area that holds all and has the panel's shape
    x, y = (low_x + high_x - size) / 2, (low_y + high_y - size * high / wide) / 2
    axis.set(xlim=(x, x + size), ylim=(y, y + size * high / wide), aspect="equal")


def _footprint(x: float, y: float, yaw: float, half_x: float, half_y: float, bottom: float, speed: float):
    """A part from above; one that the robot passes below is an outline, one that moves has a dashed edge."""
    from matplotlib.patches import Circle, Rectangle

    style = {
        "facecolor": "none" if bottom > OVERHEAD else "#cfc8bc",
        "edgecolor": "#5a544a",
        "linestyle": "--" if speed > 0.0 else "-",
        "linewidth": 0.9,
        "zorder": 0.5,
    }
    if half_y < 0.0:
        return Circle((x, y), max(half_x, 0.03), **style)
    return Rectangle(
        (x - half_x, y - half_y), 2 * half_x, 2 * half_y, angle=math.degrees(yaw), rotation_point="center", **style
    )


def _legend() -> list:
    from matplotlib.lines import Line2D

    ways = ((UNTOUCHED, "reached, untouched"), (TOUCHED, "touched"), (FAILED, "untouched, not reached"))
    lines = [Line2D([], [], color=colour, label=label) for colour, label in ways]
    marks = (("x", "first touch"), ("*", "goal"))
    return [*lines, *(Line2D([], [], color="black", marker=mark, linestyle="", label=label) for mark, label in marks)]


def _bounds(tracks: Tracks) -> tuple[float, float, float, float]:
    """Area that a panel shows (m): ways, goals and the obstacles of the first trial with a margin."""
    points = [*tracks.xy[:SHOWN], *([tracks.goal[:SHOWN]] if tracks.goal is not None else [])]
    here = tracks.parts[0, :, :2]
    xy = torch.cat([*points, here[~here.isnan().any(1)]])
    low, high = xy.amin(0) - _MARGIN, xy.amax(0) + _MARGIN
    return float(low[0]), float(high[0]), min(float(low[1]), -2.0), max(float(high[1]), 2.0)
