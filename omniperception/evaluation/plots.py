"""Draws the robots' paths through a scenario, coloured by outcome."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import torch

from omniperception.common.figures import new_figure
from omniperception.evaluation.episodes import VERDICTS, Episodes
from omniperception.evaluation.tracks import Tracks
from omniperception.scene.obstacle_field import PARKED_HEIGHT
from omniperception.scene.obstacles import Obstacle, ObstaclesConfig

COLOURS = dict(zip(VERDICTS, ("#2a9d5c", "#e0a100", "#3b6fb6", "#c0392b", "#8e44ad", "#555555"), strict=True))
SHOWN = 300
"""Largest number of trajectories in one panel."""
EXAMPLES = 3
"""Single trials drawn with their obstacles."""


def draw_tracks(path: Path, scenario: str, by_policy: Mapping[str, Episodes], obstacles: ObstaclesConfig) -> None:
    """A row per policy: all ways with the places of the first touches, then single trials with their obstacles.

    The single trials are of the outcomes that are not a clean success, as far as there are such, and show the obstacles
    where they were at the start; dashed ones move.
    """
    bounds = _bounds(list(by_policy.values()))
    width, height = bounds[1] - bounds[0], bounds[3] - bounds[2]
    columns, rows = 1 + EXAMPLES, len(by_policy)
    figure = new_figure(4.2 * columns, rows * (4.2 * height / width + 0.9))
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    for row, (policy, episodes) in zip(axes, by_policy.items(), strict=True):
        _draw_all(row[0], policy, episodes, obstacles)
        shown = _examples(episodes)
        for axis, index in zip(row[1:], shown, strict=False):
            _draw_one(axis, episodes, index, obstacles)
        for axis in row[1 + len(shown) :]:
            axis.set_axis_off()
        row[0].set_ylabel("y (m)")
    for axis in axes[-1]:
        axis.set_xlabel("x (m)")
    axes[0, 0].set(xlim=bounds[:2], ylim=bounds[2:])
    figure.suptitle(f"{scenario}: ways of the base by outcome")
    figure.savefig(path, dpi=120)


def _draw_all(axis, policy: str, episodes: Episodes, obstacles: ObstaclesConfig) -> None:
    from matplotlib.collections import LineCollection

    tracks, verdicts = _tracks(episodes), episodes.verdict
    _draw_walls(axis, obstacles)
    every = math.ceil(len(episodes) / SHOWN)
    for verdict in VERDICTS:
        count = verdicts.count(verdict)
        if not count:
            continue
        ways = [tracks.xy[i].numpy() for i in range(0, len(episodes), every) if verdicts[i] == verdict]
        label = f"{verdict}: {count}"
        axis.add_collection(LineCollection(ways, colors=COLOURS[verdict], linewidths=0.7, alpha=0.5))
        axis.plot([], [], color=COLOURS[verdict], label=label)
    touched = tracks.contact[::every]
    axis.plot(touched[:, 0], touched[:, 1], "x", color="black", markersize=3, alpha=0.6, label="first touch")
    axis.set_title(f"{policy}: {len(range(0, len(episodes), every))} of {len(episodes)} trials", fontsize=9)
    axis.legend(fontsize=7, loc="upper left", framealpha=0.7)
    axis.set_aspect("equal")


def _draw_one(axis, episodes: Episodes, index: int, obstacles: ObstaclesConfig) -> None:
    tracks, verdict = _tracks(episodes), episodes.verdict[index]
    _draw_walls(axis, obstacles)
    for slot, (x, y, z, yaw) in zip(obstacles.placed_slots(), tracks.obstacles[index].tolist(), strict=True):
        if z > PARKED_HEIGHT / 2:
            axis.add_patch(_outline(slot, x, y, yaw, lifted=z - slot.half_height > 0.45))
    way = tracks.xy[index]
    axis.plot(way[:, 0], way[:, 1], color=COLOURS[verdict], linewidth=1.5)
    axis.plot(*tracks.contact[index].tolist(), "x", color="black", markersize=5)
    if tracks.goal is not None:
        axis.plot(*tracks.goal[index].tolist(), "*", color="black", markersize=7)
    env, trial = divmod(index, episodes.per_env)
    axis.set_title(f"environment {env}, trial {trial}: {verdict}", fontsize=9)
    axis.set_aspect("equal")


def _tracks(episodes: Episodes) -> Tracks:
    assert episodes.tracks is not None  # recorded for pictures
    return episodes.tracks


def _draw_walls(axis, obstacles: ObstaclesConfig) -> None:
    for slot in obstacles.slots():
        if slot.pose is not None:
            x, y, yaw_deg = slot.pose
            axis.add_patch(_outline(slot, x, y, math.radians(yaw_deg), lifted=False))


def _outline(slot: Obstacle, x: float, y: float, yaw: float, lifted: bool):
    """The obstacle seen from above; what hangs over the robot is transparent."""
    from matplotlib.patches import Circle, Rectangle

    style = {
        "facecolor": "none" if lifted else "#d9d4cc",
        "edgecolor": "#6b6459",
        "linestyle": "--" if slot.group.speed[1] > 0 else "-",
        "linewidth": 0.8,
        "zorder": 0,
    }
    if slot.kind != "box":
        return Circle((x, y), max(slot.size[0], 0.03), **style)
    half_x, half_y = slot.size[:2]
    return Rectangle(
        (x - half_x, y - half_y), 2 * half_x, 2 * half_y, angle=math.degrees(yaw), rotation_point="center", **style
    )


def _examples(episodes: Episodes) -> list[int]:
    """Trials to look at: one of each failure in turn, then successes."""
    verdicts = episodes.verdict
    order = ("fall", "time out", "success, touched", "collision end", "diverged", "success")
    by_verdict = [[i for i, v in enumerate(verdicts) if v == verdict] for verdict in order]
    rounds = max(len(indices) for indices in by_verdict)
    return [indices[k] for k in range(rounds) for indices in by_verdict if k < len(indices)][:EXAMPLES]


def _bounds(all_episodes: list[Episodes]) -> tuple[float, float, float, float]:
    """Area that the panels show (m): all ways and goals with a margin."""

    def points(tracks: Tracks) -> torch.Tensor:
        return torch.cat([*tracks.xy, *([tracks.goal] if tracks.goal is not None else [])])

    xy = torch.cat([points(_tracks(episodes)) for episodes in all_episodes])
    low, high = xy.amin(0) - 0.8, xy.amax(0) + 0.8
    return float(low[0]), float(high[0]), min(float(low[1]), -2.2), max(float(high[1]), 2.2)
