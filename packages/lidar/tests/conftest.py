"""Fixtures of the LiDAR's tests."""

import pytest

from omnilidar import mid360


@pytest.fixture(scope="session")
def pattern():
    """A Mid-360's scan: 800,000 rows, 200,000 points/s, four lasers."""
    return mid360()
