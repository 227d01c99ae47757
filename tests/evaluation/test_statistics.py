"""Wilson intervals against values from the closed formula."""

import pytest

from omniperception.evaluation import wilson


def test_no_success_in_ten():
    # low = 0; high = z^2 / (n + z^2) = 3.841459 / 13.841459
    assert wilson(0, 10) == pytest.approx((0.0, 0.277533), abs=1e-6)


def test_half_of_ten():
    # centre 1/2; half width = z sqrt(1/40 + 3.841459/400) / 1.3841459 = 1.959964 * 0.186021 / 1.3841459
    assert wilson(5, 10) == pytest.approx((0.236593, 0.763407), abs=1e-6)


def test_27_of_30():
    # centre = (0.9 + 3.841459/60) / 1.1280486 = 0.854595
    # half width = 1.959964 sqrt(0.003 + 0.00106707) / 1.1280486 = 0.110805
    centre, half = 0.854595, 0.110805
    assert wilson(27, 30) == pytest.approx((centre - half, centre + half), abs=2e-6)


def test_mirrored_rates_have_mirrored_intervals():
    low, high = wilson(3, 30)
    assert wilson(27, 30) == pytest.approx((1 - high, 1 - low), abs=1e-12)


def test_all_successes_end_at_one():
    assert wilson(10, 10)[1] == 1.0


def test_no_trials_tell_nothing():
    assert wilson(0, 0) == (0.0, 1.0)


def test_more_successes_than_trials():
    with pytest.raises(ValueError, match="successes=4"):
        wilson(4, 3)
