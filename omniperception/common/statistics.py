"""Interval of a rate."""

import math

Z_95 = 1.959963984540054
"""Two-sided 95 % quantile of the standard normal distribution."""


def wilson(successes: int, trials: int, z: float = Z_95) -> tuple[float, float]:
    """Wilson's score interval (low, high) of a rate.

    Args:
        successes: how often it happened.
        trials: how often it could have happened; with none the interval is (0, 1).
        z: quantile of the standard normal distribution; the default gives 95 %.
    """
    if not 0 <= successes <= trials:
        raise ValueError(f"successes={successes} must lie in 0..trials={trials}")
    if trials == 0:
        return 0.0, 1.0
    rate, z2 = successes / trials, z * z
    centre = rate + z2 / (2 * trials)
    half = z * math.sqrt(rate * (1 - rate) / trials + z2 / (4 * trials * trials))
    scale = 1 + z2 / trials
    low = 0.0 if successes == 0 else (centre - half) / scale
    high = 1.0 if successes == trials else (centre + half) / scale
    return low, high
