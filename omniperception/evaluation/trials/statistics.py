"""Statistics of counted outcomes."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from omniperception.common.statistics import Z_95, wilson


def rate(happened: torch.Tensor) -> dict:
    """Count, rate and its 95 % Wilson interval of a (n,) bool tensor."""
    count = int(happened.sum())
    low, high = wilson(count, len(happened))
    return {"count": count, "rate": count / max(len(happened), 1), "low": low, "high": high}


def pooled(by_seed: Sequence[torch.Tensor]) -> dict:
    """Rate over the trials of all training seeds, with the lowest and the highest of the seeds' own rates.

    Wilson's interval takes trials as independent; `least` and `most` show how much seeds differ.

    Args:
        by_seed: (n_i,) bool for each seed.
    """
    rates = [float(happened.double().mean()) for happened in by_seed]
    return {**rate(torch.cat(list(by_seed))), "least": min(rates), "most": max(rates), "seeds": len(rates)}


def paired_difference(ours: torch.Tensor, theirs: torch.Tensor, z: float = Z_95) -> dict:
    """Difference of two rates on the same trials, with Agresti and Min's adjusted Wald interval.

    The interval looks only at the trials in which the two differ, with half a trial added to each of the four cells of
    the 2 x 2 table (Agresti and Min, Statistics in Medicine 24, 2005); `difference` itself is as counted.

    Args:
        ours, theirs: (n,) bool, in the same order of trials.
        z: quantile of the standard normal distribution; the default gives 95 %.
    """
    gained, lost, n = int((ours & ~theirs).sum()), int((~ours & theirs).sum()), len(ours)
    b, c, total = gained + 0.5, lost + 0.5, n + 2.0
    centre = (b - c) / total
    half = z * math.sqrt(b + c - (b - c) ** 2 / total) / total
    return {
        "difference": (gained - lost) / max(n, 1),
        "low": max(centre - half, -1.0),
        "high": min(centre + half, 1.0),
    }


def quantiles(values: torch.Tensor | None) -> dict | None:
    """Mean, median and 5 % to 95 % quantiles of a (n,) tensor; None where there is nothing to describe."""
    if values is None or len(values) == 0:
        return None
    p05, median, p95 = torch.quantile(values.double(), torch.tensor([0.05, 0.5, 0.95], dtype=torch.float64)).tolist()
    return {"mean": float(values.double().mean()), "p05": p05, "median": median, "p95": p95}
