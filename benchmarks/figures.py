"""The paper's figures of the method: the framework, and V_avoid by sectors.

    python scripts/figures.py what=framework,avoidance out=docs/lab

Settings are read from the presets, so the pictures change with them. Scans of the sensors'
patterns: `omniperception scan`; worlds from above: `evaluate plots=true`; learning curves:
`omniperception curves`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from omniperception import build, config
from omniperception.avoidance.sector_motion import sector_bearings
from omniperception.avoidance.velocity import AvoidanceConfig, avoidance_velocity
from omnirobot.common.cli import Command, argument
from omnirobot.common.figures import new_figure

DISCS = ((0.9, 0.35, 0.3), (-0.2, 0.75, 0.2), (0.6, -1.5, 0.35))
"""Obstacles around the robot of the picture: x, y, radius (m)."""


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """The command's own arguments."""

    what: tuple[str, ...] = argument(("framework", "avoidance"), "pictures", choices=("framework", "avoidance"))
    out: Path = argument(Path("outputs/figures"), "folder of what is written")


def main(arguments: Arguments) -> None:
    """Draws the pictures."""
    arguments.out.mkdir(parents=True, exist_ok=True)
    run = build.assemble(config.compose(["experiment=paper"]))
    if "framework" in arguments.what:
        draw_framework(arguments.out / "framework.png", run)
    if "avoidance" in arguments.what:
        draw_avoidance(arguments.out / "avoidance.png", run.env.rewards.avoidance)
    print(f"wrote {', '.join(str(arguments.out / f'{name}.png') for name in arguments.what)}")


def disc_distances(discs: Sequence[tuple[float, float, float]], bearings: torch.Tensor) -> torch.Tensor:
    """Distance (S,) (m) from the origin to the nearest disc (x, y, radius) along unit vectors (S, 2); inf for none."""
    nearest = torch.full((len(bearings),), math.inf)
    for x, y, radius in discs:
        along = bearings @ torch.tensor([x, y])
        inside = along.square() - (x * x + y * y - radius * radius)
        hit = (along > 0) & (inside >= 0)
        nearest = torch.where(hit, torch.minimum(nearest, along - inside.clamp(min=0).sqrt()), nearest)
    return nearest


def draw_avoidance(path: Path, settings: AvoidanceConfig) -> None:
    """Sectors around a robot among discs, what each pushes, and their sum; the push of a sector by its distance."""
    from matplotlib.patches import Circle, Wedge

    bearings = sector_bearings(settings.num_sectors)
    distance = disc_distances(DISCS, bearings)
    (total,) = avoidance_velocity(distance[None], settings).tolist()
    push = torch.exp(-settings.alpha * distance) * (distance < settings.threshold)
    figure = new_figure(10.4, 4.9)
    above, by_distance = figure.subplots(1, 2, gridspec_kw={"width_ratios": [1.25, 1]})
    half = 180.0 / settings.num_sectors
    for (x, y), far, strength in zip(bearings.tolist(), distance.tolist(), push.tolist(), strict=True):
        middle = math.degrees(math.atan2(y, x))
        reach = min(far, settings.threshold)
        colour = "#d62728" if strength else "#d9e2ec"
        opacity = 0.25 + 0.75 * strength if strength else 0.6
        above.add_patch(
            Wedge((0, 0), reach, middle - half, middle + half, fc=colour, ec="white", lw=0.5, alpha=opacity)
        )
        if strength:
            above.annotate("", (-strength * x, -strength * y), (0, 0), arrowprops={"arrowstyle": "->", "lw": 0.6})
    for x, y, radius in DISCS:
        above.add_patch(Circle((x, y), radius, fc="#555555"))
    above.add_patch(Circle((0, 0), settings.threshold, fill=False, ls="--", ec="#3b6fb6"))
    above.annotate("", total, (0, 0), arrowprops={"arrowstyle": "-|>", "lw": 2.5, "color": "#1b7f4d"})
    speed = math.hypot(*total)
    above.text(total[0], total[1], f"  V_avoid, {speed:.2f} m/s", color="#1b7f4d", va="top", ha="center")
    above.set(xlim=(-2.0, 1.6), ylim=(-2.0, 1.3), aspect="equal", xlabel="ahead (m)", ylabel="left (m)")
    above.set_title(
        f"{settings.num_sectors} sectors; red: an obstacle nearer than {settings.threshold:g} m", fontsize=10
    )
    metres = np.linspace(0.0, 1.5 * settings.threshold, 301)
    by_distance.plot(metres, np.exp(-settings.alpha * metres) * (metres < settings.threshold), color="#d62728")
    by_distance.set(xlabel="distance in the sector (m)", ylabel="push of one sector (m/s)", ylim=(0, 1.05))
    by_distance.set_title(
        f"exp(-{settings.alpha:g} d) below {settings.threshold:g} m, away from the sector", fontsize=10
    )
    by_distance.grid(alpha=0.3)
    figure.savefig(path, dpi=120)


