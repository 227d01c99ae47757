"""Fixtures of these tests."""

import pytest


@pytest.fixture(autouse=True)
def own_folder(tmp_path, monkeypatch):
    """MuJoCo logs a diverged simulation to the working directory."""
    monkeypatch.chdir(tmp_path)
