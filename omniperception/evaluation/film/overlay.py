"""What is drawn over a video's picture: a legend of its colours, and obstacles by sector as perceived and as true."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from omniperception.avoidance.sector_motion import NEARNESS_RANGE

Rgb = tuple[int, int, int]
GLASS, RIM, TEXT = (16, 20, 28, 150), (255, 255, 255, 90), (240, 243, 247, 255)
"""Behind what is drawn, of its lines, of its letters; RGBA."""
PERCEIVED, TRUE = (226, 60, 200), (240, 243, 247)
"""Obstacles by sector."""
DEPTH_M = 0.4
"""Depth of the band that is filled from a perceived obstacle outwards."""
SMOOTH = 3
"""The inset is drawn so many times as large, then reduced."""


def legend(entries: Mapping[str, Rgb], height: int) -> Image.Image:
    """Names with dots of their colours, for a picture of a height (pixels)."""
    line = max(height // 45, 9)
    font = ImageFont.load_default(line)
    names = list(entries)
    widths = [font.getlength(name) for name in names]
    picture = Image.new("RGBA", (round(sum(widths) + line * (2.2 * len(names) + 0.6)), 2 * line))
    draw = ImageDraw.Draw(picture)
    draw.rounded_rectangle((0, 0, picture.width - 1, picture.height - 1), line // 2, fill=GLASS)
    x = 0.7 * line
    for name, width in zip(names, widths, strict=True):
        draw.ellipse((x, 0.68 * line, x + 0.64 * line, 1.32 * line), fill=entries[name])
        draw.text((x + line, line), name, fill=TEXT, font=font, anchor="lm")
        x += width + 2.2 * line
    return picture


def sector_plot(perceived: np.ndarray | None, true: np.ndarray | None, size: int) -> Image.Image:
    """Where the nearest obstacle of each azimuth sector is, ahead up and left to the left.

    Bands, from the obstacle outwards: what is perceived. Lines: what is true.

    Args:
        perceived, true: (S, 3) `Perceived.sectors`; None: nothing is drawn.
        size: side of the picture (pixels).
    """
    full = SMOOTH * size
    picture = Image.new("RGBA", (full, full))
    draw = ImageDraw.Draw(picture)
    middle, outer = full / 2, 0.49 * full

    def box(radius: float) -> tuple[float, float, float, float]:
        return middle - radius, middle - radius, middle + radius, middle + radius

    draw.ellipse(box(outer), fill=GLASS)
    for share in (0.25, 0.5, 0.75, 1.0):
        draw.ellipse(box(share * outer), outline=RIM, width=SMOOTH)
    for inner, low, high in _wedges(perceived, outer):
        angles = np.radians(np.linspace(low, high, 5))
        rim = np.stack((np.cos(angles), np.sin(angles)), 1)
        far = min(inner + outer * DEPTH_M / NEARNESS_RANGE, outer)
        corners = middle + np.concatenate((inner * rim, far * rim[::-1]))
        draw.polygon([tuple(corner) for corner in corners], fill=PERCEIVED)
    for inner, low, high in _wedges(true, outer):
        draw.arc(box(inner + 0.012 * full), low, high, fill=TRUE, width=round(0.024 * full))
    tip = 0.055 * full
    draw.polygon(((middle, middle - tip), (middle - 0.6 * tip, middle + tip), (middle + 0.6 * tip, middle + tip)), TEXT)
    return picture.reduce(SMOOTH)


def _wedges(sectors: np.ndarray | None, outer: float) -> list[tuple[float, float, float]]:
    """Radius of the obstacle (pixels), and the angles (deg, clockwise from the right) of each sector that has one."""
    if sectors is None:
        return []
    width = 360.0 / len(sectors)
    near = [k for k in range(len(sectors)) if sectors[k, 0] < NEARNESS_RANGE]
    low = {k: -90.0 + 180.0 - (k + 1) * width for k in near}  # sector 0 begins behind, and they go counter-clockwise
    return [(outer * max(float(sectors[k, 0]), 0.0) / NEARNESS_RANGE, low[k], low[k] + width) for k in near]
