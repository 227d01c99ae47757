"""Rotating wedge prisms (Risley prisms): the optics of Livox's non-repetitive scanners, exact in Snell's law."""

import math
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Wedge:
    """A prism with one face normal to the optical axis and one inclined face, spinning about that axis.

    Attributes:
        index: Refractive index of its glass.
        angle_deg: Inclination of the inclined face.
        rpm: Turns per minute about the optical axis x, from y towards z.
        start_deg: Where the inclined face's normal points at time 0, from y towards z.
        flat_first: Whether light enters through the flat face.
    """

    index: float
    angle_deg: float
    rpm: float
    start_deg: float
    flat_first: bool


@dataclass(frozen=True)
class RisleyScanner:
    """Lasers in a fan, bent by wedges that spin.

    Attributes:
        wedges: In the order in which light passes them.
        num_lasers: Lasers in the fan, the uppermost first.
        fan_deg: Angle from laser to laser, in the vertical plane through the optical axis.
    """

    wedges: tuple[Wedge, ...]
    num_lasers: int = 1
    fan_deg: float = 0.0

    def directions(self, time: np.ndarray, laser: np.ndarray) -> np.ndarray:
        """Directions of lasers.

        Args:
            time: s; any shape that broadcasts with ``laser``.
            laser: Index of the laser, 0..num_lasers-1.

        Returns:
            (..., 3) float64 unit vectors in the sensor frame: x is the optical axis, z up.
        """
        fan = np.radians(self.fan_deg) * ((self.num_lasers - 1) / 2.0 - laser)
        ray = (np.cos(fan), np.zeros_like(fan), np.sin(fan))
        for wedge in self.wedges:
            ray = _through(ray, wedge, time)
        return np.stack(np.broadcast_arrays(*ray), axis=-1)


Ray = tuple[np.ndarray, np.ndarray, np.ndarray]


def _through(ray: Ray, wedge: Wedge, time: np.ndarray) -> Ray:
    angle = 2.0 * math.pi * wedge.rpm / 60.0 * time + math.radians(wedge.start_deg)
    slope = math.radians(wedge.angle_deg)
    inclined = (math.cos(slope), math.sin(slope) * np.cos(angle), math.sin(slope) * np.sin(angle))
    if wedge.flat_first:
        return _refract(_refract_flat(ray, 1.0 / wedge.index), inclined, wedge.index)
    return _refract_flat(_refract(ray, inclined, 1.0 / wedge.index), wedge.index)


def _refract_flat(ray: Ray, ratio: float) -> Ray:
    """Snell's law at a face normal to x; ``ratio`` is the index before it over the index behind it."""
    y, z = ratio * ray[1], ratio * ray[2]
    return np.sqrt(1.0 - y * y - z * z), y, z


def _refract(ray: Ray, normal: tuple[float, np.ndarray, np.ndarray], ratio: float) -> Ray:
    """Snell's law in vector form at a face with a unit normal along the light."""
    cosine = ray[0] * normal[0] + ray[1] * normal[1] + ray[2] * normal[2]
    shift = np.sqrt(1.0 - ratio * ratio * (1.0 - cosine * cosine)) - ratio * cosine
    return tuple(ratio * r + shift * n for r, n in zip(ray, normal, strict=True))
