"""Noise of the LiDAR: parameters of each model.

They act in this order, whatever the order in which they are given: angular jitter turns the ray before it is cast;
mixed pixels, Gaussian, tabulated and distance noise change the distance of a hit, which then ends at the maximum range
and is no point below the minimum range; the mask replaces it; tabulated and plain dropout lose it. No model turns a
miss into a hit; a ray that jitter turns may hit what the nominal one would have missed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

MAX_SIGMAS = 5.0
"""Jitter ends here, so that a ray stays within known bounds; exp(-12.5), or 4 in a million, would go beyond."""


@dataclass(frozen=True)
class MaskNoise:
    """A random share of the hits gets a meaningless short distance, as in the paper.

    Attributes:
        ratio: Probability that a hit is replaced.
        low: Lower end of the uniform distance, metres; below the sensor's minimum range is allowed.
        high: Upper end, metres.
    """

    ratio: float = 0.1
    low: float = 0.0
    high: float = 0.3

    def __post_init__(self) -> None:
        _require_share("mask.ratio", self.ratio)
        if not 0.0 <= self.low <= self.high < math.inf:
            raise ValueError(f"noise.mask.low={self.low} and high={self.high} must be 0 <= low <= high")


@dataclass(frozen=True)
class DistanceNoise:
    """Every hit's distance is multiplied by 1 + ratio * U(-1, 1), as in the paper.

    Attributes:
        ratio: Largest relative error.
    """

    ratio: float = 0.1

    def __post_init__(self) -> None:
        _require_share("distance.ratio", self.ratio)


@dataclass(frozen=True)
class GaussianNoise:
    """A normal variable of standard deviation sigma + sigma_per_metre * distance is added to every hit's distance.

    Attributes:
        sigma: Metres.
        sigma_per_metre: Metres per metre.
    """

    sigma: float = 0.02
    sigma_per_metre: float = 0.0

    def __post_init__(self) -> None:
        _require_amount("gaussian.sigma", self.sigma)
        _require_amount("gaussian.sigma_per_metre", self.sigma_per_metre)


@dataclass(frozen=True)
class AngularJitter:
    """Each ray is cast beside its nominal direction, and its distance is reported along the nominal one.

    The true ranges are those along the directions really cast: jitter is part of where the beam goes. The angle from
    the nominal direction is Rayleigh distributed (its tangent is), cut off at 5 ``sigma_deg``.

    Attributes:
        sigma_deg: Standard deviation along each of two axes across the ray, degrees.
    """

    sigma_deg: float = 0.05

    def __post_init__(self) -> None:
        _require_amount("jitter.sigma_deg", self.sigma_deg)
        if self.sigma_deg > 10.0:
            raise ValueError(f"noise.jitter.sigma_deg={self.sigma_deg} must be at most 10 degrees")


@dataclass(frozen=True)
class Dropout:
    """A hit is lost with probability ratio + ratio_per_metre * distance.

    Attributes:
        ratio: Probability at the sensor.
        ratio_per_metre: Increase per metre.
    """

    ratio: float = 0.0
    ratio_per_metre: float = 0.0

    def __post_init__(self) -> None:
        _require_share("dropout.ratio", self.ratio)
        _require_amount("dropout.ratio_per_metre", self.ratio_per_metre)


TABLE_BINS = 8
"""Most ranges that a `TabulatedNoise` tells apart."""


@dataclass(frozen=True)
class TabulatedNoise:
    """What recordings of a device show, by range: normal noise, and the probability that a hit is lost.

    It is constant from edge to edge. Outside of the edges there is no data: hits there are kept, with the maker's
    noise.

    Attributes:
        edges: Limits of the ranges, ascending, metres, (n + 1).
        sigma: Standard deviation of the distance, metres, (n).
        dropout: Probability that a hit is lost, (n).
        sigma_elsewhere: Standard deviation outside of the edges, metres.
    """

    edges: tuple[float, ...]
    sigma: tuple[float, ...]
    dropout: tuple[float, ...]
    sigma_elsewhere: float = 0.0

    def __post_init__(self) -> None:
        n = len(self.edges) - 1
        if not 1 <= n <= TABLE_BINS or len(self.sigma) != n or len(self.dropout) != n:
            raise ValueError(
                f"noise.table has {len(self.edges)} edges, {len(self.sigma)} sigma and {len(self.dropout)}"
                f" dropout; for n ranges (at most {TABLE_BINS}) they must be n + 1, n and n"
            )
        if not self.edges[0] >= 0.0 or any(a >= b for a, b in pairwise(self.edges)) or self.edges[-1] == math.inf:
            raise ValueError(f"noise.table.edges={self.edges} must ascend from 0 or more, and be finite")
        for sigma in (*self.sigma, self.sigma_elsewhere):
            _require_amount("table.sigma", sigma)
        for share in self.dropout:
            _require_share("table.dropout", share)


@dataclass(frozen=True)
class MixedPixels:
    """A beam that hits two surfaces at a depth edge measures a distance between them.

    A second ray is cast on the beam's rim, on a side that turns by the golden angle from row to row of the scan table:
    which rays are mixed is a function of the scene alone. Where both rays hit and their distances differ by more than
    ``min_gap`` and at most ``max_gap``, the distance is foreground * near + (1 - foreground) * far. Where the second
    ray hits nothing, so does that part of the beam, and the first ray's distance stands.

    Attributes:
        divergence_deg: Full opening angle of the beam, degrees.
        min_gap: Smaller differences are one surface seen at a slant, metres.
        max_gap: Larger differences are two echoes that the device tells apart, metres.
        foreground: Weight of the nearer surface, 0 to 1.
    """

    divergence_deg: float = 0.2
    min_gap: float = 0.1
    max_gap: float = 1.0e9
    foreground: float = 0.5

    def __post_init__(self) -> None:
        if not 0.0 < self.divergence_deg <= 10.0:
            raise ValueError(f"noise.mixed.divergence_deg={self.divergence_deg} must be in 0..10 degrees")
        if not 0.0 <= self.min_gap <= self.max_gap < math.inf:
            raise ValueError(
                f"noise.mixed.min_gap={self.min_gap} and max_gap={self.max_gap} must be 0 <= min_gap <= max_gap"
            )
        _require_share("mixed.foreground", self.foreground)


Noise = MaskNoise | DistanceNoise | GaussianNoise | AngularJitter | Dropout | TabulatedNoise | MixedPixels

NAMES = {
    MaskNoise: "mask",
    DistanceNoise: "distance",
    GaussianNoise: "gaussian",
    AngularJitter: "jitter",
    Dropout: "dropout",
    TabulatedNoise: "table",
    MixedPixels: "mixed",
}


def noise_by_name(noise: Sequence[Noise]) -> dict[str, Noise]:
    """The models by the names under which the kernels know them; at most one of each kind."""
    named: dict[str, Noise] = {}
    for model in noise:
        if type(model) not in NAMES:
            known = ", ".join(kind.__name__ for kind in NAMES)
            raise ValueError(f"noise={model!r} must be one of {known}")
        name = NAMES[type(model)]
        if name in named:
            raise ValueError(f"noise holds more than one {type(model).__name__}; give at most one of each kind")
        named[name] = model
    return named


def max_deviation(noise: Sequence[Noise]) -> float:
    """Largest angle between a nominal direction and one that is cast for it, rad."""
    angle = 0.0
    for model in noise:
        if isinstance(model, AngularJitter):
            angle += math.atan(MAX_SIGMAS * math.tan(math.radians(model.sigma_deg)))
        elif isinstance(model, MixedPixels):
            angle += math.radians(model.divergence_deg) / 2.0
    return angle


def _require_share(name: str, value: float) -> None:
    if not 0.0 <= value <= 1.0:
        raise ValueError(f"noise.{name}={value} must be in 0..1")


def _require_amount(name: str, value: float) -> None:
    if not 0.0 <= value < math.inf:
        raise ValueError(f"noise.{name}={value} must be >= 0 and finite")
