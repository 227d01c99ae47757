"""The samplers of `omniperception.perception` for one robot's cloud, in NumPy."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from omnirobot.runtime.description import DeployError
from omnirobot.runtime.geometry import sector_of, standing

_PHI_BITS = 16
_MAX_RING = (1 << (31 - _PHI_BITS)) - 1
_PI = np.float32(math.pi)
_ROUNDING = 1.0 + 1e-6
"""A distance at the end of the range may exceed it by rounding."""


@dataclass(frozen=True)
class Attitude:
    """Mount of the sensor.

    Attributes:
        base_quat: (4,) orientation of the link that carries it, usually the base, in the world, (w, x, y, z); its
            heading does not matter.
        mount_pos: (3,) sensor position in that link's frame, m.
        mount_quat: (4,) sensor orientation in that link's frame, (w, x, y, z).
    """

    base_quat: np.ndarray
    mount_pos: Sequence[float]
    mount_quat: Sequence[float]


@dataclass(kw_only=True)
class CloudSampler(ABC):
    """Reduces one frame of points to a fixed number.

    Attributes:
        max_range: m; points beyond are misses, and sampled points are divided by it.
        num_points: P.
    """

    max_range: float
    num_points: int = field(init=False)

    @abstractmethod
    def __call__(self, points: np.ndarray, attitude: Attitude) -> np.ndarray:
        """(P, 3) float32 from (n, 3) float32 points (m, sensor frame) in the order of their measurement.

        A row that is not finite, zero, or beyond the maximum range is a miss.
        """

    def _is_hit(self, points: np.ndarray) -> np.ndarray:
        """(n,) bool."""
        return is_hit(points, self.max_range * _ROUNDING)

    def _scaled(self, points: np.ndarray) -> np.ndarray:
        return points * np.float32(1.0 / self.max_range)


@dataclass(kw_only=True)
class RawSampler(CloudSampler):
    """Every ray's point in ray order, a miss as zeros."""

    num_points: int

    def __call__(self, points: np.ndarray, attitude: Attitude) -> np.ndarray:
        if len(points) != self.num_points:
            raise DeployError(
                f"points: this network reads every ray, also misses (as zeros): ({self.num_points}, 3) was expected,"
                f" ({len(points)}, 3) given; subsample() reduces a device's whole frame"
            )
        return np.where(self._is_hit(points)[:, None], self._scaled(points), np.float32(0.0))


@dataclass(kw_only=True)
class _Proximal(CloudSampler):
    """A proximal half by farthest point sampling, written first, and another one of the other points.

    Attributes:
        num_proximal: slots of the proximal half.
        num_distal: slots of the other half.
        split: elevation in the sensor frame above which a point is proximal, rad; None: every point is.
        ring: height of an elevation ring for sorting, rad.
    """

    num_proximal: int
    num_distal: int
    split: float | None
    ring: float

    def __post_init__(self) -> None:
        self.num_points = self.num_proximal + self.num_distal

    def __call__(self, points: np.ndarray, attitude: Attitude) -> np.ndarray:
        points = points[self._is_hit(points)]
        near = self._is_proximal(points)
        sampled = np.zeros((self.num_points, 3), np.float32)
        if self.num_proximal:
            proximal = points[near]
            scaled = self._scaled(proximal)
            picked = farthest_points(scaled, self.num_proximal)
            sampled[: len(picked)] = scaled[picked[self._ring_order(proximal[picked])]]
        self._write_distal(sampled[self.num_proximal :], points[~near], attitude)
        return sampled

    @abstractmethod
    def _write_distal(self, out: np.ndarray, points: np.ndarray, attitude: Attitude) -> None:
        """Writes the other half, zeros so far, from the hits (n, 3) that are not proximal."""

    def _is_proximal(self, points: np.ndarray) -> np.ndarray:
        """(n,) bool: the elevation is above the split. Angles, which are slow, decide only where rounding could."""
        if self.split is None:
            return np.ones(len(points), bool)
        x, y, z = points.T
        split = np.float32(self.split)
        above = z * np.cos(split) - np.sqrt(x * x + y * y) * np.sin(split)  # m, from the cone of this elevation
        near = above > 0.0
        doubtful = np.flatnonzero(abs(above) < np.float32(1e-6 * self.max_range))
        near[doubtful] = angles_of(points[doubtful])[0] > split
        return near

    def _ring_order(self, points: np.ndarray) -> np.ndarray:
        """(n,) indices that sort points by ring of elevation, then azimuth."""
        return np.argsort(sort_keys(*angles_of(points), np.float32(self.ring)), kind="stable")


