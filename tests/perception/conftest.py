"""Helpers beside the tests are importable by name."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import pytest

from omniperception.perception.samplers import by_ray


@pytest.fixture(params=["a thread per environment", "a thread per ray"])
def each_way(request, monkeypatch):
    """Runs a test with the kernels of a CPU and, on the CPU, too, with those of a GPU."""
    if request.param == "a thread per ray":
        monkeypatch.setattr(by_ray, "USED_ON", ("cpu",))
