"""Spinning sensors: channel tables, columns, firing times, and angles as functions of time."""

import numpy as np
import pytest
import torch

from omnilidar import airy, hdl32e, hdl64e, os0, os1, os2, ouster, spinning, vlp16, vlp32c, xt16, xt32

MAKERS = {make.__name__: make for make in (hdl64e, hdl32e, vlp16, vlp32c, os1, xt32, xt16, airy)}


@pytest.fixture(scope="module")
def patterns():
    return {name: make() for name, make in MAKERS.items()}


def channels(pattern):
    """Elevations of one column, deg."""
    return np.degrees(pattern.elevation[: pattern.num_lasers].double().numpy())


def azimuth_deg(pattern):
    return np.degrees(pattern.azimuth.double().numpy())


@pytest.mark.parametrize("name", MAKERS)
def test_columns_hold_every_channel_and_turn_clockwise_evenly_without_duplicate_at_360_deg(patterns, name):
    pattern = patterns[name]
    columns = pattern.elevation.reshape(-1, pattern.num_lasers)
    assert torch.equal(columns, columns[:1].expand_as(columns))
    assert torch.allclose(torch.linalg.vector_norm(pattern.directions_s, dim=1), torch.ones(1), atol=1e-6)
    laser = azimuth_deg(pattern)[:: pattern.num_lasers]  # one laser, column after column
    steps = np.mod(-np.diff(np.append(laser, laser[0])), 360.0)
    assert steps == pytest.approx(np.full(len(steps), steps.mean()), abs=1e-4)
    turns = steps.sum() / 360.0
    assert turns == pytest.approx(round(turns), abs=1e-6)
    assert turns / pattern.duration_s == pytest.approx(10.0, rel=3e-6)
    assert len(np.unique(np.round(np.mod(laser, 360.0), 4))) == len(laser)


def test_hdl64e_is_uneven():
    elevation = np.sort(channels(hdl64e()))[::-1]
    assert elevation[:32] == pytest.approx([2.0 - k / 3.0 for k in range(32)], abs=1e-5)
    assert elevation[32:] == pytest.approx([-8.83 - 0.5 * k for k in range(32)], abs=1e-5)


def test_hdl32e_fires_two_banks_in_turn_from_the_lowest():
    elevation = channels(hdl32e())
    assert elevation[:4] == pytest.approx([-30.67, -9.33, -29.33, -8.0], abs=0.005)
    assert elevation[30:] == pytest.approx([-10.67, 10.67], abs=0.005)
    assert np.diff(np.sort(elevation)) == pytest.approx(np.full(31, 4.0 / 3.0), abs=1e-5)


def test_vlp16_fires_in_the_manuals_order_and_turns_meanwhile():
    pattern = vlp16()
    assert channels(pattern) == pytest.approx([-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15], abs=1e-5)
    turned = np.mod(-azimuth_deg(pattern)[:17], 360.0)
    assert turned[15] == pytest.approx(3600.0 * 15 * 2.304e-6, rel=1e-3)
    assert turned[16] == pytest.approx(3600.0 * 55.296e-6, rel=1e-3)  # the next cycle, after a pause


