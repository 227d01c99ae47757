"""Fixtures of these tests; helpers beside the tests are importable by name."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture(autouse=True)
def own_folder(tmp_path, monkeypatch):
    """MuJoCo logs a diverged simulation to the working directory."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module")
def run(make_config):
    return make_config("obstacles=static")