class PdSampler(_Proximal):
    """Proximal points, and distal ones as means of bins."""

    def _write_distal(self, out: np.ndarray, points: np.ndarray, attitude: Attitude) -> None:
        bins = min(len(points), self.num_distal)
        if bins:
            edges = np.arange(bins + 1) * len(points) // bins
            sums = np.add.reduceat(self._scaled(points)[self._ring_order(points)], edges[:-1], axis=0)
            out[:bins] = sums / np.diff(edges)[:, None].astype(np.float32)


@dataclass(kw_only=True)
class _Cells:
    """Cells of height and azimuth around the levelled base.

    Attributes:
        num_sectors: azimuth sectors.
        band_edges: heights that separate the bands, m.
        decay: distance over which the proximity falls by e, m.
    """

    num_sectors: int
    band_edges: Sequence[float]
    decay: float

    def write_nearest(self, out: np.ndarray, places: np.ndarray, height: np.ndarray) -> None:
        """Writes the nearest place of each cell: its bearing times its proximity, and the proximity.

        Args:
            out: (bands * sectors, 3), zeros.
            places: (n, 2) m, around the base.
            height: (n,) m of each, within the bands or not.
        """
        edges = np.asarray(self.band_edges, np.float32)
        inside = (height >= edges[0]) & (height < edges[-1])
        places, band = places[inside], np.searchsorted(edges, height[inside], side="right") - 1
        cell = band * self.num_sectors + sector_of(places, self.num_sectors)
        horizontal = np.sqrt(np.square(places).sum(1))
        least = np.full(len(out), np.inf, np.float32)
        np.minimum.at(least, cell, horizontal)
        nearest = np.flatnonzero(horizontal == least[cell])[::-1]  # of equally near ones the first measured is kept
        proximity = np.exp(-horizontal[nearest] / np.float32(self.decay))
        bearing = places[nearest] * (proximity / np.maximum(horizontal[nearest], np.float32(1e-6)))[:, None]
        out[cell[nearest]] = np.concatenate((bearing, proximity[:, None]), 1)


@dataclass(kw_only=True)
class ProximitySampler(_Proximal, _Cells):
    """Proximal points, and proximities in cells of the other ones; heights above the base's origin.

    Attributes:
        blind: nearest distance that counts, m.
        body: half length and half width of the robot's own body, m.
    """

    num_distal: int = field(init=False)
    blind: float
    body: Sequence[float]

    def __post_init__(self) -> None:
        self.num_distal = self.num_sectors * (len(self.band_edges) - 1)
        super().__post_init__()

    def _write_distal(self, out: np.ndarray, points: np.ndarray, attitude: Attitude) -> None:
        level = without_heading(rotation_matrix(attitude.base_quat))
        turn = (level @ rotation_matrix(attitude.mount_quat)).astype(np.float32)
        offset = (level @ np.asarray(attitude.mount_pos, np.float64)).astype(np.float32)
        at = points[np.linalg.norm(points, axis=1) >= np.float32(self.blind)] @ turn.T + offset
        at = at[(abs(at[:, 0]) >= self.body[0]) | (abs(at[:, 1]) >= self.body[1])]
        self.write_nearest(out, at[:, :2], at[:, 2])


