"""Provenance names the commit, the command and the versions, wherever it is written."""

import subprocess
import sys
from pathlib import Path

from omniperception.common import provenance

ROOT = Path(__file__).resolve().parents[1]


def git(folder, *arguments):
    identity = ("-c", "user.name=n", "-c", "user.email=n@example.org")
    return subprocess.run(["git", *identity, *arguments], cwd=folder, check=True, capture_output=True, text=True).stdout


def test_commit_is_that_of_the_checkout_and_marks_changes(tmp_path):
    assert provenance.commit(tmp_path) is None  # not a checkout
    git(tmp_path, "init")
    (tmp_path / "a").write_text("1")
    git(tmp_path, "add", "a")
    git(tmp_path, "commit", "-m", "first")
    head = git(tmp_path, "rev-parse", "HEAD").strip()
    provenance.commit.cache_clear()
    assert provenance.commit(tmp_path) == head
    (tmp_path / "a").write_text("2")
    provenance.commit.cache_clear()
    assert provenance.commit(tmp_path) == f"{head}+changes"


def test_entries(monkeypatch):
    monkeypatch.setattr(sys, "argv", [str(ROOT / "scripts" / "stability.py"), "subject=lidar", "out=a b"])
    found = provenance.provenance("cpu", ("numpy", "no-such-distribution"), seed=3)
    assert found["command"] == "scripts/stability.py subject=lidar 'out=a b'" and found["seed"] == 3
    assert set(found["versions"]) == {"python", "numpy"} and found["machine"]["device"] == "cpu"
    monkeypatch.setattr(sys, "argv", [str(ROOT / "omniperception" / "__main__.py"), "runs"])  # python -m omniperception
    assert provenance.command() == "omniperception runs"