def draw_framework(path: Path, run: build.RunConfig) -> None:
    """What passes from sensors to joints in `experiment=paper`, and what is known in training alone."""
    from omniperception.perception import PdRiskNet, PdSampler

    assert run.perception is not None and run.env.lidar is not None
    sampler, network = run.perception.sampler(), run.perception.build_network()
    assert isinstance(sampler, PdSampler) and isinstance(network, PdRiskNet)
    near, far = (int(size) for size in dict(sampler.sizes).values())
    near_dim = network.supervised["height_target"].stop
    far_dim = network.feature_dim - near_dim
    frames, hertz = run.perception.history, 1.0 / run.env.lidar.period_s
    hidden = "-".join(map(str, run.ppo.hidden_dims))
    control = 1.0 / run.env.sim.control_dt
    figure = new_figure(12.4, 5.4)
    axis = figure.subplots()
    axis.set(xlim=(0, 124), ylim=(0, 54))
    axis.set_axis_off()
    sensed, learned, known = "#d9e8f7", "#fbe3c8", "#e3e3e3"
    lidar = _box(axis, 1, 34, 16, 10, f"LiDAR frame\n{hertz:g} Hz\nsensor frame", sensed)
    split = _box(axis, 22, 34, 14, 10, "split by\nelevation", sensed)
    proximal = _box(axis, 41, 43, 20, 9, f"near: farthest\npoints, {near},\nsorted by angles", sensed)
    distal = _box(axis, 41, 28, 20, 9, f"far: averages\nof neighbours,\n{far}", sensed)
    near_gru = _box(axis, 66, 43, 16, 9, f"GRU of {near_dim}\n{frames} frames", learned)
    far_gru = _box(axis, 66, 28, 16, 9, f"GRU of {far_dim}\n{frames} frames", learned)
    body = _box(axis, 41, 15, 20, 8, "proprioception,\ncommand, last action", sensed)
    actor = _box(axis, 89, 25, 15, 12, f"actor (MLP)\n{hidden}", learned)
    joints = _box(axis, 109, 25, 14, 12, f"joint targets\n{control:g} Hz\nPD control", sensed)
    heights = _box(axis, 89, 44, 15, 8, "heights of the\nground", known)
    rewards = (
        "rewards: V_avoid from the nearest hit of each sector, long rays, gait\ncritic (MLP) on the privileged state"
    )
    learning = _box(axis, 41, 2, 63, 8, rewards, known)
    for start, end in (
        (lidar, split), (split, proximal), (split, distal), (proximal, near_gru), (distal, far_gru), (near_gru, actor),
        (far_gru, actor), (body, actor), (actor, joints),
    ):  # fmt: skip
        _arrow(axis, start, end)
    _arrow(axis, near_gru, heights, dashed=True)
    _arrow(axis, learning, actor, dashed=True)
    axis.text(
        1,
        25,
        "blue: measured, computed\norange: learned, end to end by PPO\ngrey, dashed: in training alone",
        fontsize=9,
        va="top",
    )
    figure.savefig(path, dpi=120)


Box = tuple[float, float, float, float]


def _box(axis: Any, x: float, y: float, width: float, height: float, text: str, colour: str) -> Box:
    """Draws a box at its lower left corner, and returns it."""
    from matplotlib.patches import FancyBboxPatch

    axis.add_patch(
        FancyBboxPatch((x, y), width, height, boxstyle="round,pad=0,rounding_size=1", fc=colour, ec="#444444")
    )
    axis.text(x + width / 2, y + height / 2, text, ha="center", va="center", fontsize=9)
    return x, y, width, height


def _arrow(axis: Any, start: Box, end: Box, dashed: bool = False) -> None:
    """From the right side of a box to the left side of another, or up where it stands above."""
    (x, y, width, height), (to_x, to_y, to_width, to_height) = start, end
    if to_x >= x + width:
        ends = (to_x, to_y + to_height / 2), (x + width, y + height / 2)
    else:
        ends = (to_x + to_width / 2, to_y), (to_x + to_width / 2, y + height)
    axis.annotate("", *ends, arrowprops={"arrowstyle": "->", "ls": "--" if dashed else "-", "color": "#444444"})


command = Command(main, Arguments, __doc__)

if __name__ == "__main__":
    command()
