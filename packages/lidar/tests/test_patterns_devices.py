"""The parameters of every device against its pattern and its preset."""

import math
import re

import pytest
import torch

from omnilidar import DEVICES, LIVOX

WIDER = {"horizon": 3.2, "hap": 1.6}
"""Degrees by which the makers' tables are higher than their datasheets say."""


@pytest.fixture(scope="module", params=DEVICES)
def device(request):
    spec = DEVICES[request.param]
    return request.param, spec, spec.pattern()


def test_the_pattern_has_the_devices_field_of_view(device):
    name, spec, pattern = device
    low, high = (math.degrees(f(pattern.elevation)) for f in (torch.min, torch.max))
    assert high - low == pytest.approx(spec.elevation_deg[1] - spec.elevation_deg[0], abs=WIDER.get(name, 0.4))
    assert (low, high) == pytest.approx(spec.elevation_deg, abs=WIDER.get(name, 0.25))
    azimuth = torch.rad2deg(torch.atan2(pattern.directions_s[:, 1], pattern.directions_s[:, 0]))
    width = (azimuth.max() - azimuth.min()).item()
    assert width == pytest.approx(spec.horizontal_fov_deg, abs=0.6)


def test_the_pattern_has_the_devices_rate(device):
    _, spec, pattern = device
    assert pattern.points_per_second == pytest.approx(spec.points_per_second, rel=1e-9)
    assert spec.channels % pattern.num_lasers == 0
    whole = spec.points_per_second / spec.frame_hz
    assert pattern.points_per_frame(1.0 / spec.frame_hz) == pytest.approx(whole, abs=1.0)


def test_parameters_are_plausible_and_have_a_source(device):
    _, spec, _ = device
    assert 0.0 <= spec.min_range < spec.max_range and 0.0 < spec.range_sigma < 0.1
    assert spec.angle_sigma_deg is None or 0.0 < spec.angle_sigma_deg <= 0.15
    assert re.search("manual|datasheet|product page", spec.source)
    assert spec.name.split()[0] in spec.source


def test_every_livox_scanner_is_a_device():
    assert set(LIVOX) <= set(DEVICES)
