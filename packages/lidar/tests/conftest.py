"""Fixtures of the LiDAR's tests. The order of the tests is drawn, numbers are the same in any."""

import random

import numpy as np
import pytest
import torch

from omnilidar import mid360


def pytest_configure(config):
    config.option.randomly_reset_seed = False


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    random.seed(0)
    np.random.seed(0)
    torch.manual_seed(0)


@pytest.fixture(scope="session")
def pattern():
    """A Mid-360's scan: 800,000 rows, 200,000 points/s, four lasers."""
    return mid360()
