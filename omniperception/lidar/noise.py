"""Range noise of the LiDAR, as in the paper's sensor simulation."""

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class MaskNoise:
    """A random share of the hits gets a meaningless short distance.

    Attributes:
        ratio: Probability that a hit is replaced.
        low: Lower end of the uniform distance, metres.
        high: Upper end, metres.
    """

    ratio: float = 0.1
    low: float = 0.0
    high: float = 0.3

    def __post_init__(self) -> None:
        if not 0.0 <= self.ratio <= 1.0:
            raise ValueError(f"lidar.noise.mask.ratio={self.ratio} must be in 0..1")
        if not 0.0 <= self.low <= self.high < float("inf"):
            raise ValueError(f"lidar.noise.mask.low={self.low} and high={self.high} must be 0 <= low <= high")


@dataclass(frozen=True)
class DistanceNoise:
    """Every hit's distance is multiplied by 1 + ratio * U(-1, 1).

    Attributes:
        ratio: Largest relative error.
    """

    ratio: float = 0.1

    def __post_init__(self) -> None:
        if not 0.0 <= self.ratio <= 1.0:
            raise ValueError(f"lidar.noise.distance.ratio={self.ratio} must be in 0..1")


Noise = MaskNoise | DistanceNoise


def noise_parameters(noise: Sequence[Noise]) -> tuple[float, float, float, float]:
    """(distance ratio, mask ratio, mask low, mask high) of at most one noise of each kind; 0 for none."""
    for kind in (MaskNoise, DistanceNoise):
        if sum(isinstance(item, kind) for item in noise) > 1:
            raise ValueError(f"lidar.noise holds more than one {kind.__name__}; give at most one of each kind")
    unknown = [item for item in noise if not isinstance(item, (MaskNoise, DistanceNoise))]
    if unknown:
        raise ValueError(f"lidar.noise={unknown} must be MaskNoise or DistanceNoise")
    distance_ratio, mask = 0.0, (0.0, 0.0, 0.0)
    for item in noise:
        if isinstance(item, MaskNoise):
            mask = (item.ratio, item.low, item.high)
        else:
            distance_ratio = item.ratio
    return (distance_ratio, *mask)
