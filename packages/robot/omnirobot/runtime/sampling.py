"""The samplers of `omniperception.perception` for one robot's cloud, in NumPy."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

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


class CloudSampler(ABC):
    """Reduces one frame of points to a fixed number.

    Attributes:
        num_points: P.
        max_range: m; points beyond are misses, and sampled points are divided by it.
    """

    num_points: int
    max_range: float

    @abstractmethod
    def __call__(self, points: np.ndarray, attitude: Attitude) -> np.ndarray:
        """(P, 3) float32 from (n, 3) float32 points (m, sensor frame) in the order of their measurement.

        A row that is not finite, zero, or beyond the maximum range is a miss.
        """

    def _is_hit(self, points: np.ndarray) -> np.ndarray:
        """(n,) bool."""
        square = np.einsum("ij,ij->i", points, points)
        return (square > 0.0) & (square <= np.float32((self.max_range * _ROUNDING) ** 2))  # false for nan


class RawSampler(CloudSampler):
    """Every ray's point in ray order, a miss as zeros."""

    def __init__(self, num_points: int, max_range: float) -> None:
        """Args: num_points: rays; max_range: m."""
        self.num_points, self.max_range = num_points, max_range

    def __call__(self, points: np.ndarray, attitude: Attitude) -> np.ndarray:
        """See :meth:`CloudSampler.__call__`."""
        if len(points) != self.num_points:
            raise DeployError(
                f"points: this network reads every ray, also misses (as zeros): ({self.num_points}, 3) was expected,"
                f" ({len(points)}, 3) given; thin() reduces a device's whole frame"
            )
        return np.where(self._is_hit(points)[:, None], points * np.float32(1.0 / self.max_range), np.float32(0.0))


class PdSampler(CloudSampler):
    """Proximal points by farthest point sampling, distal points as means of bins, as in training's `PdSampler`."""

    def __init__(
        self,
        num_proximal: int,
        num_distal: int,
        max_range: float,
        split: float | None,
        ring: float,
    ) -> None:
        """Configure both halves.

        Args:
            num_proximal: slots of the proximal half, written first.
            num_distal: slots of the distal half.
            max_range: m.
            split: elevation in the sensor frame above which a point is proximal, rad; None: every point is.
            ring: height of an elevation ring for sorting, rad.
        """
        self.num_points, self.max_range = num_proximal + num_distal, max_range
        self.num_proximal, self.num_distal = num_proximal, num_distal
        self.split = np.float32(-math.inf if split is None else split)
        self.ring = np.float32(ring)

    def __call__(self, points: np.ndarray, attitude: Attitude) -> np.ndarray:
        """See :meth:`CloudSampler.__call__`."""
        points = points[self._is_hit(points)]
        near = self._is_proximal(points)
        sampled = np.zeros((self.num_points, 3), np.float32)
        self._write_proximal(sampled, points[near])
        self._write_distal(sampled[self.num_proximal :], points, near, attitude)
        return sampled

    def _is_proximal(self, points: np.ndarray) -> np.ndarray:
        """(n,) bool: the elevation is above the split. Angles, which are slow, decide only where rounding could."""
        if self.split == -math.inf:
            return np.ones(len(points), bool)
        x, y, z = points.T
        sin, cos = np.sin(self.split), np.cos(self.split)
        above = z * cos - np.sqrt(x * x + y * y) * sin  # m, from the cone of this elevation
        near = above > 0.0
        doubtful = np.flatnonzero(abs(above) < np.float32(1e-6 * self.max_range))
        near[doubtful] = angles_of(points[doubtful])[0] > self.split
        return near

    def _write_proximal(self, out: np.ndarray, points: np.ndarray) -> None:
        if not self.num_proximal:
            return
        scaled = self._scaled(points)
        picked = farthest_points(scaled, self.num_proximal)
        out[: len(picked)] = scaled[picked[self._ring_order(points[picked])]]

    def _write_distal(self, out: np.ndarray, points: np.ndarray, near: np.ndarray, attitude: Attitude) -> None:
        """Writes the other half of a frame from hits (n, 3), of which `near` (n,) are proximal."""
        points = points[~near]
        bins = min(len(points), self.num_distal)
        if not bins:
            return
        ordered = self._scaled(points)[self._ring_order(points)]
        edges = np.arange(bins + 1) * len(points) // bins
        first, size = edges[:-1], np.diff(edges)
        out[:bins] = np.add.reduceat(ordered, first, axis=0) / size[:, None].astype(np.float32)

    def _scaled(self, points: np.ndarray) -> np.ndarray:
        return points * np.float32(1.0 / self.max_range)

    def _ring_order(self, points: np.ndarray) -> np.ndarray:
        """(n,) indices that sort points by ring of elevation, then azimuth."""
        return np.argsort(sort_keys(*angles_of(points), self.ring), kind="stable")