def test_vlp32c_has_uneven_channels_in_four_columns():
    pattern = vlp32c()
    elevation = channels(pattern)
    assert (elevation.min(), elevation.max()) == pytest.approx((-25.0, 15.0), abs=1e-5)
    gaps = np.diff(np.sort(elevation))
    assert gaps[0] == pytest.approx(9.361, abs=1e-3) and gaps.min() == pytest.approx(0.333, abs=2e-3)
    assert gaps[-1] == pytest.approx(15.0 - 10.333, abs=1e-3)
    turned = np.mod(-azimuth_deg(pattern)[:32] + 180.0, 360.0) - 180.0
    offset = turned - 3600.0 * 2.304e-6 * (np.arange(32) // 2)
    assert sorted(set(np.round(offset, 2))) == [-4.2, -1.4, 1.4, 4.2]
    assert (offset[0], elevation[0]) == pytest.approx((1.4, -25.0), abs=1e-3)  # laser 0 of the manual's table
    assert (offset[5], elevation[5]) == pytest.approx((-1.4, 0.0), abs=1e-3)


@pytest.mark.parametrize(("make", "half"), [(os0, 45.0), (os1, 22.5), (os2, 11.25)])
@pytest.mark.parametrize("count", [32, 64, 128])
@pytest.mark.parametrize(
    ("mode", "columns", "hertz"),
    [("512x10", 512, 10), ("1024x10", 1024, 10), ("2048x10", 2048, 10), ("512x20", 512, 20), ("1024x20", 1024, 20)],
)
def test_ouster_channels_and_modes(make, half, count, mode, columns, hertz):
    pattern = make(count, mode)
    assert pattern.num_rows == count * columns and pattern.points_per_second == pytest.approx(count * columns * hertz)
    assert channels(pattern) == pytest.approx([half - i * 2 * half / (count - 1) for i in range(count)], abs=1e-5)
    assert pattern.rows_per_shot == count  # all channels of a column at once
    beam = azimuth_deg(pattern)[::count]
    assert np.mod(-np.diff(beam), 360.0) == pytest.approx(np.full(columns - 1, 360.0 / columns), abs=1e-4)


def test_ouster_beams_stand_in_columns():
    for count, columns in ((128, 4), (64, 2), (32, 1)):
        offset = np.mod(-azimuth_deg(os1(count))[:count] + 180.0, 360.0) - 180.0
        assert len(set(np.round(offset, 2))) == columns
    offset = np.mod(-azimuth_deg(os1(128))[:4] + 180.0, 360.0) - 180.0
    assert offset == pytest.approx([4.25, 1.42, -1.42, -4.25], abs=1e-4)


def test_hesai_xt_channels_and_firing_times():
    assert channels(xt32()) == pytest.approx(np.arange(15.0, -17.0, -1.0), abs=1e-5)
    assert channels(xt16()) == pytest.approx(np.arange(15.0, -16.0, -2.0), abs=1e-5)
    for pattern, last in ((xt32(), 31 * 1.512e-6), (xt16(), 15 * 3.024e-6)):
        turned = np.mod(-azimuth_deg(pattern)[: pattern.num_lasers + 1], 360.0)
        assert turned[-2] == pytest.approx(3600.0 * last, abs=1e-4)
        assert turned[-1] == pytest.approx(0.18, abs=1e-4)  # the manual's resolution at 10 Hz


def test_airy_covers_a_hemisphere():
    pattern = airy()
    assert channels(pattern) == pytest.approx(np.linspace(0.0, 90.0, 96), abs=1e-4)
    assert pattern.num_rows == 96 * 900
    turned = np.mod(-azimuth_deg(pattern)[:97], 360.0)
    assert turned[:8] == pytest.approx(np.zeros(8), abs=1e-5) and turned[96] == pytest.approx(0.4, abs=1e-4)
    assert turned[95] == pytest.approx(3600.0 * 97.104e-6, abs=1e-4)


def test_twice_the_turning_rate_halves_the_columns():
    slow, fast = xt32(10.0), xt32(20.0)
    assert fast.num_rows * 2 == slow.num_rows and fast.points_per_second == slow.points_per_second
    one_turn = np.mod(-azimuth_deg(vlp16(5.0))[:: 16 * 3617], 360.0)  # 0.2 s / 55.296 us columns a turn
    assert np.minimum(one_turn, 360.0 - one_turn).max() < 0.1


def test_a_ray_looks_where_its_laser_is_at_its_time():
    """Row i of a device that fires without pause: azimuth = -2 pi f i / rate."""
    pattern = spinning([10.0, -10.0], frame_hz=5.0, cycle_s=0.002, fire_s=[0.001, 0.0])
    assert np.degrees(pattern.elevation[:2].numpy()) == pytest.approx([-10.0, 10.0], abs=1e-5)
    time = np.arange(pattern.num_rows) / pattern.points_per_second
    expected = np.mod(-360.0 * 5.0 * time, 360.0)
    assert np.cos(np.radians(azimuth_deg(pattern) - expected)) == pytest.approx(np.ones(len(time)), abs=1e-9)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ouster("OS7"), "model='OS7' must be one of OS0, OS1, OS2"),
        (lambda: vlp16(30.0), "lidar.pattern.frame_hz=30.0 must be in 5..20"),
        (lambda: spinning([0.0], 10.0, 1e-4, [2e-4]), "fire_s must lie within"),
    ],
)
def test_wrong_devices_are_refused_in_one_line(make, message):
    with pytest.raises(ValueError, match=message) as error:
        make()
    assert "\n" not in str(error.value)
