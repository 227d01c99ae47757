"""Wilson intervals against values from the closed formula."""

import pytest

from omniperception.evaluation import wilson


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


def test_more_successes_than_trials():
    with pytest.raises(ValueError, match="successes=4"):
        wilson(4, 3)
