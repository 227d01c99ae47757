"""Figures of the method: distances to discs by hand, and pictures that are written."""

import math

import pytest
import torch

from benchmarks.figures import command, disc_distances


def test_distances_to_discs():
    bearings = torch.tensor([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]])
    distances = disc_distances([(2.0, 0.0, 0.5), (3.0, 0.0, 0.5), (0.3, 2.0, 0.5)], bearings)
    assert distances.tolist() == pytest.approx([1.5, 2.0 - math.sqrt(0.25 - 0.09), math.inf])


def test_pictures_are_written(tmp_path, capsys):
    pytest.importorskip("matplotlib")
    command([f"out={tmp_path}"])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["avoidance.png", "framework.png"]
    assert all(path.stat().st_size > 20_000 for path in tmp_path.iterdir())
