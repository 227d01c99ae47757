"""The order of the tests is drawn, numbers are the same in any."""

import random

import numpy as np
import pytest


def pytest_configure(config):
    config.option.randomly_reset_seed = False


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    random.seed(0)
    np.random.seed(0)