@dataclass(kw_only=True)
class StandingSampler(CloudSampler, _Cells):
    """Proximities in cells of what stands on the ground; heights above it.

    Attributes:
        geometry: settings of training's `GeometryConfig`, by name.
    """

    geometry: Mapping

    def __post_init__(self) -> None:
        self.num_points = self.num_sectors * (len(self.band_edges) - 1)

    def __call__(self, points: np.ndarray, attitude: Attitude) -> np.ndarray:
        points = points[self._is_hit(points)]
        mount, level = rotation_matrix(attitude.mount_quat), without_heading(rotation_matrix(attitude.base_quat))
        sensor = np.asarray(attitude.mount_pos, np.float64)
        in_base = points @ mount.T.astype(np.float32) + sensor.astype(np.float32)
        places, height = standing(in_base, np.linalg.norm(points, axis=1), level, sensor, self.geometry)
        sampled = np.zeros((self.num_points, 3), np.float32)
        self.write_nearest(sampled, places[:, :2], height)
        return sampled


_KINDS = {"raw": RawSampler, "pd": PdSampler, "proximity": ProximitySampler, "standing": StandingSampler}


def make_sampler(parameters: Mapping) -> CloudSampler:
    """The sampler that a description names: its `kind`, one of `_KINDS`, and its arguments."""
    arguments = dict(parameters)
    return _KINDS[arguments.pop("kind")](**arguments)


def is_hit(points: np.ndarray, max_range: float) -> np.ndarray:
    """(n,) bool of points (n, 3), m: finite, not zero and within the range."""
    square = np.einsum("ij,ij->i", points, points)
    return (square > 0.0) & (square <= np.float32(max_range**2))  # false for nan


def farthest_points(points: np.ndarray, count: int) -> np.ndarray:
    """Indices of exact farthest point sampling from point 0; no point twice, of equally far ones the first.

    Args:
        points: (n, 3) float32.
        count: points to pick; all of them, in their order, when there are no more.
    """
    if len(points) <= count:
        return np.arange(len(points))
    coordinates = np.ascontiguousarray(points.T)
    squares, nearest = np.empty_like(coordinates), np.full(len(points), np.finfo(np.float32).max, np.float32)
    total, picked, current = squares[0], np.empty(count, np.int64), 0
    for k in range(count):
        picked[k] = current
        nearest[current] = -1.0
        np.subtract(coordinates, coordinates[:, current, None], out=squares)
        np.multiply(squares, squares, out=squares)
        np.add(total, squares[1], out=total)
        np.add(total, squares[2], out=total)
        np.minimum(nearest, total, out=nearest)
        current = int(nearest.argmax())
    return picked


def angles_of(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Elevation and azimuth, rad in [0, 2 pi), of points (n, 3); (n,) float32 each, from float64 as in training."""
    x, y, z = points.astype(np.float64).T
    azimuth = np.arctan2(y, x)
    azimuth[azimuth < 0.0] += 2.0 * math.pi
    azimuth = azimuth.astype(np.float32)
    azimuth[azimuth >= 2.0 * _PI] = 0.0
    return np.arctan2(z, np.sqrt(x * x + y * y)).astype(np.float32), azimuth


def sort_keys(theta: np.ndarray, phi: np.ndarray, ring: np.float32) -> np.ndarray:
    """(elevation ring, azimuth) as one integer, the azimuth in 65536 steps from -pi."""
    row = np.clip(np.floor((theta + _PI / 2) / ring), 0, _MAX_RING).astype(np.int32)
    turn = (phi + _PI) / (2 * _PI)
    turn -= np.floor(turn)
    column = np.minimum((turn * np.float32(1 << _PHI_BITS)).astype(np.int32), (1 << _PHI_BITS) - 1)
    return (row << _PHI_BITS) | column


def rotation_matrix(quat: ArrayLike) -> np.ndarray:
    """(3, 3) float64 of a quaternion (w, x, y, z), which is normalised."""
    w, x, y, z = np.asarray(quat, np.float64) / np.linalg.norm(quat)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def down(quat: np.ndarray) -> np.ndarray:
    """(3,) unit vector of gravity in a frame of orientation quat (w, x, y, z), which is of length 1."""
    w, x, y, z = quat
    return np.array([2 * (w * y - x * z), -2 * (w * x + y * z), 2 * (x * x + y * y) - 1])


def without_heading(base: np.ndarray) -> np.ndarray:
    """The base's rotation without its heading."""
    yaw = math.atan2(base[1, 0], base[0, 0])
    cos, sin = math.cos(yaw), math.sin(yaw)
    return np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]]) @ base