class ProximitySampler(PdSampler):
    """Proximal points as above; the distal half as proximities around the without_heading base, as in training."""

    def __init__(
        self,
        num_proximal: int,
        num_sectors: int,
        max_range: float,
        split: float,
        ring: float,
        band_edges: Sequence[float],
        decay: float,
        blind: float,
        body: Sequence[float],
    ) -> None:
        """Configure both halves.

        Args:
            num_proximal: slots of the proximal half, written first.
            num_sectors: azimuth sectors.
            max_range: m.
            split: elevation in the sensor frame above which a point is proximal, rad.
            ring: height of an elevation ring for sorting the proximal half, rad.
            band_edges: heights that separate the bands, m above the base's origin.
            decay: distance over which the proximity falls by e, m.
            blind: nearest distance that counts, m.
            body: half length and half width of the robot's own body, m.
        """
        super().__init__(num_proximal, num_sectors * (len(band_edges) - 1), max_range, split, ring)
        self.num_sectors, self.decay, self.blind = num_sectors, decay, blind
        self.edges, self.body = np.asarray(band_edges, np.float32), tuple(body)

    def _write_distal(self, out: np.ndarray, points: np.ndarray, near: np.ndarray, attitude: Attitude) -> None:
        points = points[~near]
        level = without_heading(rotation_matrix(attitude.base_quat))
        turn = (level @ rotation_matrix(attitude.mount_quat)).astype(np.float32)
        offset = (level @ np.asarray(attitude.mount_pos, np.float64)).astype(np.float32)
        at = points[np.linalg.norm(points, axis=1) >= np.float32(self.blind)] @ turn.T + offset
        on_body = (abs(at[:, 0]) < self.body[0]) & (abs(at[:, 1]) < self.body[1])
        at = at[~on_body & (at[:, 2] >= self.edges[0]) & (at[:, 2] < self.edges[-1])]
        band = np.searchsorted(self.edges, at[:, 2], side="right") - 1
        write_nearest(out, at[:, :2], band, self.num_sectors, self.decay)


class StandingSampler(CloudSampler):
    """Proximities of what stands on the ground, by band of height and sector, as in training."""

    def __init__(
        self,
        num_sectors: int,
        max_range: float,
        band_edges: Sequence[float],
        decay: float,
        geometry: Mapping,
    ) -> None:
        """Configure the cells.

        Args:
            num_sectors: azimuth sectors.
            max_range: m.
            band_edges: heights that separate the bands, m above the ground.
            decay: distance over which the proximity falls by e, m.
            geometry: settings of training's `GeometryConfig`, by name.
        """
        self.num_points, self.max_range = num_sectors * (len(band_edges) - 1), max_range
        self.num_sectors, self.decay, self.geometry = num_sectors, decay, dict(geometry)
        self.edges = np.asarray(band_edges, np.float32)

    def __call__(self, points: np.ndarray, attitude: Attitude) -> np.ndarray:
        """See :meth:`CloudSampler.__call__`."""
        points = points[self._is_hit(points)]
        mount, level = rotation_matrix(attitude.mount_quat), without_heading(rotation_matrix(attitude.base_quat))
        sensor = np.asarray(attitude.mount_pos, np.float64)
        in_base = points @ mount.T.astype(np.float32) + sensor.astype(np.float32)
        places, height = standing(in_base, np.linalg.norm(points, axis=1), level, sensor, self.geometry)
        counts = (height >= self.edges[0]) & (height < self.edges[-1])
        band = np.searchsorted(self.edges, height[counts], side="right") - 1
        sampled = np.zeros((self.num_points, 3), np.float32)
        write_nearest(sampled, places[counts, :2], band, self.num_sectors, self.decay)
        return sampled


def write_nearest(out: np.ndarray, places: np.ndarray, band: np.ndarray, num_sectors: int, decay: float) -> None:
    """Writes the nearest place of each cell: its bearing times its proximity, and the proximity.

    Args:
        out: (bands * S, 3), zeros.
        places: (n, 2) m, around the base.
        band: (n,) of each place.
        num_sectors: S.
        decay: distance over which the proximity falls by e, m.
    """
    cell = band * num_sectors + sector_of(places, num_sectors)
    horizontal = np.sqrt(np.square(places).sum(1))
    least = np.full(len(out), np.inf, np.float32)
    np.minimum.at(least, cell, horizontal)
    nearest = np.flatnonzero(horizontal == least[cell])[::-1]  # of equally near ones the first measured is kept
    proximity = np.exp(-horizontal[nearest] / np.float32(decay))
    bearing = places[nearest] * (proximity / np.maximum(horizontal[nearest], np.float32(1e-6)))[:, None]
    out[cell[nearest]] = np.concatenate((bearing, proximity[:, None]), 1)


_KINDS = {"raw": RawSampler, "pd": PdSampler, "proximity": ProximitySampler, "standing": StandingSampler}


def make_sampler(parameters: Mapping) -> CloudSampler:
    """The sampler that a description names: its `kind`, one of `_KINDS`, and its arguments."""
    arguments = dict(parameters)
    kind = arguments.pop("kind", None)
    if kind not in _KINDS:
        raise DeployError(f"sampler '{kind}' is unknown; known: {', '.join(_KINDS)}")
    try:
        return _KINDS[kind](**arguments)
    except TypeError as error:
        raise DeployError(f"sampler '{kind}': {error}; export the policy again") from None


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
