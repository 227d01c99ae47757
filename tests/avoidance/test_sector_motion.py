"""Obstacles by sector as numbers to regress on, by hand and there and back."""

import math

import pytest
import torch

from omniperception.avoidance.sector_motion import decode, encode, motion_error, nothing_near


def test_encoding_by_hand():
    sectors = nothing_near(1, 4)
    sectors[0, 2] = torch.tensor([1.0, 1.0, 0.0])  # the sector around 45 degrees, 1 m away, moving along x
    motion = encode(sectors)[0]
    assert motion[2].tolist() == pytest.approx([0.75, math.sqrt(0.5), -math.sqrt(0.5)], abs=1e-6)
    assert not motion[[0, 1, 3]].any()


def test_there_and_back():
    sectors = torch.cat((3.7 * torch.rand(5, 36, 1), torch.randn(5, 36, 2)), -1)
    assert torch.allclose(decode(encode(sectors)), sectors, atol=1e-5)
    assert decode(encode(nothing_near(2, 36)))[..., 0].isinf().all()


def test_error_by_hand():
    target = torch.tensor([[[0.5, 1.0, 0.0], [0.0, 0.0, 0.0]]])
    predicted = torch.tensor([[[0.3, 0.0, 2.0], [0.1, 9.0, 9.0]]])
    expected = ((0.04 + 0.5 * (1.0 + 4.0)) + 0.01) / 2  # where nothing is, a velocity says nothing
    assert motion_error(predicted, target).item() == pytest.approx(expected)
