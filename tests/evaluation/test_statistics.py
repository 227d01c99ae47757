"""Intervals against values from the closed formulas, and against how often they hold."""

import pytest
import torch

from omniperception.common.statistics import wilson
from omniperception.evaluation.trials.statistics import paired_difference, pooled


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    [
        (0, 0, 0.0, 1.0),  # no trials say nothing
        (0, 10, 0.0, 0.277533),  # high = z^2 / (n + z^2) = 3.841459 / 13.841459
        (10, 10, 1.0 - 0.277533, 1.0),
        # centre 1/2; half width = z sqrt(1/40 + 3.841459/400) / 1.3841459 = 1.959964 * 0.186021 / 1.3841459
        (5, 10, 0.236593, 0.763407),
        # centre = (0.9 + 3.841459/60) / 1.1280486; half width = 1.959964 sqrt(0.003 + 0.00106707) / 1.1280486
        (27, 30, 0.854595 - 0.110805, 0.854595 + 0.110805),
        (3, 30, 1.0 - (0.854595 + 0.110805), 1.0 - (0.854595 - 0.110805)),
    ],
)
def test_intervals_by_hand(successes, trials, low, high):
    assert wilson(successes, trials) == pytest.approx((low, high), abs=2e-6)
    assert wilson(successes, trials)[0] >= 0.0 and wilson(successes, trials)[1] <= 1.0


def test_pooled_rates_by_hand():
    rate = pooled([torch.arange(10) < 8, torch.arange(10) < 4])
    assert (rate["rate"], rate["least"], rate["most"], rate["seeds"]) == (0.6, pytest.approx(0.8 - 0.4), 0.8, 2)
    assert rate["low"] == pytest.approx(0.3866, abs=1e-4) and rate["high"] == pytest.approx(0.7812, abs=1e-4)


def test_paired_differences_by_hand():
    """Of 20 trials 6 are won by the first alone, 1 by the second alone."""
    ours, theirs = torch.arange(20) < 10, (torch.arange(20) >= 6) & (torch.arange(20) < 11)
    got = paired_difference(ours, theirs)
    assert got["difference"] == 0.25
    # (6.5 - 1.5) / 22 = 0.227273; half width = 1.959964 sqrt(7 + 1 - 25 / 22) / 22 = 0.233401
    assert (got["low"], got["high"]) == pytest.approx((-0.006128, 0.460674), abs=2e-6)


def test_paired_intervals_hold_as_often_as_they_say():
    """4000 pairs of 60 trials, of which 25 % are won by one alone and 10 % by the other alone."""
    draws = torch.rand(4000, 60, generator=torch.Generator().manual_seed(1))
    held = 0
    for draw in draws:
        got = paired_difference((draw < 0.25) | (draw > 0.8), ((draw >= 0.25) & (draw < 0.35)) | (draw > 0.8))
        held += got["low"] <= 0.15 <= got["high"]
    assert 0.935 < held / len(draws) < 0.975
