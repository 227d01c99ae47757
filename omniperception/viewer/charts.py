"""Drawings beside the scene, as SVG: risk of velocities around the robot, bars of reward terms, nearness by sector."""

from __future__ import annotations

import html
import math
from collections.abc import Mapping, Sequence

import numpy as np

from omniperception.avoidance.velocity_risk import VelocityRisk
from omniperception.viewer.colours import ARROWS, css, heat

SIZE = 190
_TEXT = 'font-family="sans-serif" font-size="10" fill="#777"'


def risk_polar(
    title: str, risk: np.ndarray, config: VelocityRisk, arrows: Mapping[str, Sequence[float]], size: int = SIZE
) -> str:
    """Risks of the candidate velocities: a cell each, v_x up and v_y to the left; arrows over them.

    Args:
        title: above it.
        risk: (K,) 0 to 1.
        config: of the candidates.
        arrows: velocities (v_x, v_y) in m/s, yaw-aligned frame, by name in `ARROWS`.
        size: side (pixels).
    """
    middle, ring = size / 2, (size / 2 - 12) / (config.num_rings + 0.5)
    scale = ring * config.num_rings / config.max_speed
    cells = []
    for k in range(config.num_rings):
        inner, outer = (k + 0.5) * ring, (k + 1.5) * ring
        for j in range(config.num_directions):
            value = risk[1 + k * config.num_directions + j]
            angles = [2 * math.pi * (j + side) / config.num_directions for side in (-0.5, 0.5)]
            cells.append(f'<path d="{_cell(middle, inner, outer, *angles)}" fill="{css(heat(value))}"/>')
    cells.append(f'<circle cx="{middle}" cy="{middle}" r="{0.5 * ring:.1f}" fill="{css(heat(risk[0]))}"/>')
    for name, (ahead, aside) in arrows.items():
        x, y = middle - scale * aside, middle - scale * ahead
        line = f'stroke="{css(ARROWS[name])}" stroke-width="2.5"'
        cells.append(f'<line x1="{middle}" y1="{middle}" x2="{x:.1f}" y2="{y:.1f}" {line}/>')
        cells.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.5" fill="{css(ARROWS[name])}"/>')
    cells.append(f'<text x="4" y="10" {_TEXT}>{html.escape(title)}</text>')
    cells.append(f'<text x="{size - 4}" y="{size - 3}" text-anchor="end" {_TEXT}>{config.max_speed:g} m/s</text>')
    return _svg(size, size, cells)


def _cell(middle: float, inner: float, outer: float, low: float, high: float) -> str:
    def at(radius: float, angle: float) -> str:
        return f"{middle - radius * math.sin(angle):.1f} {middle - radius * math.cos(angle):.1f}"

    back = f"L{at(outer, high)} A{outer:.1f} {outer:.1f} 0 0 1 {at(outer, low)}"
    return f"M{at(inner, low)} A{inner:.1f} {inner:.1f} 0 0 0 {at(inner, high)} {back}Z"


def reward_bars(rewards: Mapping[str, float], total: float, width: int = 400) -> str:
    """A bar for each reward term (weighted, per second), those of most weight first."""
    row, name_width = 15, 190
    ordered = sorted(rewards.items(), key=lambda item: -abs(item[1]))
    most = max([abs(value) for value in rewards.values()] + [1e-3])
    middle = name_width + (width - name_width - 46) / 2
    reach = (width - name_width - 46) / 2
    parts = [f'<line x1="{middle}" y1="0" x2="{middle}" y2="{row * len(ordered)}" stroke="#bbb"/>']
    for k, (name, value) in enumerate(ordered):
        y, length = k * row, reach * abs(value) / most
        x = middle if value > 0 else middle - length
        colour = "#3f9142" if value > 0 else "#c62f2f"
        parts.append(f'<text x="0" y="{y + 11}" {_TEXT}>{html.escape(name)}</text>')
        parts.append(f'<rect x="{x:.1f}" y="{y + 2}" width="{length:.1f}" height="{row - 4}" fill="{colour}"/>')
        parts.append(f'<text x="{width}" y="{y + 11}" text-anchor="end" {_TEXT}>{value:+.3f}</text>')
    y = row * len(ordered) + 12
    parts.append(f'<text x="0" y="{y}" {_TEXT}>sum of weighted terms per second</text>')
    parts.append(f'<text x="{width}" y="{y}" text-anchor="end" {_TEXT}>{total:+.3f}</text>')
    return _svg(width, y + 4, parts)


def legend(entries: Mapping[str, Sequence[int]]) -> str:
    """Names with dots of their colours."""
    spans = (f'<span style="color:{css(rgb)}">&#9679;</span> {html.escape(name)}' for name, rgb in entries.items())
    return f'<div style="font-size:12px;padding:4px 12px">{" &nbsp; ".join(spans)}</div>'


def side_by_side(drawings: Sequence[str]) -> str:
    """Drawings in a row."""
    return f'<div style="display:flex;gap:6px;padding:4px 12px">{"".join(drawings)}</div>'


def lines(texts: Sequence[str]) -> str:
    """Lines of text; empty ones are left out."""
    shown = "<br>".join(html.escape(text) for text in texts if text)
    return f'<div style="padding:6px 12px;font-size:12px;line-height:1.5">{shown}</div>'


def padded(drawing: str) -> str:
    """A drawing with the page's margins."""
    return f'<div style="padding:4px 12px">{drawing}</div>'


def _svg(width: int, height: float, parts: Sequence[str]) -> str:
    head = f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height:.0f}"'
    return f'{head} viewBox="0 0 {width} {height:.0f}" style="max-width:100%">{"".join(parts)}</svg>'
