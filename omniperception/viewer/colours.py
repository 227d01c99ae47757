"""Colours of what the viewer shows, (r, g, b) from 0 to 255."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from omnilidar import LidarFrame
from omniperception.scene.rays import HitClass

Rgb = tuple[int, int, int]

PROXIMAL, DISTAL = (226, 60, 38), (38, 98, 226)
CLASSES: dict[int, Rgb] = {
    HitClass.TERRAIN: (140, 140, 148),
    HitClass.OBSTACLE: (232, 133, 23),
    HitClass.ROBOT: (40, 40, 60),
}
ARROWS: dict[str, Rgb] = {
    "command": (36, 160, 72),
    "velocity": (240, 196, 20),
    "V_avoid perceived": (226, 60, 200),
    "V_avoid true": (90, 90, 100),
}
SECTORS: dict[str, Rgb] = {"perceived": (226, 60, 200), "true": (90, 90, 100)}
HEIGHTS: dict[str, Rgb] = {"predicted": (226, 60, 200), "true": (36, 160, 72)}
OBSTACLE, TERRAIN = (205, 170, 120), (188, 192, 196)

_STOPS = np.array([(44, 62, 145), (38, 130, 142), (94, 201, 98), (253, 231, 37)], float)
_HEAT = np.array([(238, 242, 246), (253, 200, 110), (226, 60, 38), (110, 10, 30)], float)


def css(rgb: Sequence[float]) -> str:
    """As style sheets write it."""
    return "#" + "".join(f"{int(x):02x}" for x in rgb)


def heat(share: float) -> tuple[int, ...]:
    """White over orange and red to dark red as `share` goes from 0 to 1."""
    return tuple(_mixed(np.array([share]), _HEAT)[0])


def scale(share: np.ndarray) -> np.ndarray:
    """(P, 3) uint8, blue over green to yellow as shares (P,) go from 0 to 1."""
    return _mixed(share, _STOPS)


def of_points(
    frame: LidarFrame, by: str, classes: Mapping[int, Sequence[int]], period_s: float, top: float
) -> np.ndarray:
    """(P, 3) uint8, of the points of a frame's first environment that hit something.

    Args:
        frame: of all that is asked for.
        by: "time", "intensity", "height" or what it hit.
        classes: colours of what can be hit.
        period_s: the time (s) of the last colour.
        top: its height (m).
    """
    assert frame.valid is not None and frame.points_w is not None
    hit = frame.valid[0]

    def column(name: str) -> np.ndarray:
        return getattr(frame, name)[0, hit].numpy(force=True)

    if by == "time":
        return scale(column("time_s") / period_s)
    if by == "intensity":
        return scale(np.sqrt(column("intensity")) / 3.0)
    if by == "height":
        return scale(column("points_w")[:, 2] / top)
    return np.array([classes[k] for k in sorted(classes)], np.uint8)[column("class_id")]


def _mixed(share: np.ndarray, stops: np.ndarray) -> np.ndarray:
    at = np.clip(np.nan_to_num(share), 0.0, 1.0) * (len(stops) - 1)
    low = np.minimum(at.astype(int), len(stops) - 2)
    part = (at - low)[:, None]
    return (stops[low] * (1 - part) + stops[low + 1] * part).astype(np.uint8)
