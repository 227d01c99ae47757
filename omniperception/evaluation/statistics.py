"""Statistics of counted outcomes."""

from __future__ import annotations

import math

import torch

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


def rate(happened: torch.Tensor) -> dict:
    """Count, rate and its 95 % Wilson interval of a (n,) bool tensor."""
    count = int(happened.sum())
    low, high = wilson(count, len(happened))
    return {"count": count, "rate": count / max(len(happened), 1), "low": low, "high": high}


def quantiles(values: torch.Tensor | None) -> dict | None:
    """Mean, median and 5 % to 95 % quantiles of a (n,) tensor; None where there is nothing to describe."""
    if values is None or len(values) == 0:
        return None
    p05, median, p95 = torch.quantile(values.double(), torch.tensor([0.05, 0.5, 0.95], dtype=torch.float64)).tolist()
    return {"mean": float(values.double().mean()), "p05": p05, "median": median, "p95": p95}
