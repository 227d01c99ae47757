"""Frames by the points' times, and drivers' messages as bytes laid out by hand."""

import re
import struct

import numpy as np
import pytest
from messages_by_hand import LIVOX, XYZ, point_cloud2, text

from omnirobot.runtime import DeployError
from omnirobot.wire import lidar
from omnirobot.wire.clouds import (
    Extrinsic,
    FrameCutter,
    Points,
    read_custom_msg,
    read_point_cloud2,
    without_noise,
)
from omnirobot.wire.lidar import LidarSource

MS = 10**6


def at(*times_ms):
    """Points at these times, each with its time as x."""
    times = np.array(times_ms, float)
    points = np.stack((times, np.zeros_like(times), np.zeros_like(times)), 1).astype(np.float32)
    return Points(points, np.rint(times * MS).astype(np.int64))


class TestFrames:
    """Periods of 100 ms that begin with the first point."""

    def test_points_go_into_the_period_of_their_time(self):
        cutter = FrameCutter(0.1)
        assert cutter.add(at(1000, 1050)) == []
        assert cutter.add(at(1099, 1101)) == []  # within the 2 ms that messages may be out of order
        (frame,) = cutter.add(at(1103))
        assert frame.points[:, 0].tolist() == [1000, 1050, 1099] and frame.start_ns == 1000 * MS
        assert frame.offsets_s.tolist() == pytest.approx([0.0, 0.05, 0.099])
        (frame,) = cutter.add(at(1205))
        assert frame.points[:, 0].tolist() == [1101, 1103] and frame.start_ns == 1100 * MS

    def test_messages_may_overtake_each_other(self):
        cutter = FrameCutter(0.1)
        cutter.add(at(1000)), cutter.add(at(1090)), cutter.add(at(1101)), cutter.add(at(1095))
        (frame,) = cutter.add(at(1102))
        assert frame.points[:, 0].tolist() == [1000, 1090, 1095] and cutter.late == 0
        cutter.add(at(1099))
        assert cutter.late == 1
        assert cutter.add(at(1202))[0].points[:, 0].tolist() == [1101, 1102]

    def test_a_period_without_points_gives_no_frame(self):
        cutter = FrameCutter(0.1)
        frames = [*cutter.add(at(1000)), *cutter.add(at(1350)), *cutter.add(at(1402))]
        assert [frame.start_ns // MS for frame in frames] == [1000, 1300]

    @pytest.mark.parametrize("jump", [-5000, 20000])
    def test_a_jump_of_the_clock_starts_again(self, jump):
        cutter = FrameCutter(0.1)
        cutter.add(at(10000, 10050))
        assert cutter.add(at(10000 + jump)) == [] and cutter.jumps == 1
        assert [f.start_ns // MS for f in cutter.add(at(10102 + jump))] == [10000 + jump]

    def test_a_time_that_is_far_from_the_others_holds_nothing_up(self):
        """1.7e10 periods are passed over at once, and the grid of periods stays."""
        cutter = FrameCutter(0.1)
        (frame,) = cutter.add(Points(np.ones((2, 3), np.float32), np.array([0, 17 * 10**17 + 150 * MS])))
        assert frame.start_ns == 0
        (frame,) = cutter.add(Points(np.ones((1, 3), np.float32), np.array([17 * 10**17 + 202 * MS])))
        assert frame.start_ns == 17 * 10**17 + 100 * MS

    def test_a_message_of_several_periods(self):
        frames = FrameCutter(0.1).add(at(*range(0, 320, 10)))
        assert [len(frame.points) for frame in frames] == [10, 10, 10]


def test_an_extrinsic_is_undone_and_misses_stay_misses():
    """A quarter turn to the left and 1 m up: what the driver calls (0, 2, 1) is 2 m ahead of the sensor."""
    half = np.sqrt(0.5)
    extrinsic = Extrinsic((0.0, 0.0, 1.0), (half, 0.0, 0.0, half))
    given = np.array([[0.0, 2.0, 1.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(extrinsic.undo(given), [[2, 0, 0], [0, 0, 0], [0, 0, 0]], atol=1e-6)


@pytest.mark.parametrize("parts", [{"pos": (0.0, float("nan"), 0.0)}, {"quat": (0.0, 0.0, 0.0, 0.0)}])
def test_an_extrinsic_that_is_none_is_refused(parts):
    with pytest.raises(DeployError, match="finite numbers were expected, and a quaternion other than 0"):
        Extrinsic(**parts)


def test_points_that_the_sensor_is_less_than_certain_of_are_misses():
    """A Mid-360's three fields of two bits: 0 is a normal point, 1 and 2 ever less certain; bits 6 and 7 are free."""
    tags = np.array([0, 1, 2, 1 << 2, 2 << 2, 1 << 4, 2 << 4, 0b100110, 0b11000000], np.uint8)
    assert without_noise(np.ones((9, 3), np.float32), tags)[:, 0].tolist() == [1, 0, 0, 0, 0, 0, 0, 0, 1]


def test_livox_ros_driver2s_point_cloud():
    """Its format 0: 26 bytes per point, times as float64 nanoseconds; nan is a miss."""
    rows = struct.pack("<ffffBBd", 1.0, 2.0, 3.0, 9.0, 0, 1, 5e9) + struct.pack(
        "<ffffBBd", *[np.nan] * 3, 9.0, 0, 1, 6e9
    )
    read = read_point_cloud2(point_cloud2(LIVOX, rows, 2, "some_frame"))
    assert read.points.tolist() == [[1, 2, 3], [0, 0, 0]] and read.times_ns.tolist() == [5 * 10**9, 6 * 10**9]


def test_times_after_the_header():
    rows = struct.pack("<ffff", 1.0, 2.0, 3.0, 0.25)
    assert read_point_cloud2(point_cloud2([*XYZ, ("time", 12, 7)], rows, 1)).times_ns.tolist() == [12_250_000_007]
    rows = struct.pack("<fffI", 1.0, 2.0, 3.0, 250)
    assert read_point_cloud2(point_cloud2([*XYZ, ("t", 12, 6)], rows, 1)).times_ns.tolist() == [12_000_000_257]


def test_a_point_with_one_number_that_is_none_is_a_miss_and_rows_may_be_padded():
    """Two rows of one point, each with 8 bytes behind it."""
    rows = b"".join(struct.pack("<fffd8x", *xyz, 5e9) for xyz in ((1.0, np.inf, 3.0), (4.0, 5.0, 6.0)))
    whole = point_cloud2([*XYZ, ("timestamp", 12, 8)], rows, 1)
    sizes = struct.pack("<II", 2, 1).join(whole.split(struct.pack("<II", 1, 1), 1))
    head, tail = sizes.split(struct.pack("<B3xII", 0, 56, 56), 1)
    read = read_point_cloud2(head + struct.pack("<B3xII", 0, 20, 28) + tail)
    assert read.points.tolist() == [[0, 0, 0], [4, 5, 6]] and read.times_ns.tolist() == [5 * 10**9] * 2


def test_times_in_seconds_and_points_that_are_no_numbers_are_refused():
    """Cut by nanoseconds, such a stream would never give a frame."""
    rows = struct.pack("<fffd", 1.0, 2.0, 3.0, 1.7e9 + 0.25)
    with pytest.raises(DeployError, match="timestamp in nanoseconds.* was expected, .*1700000000.25"):
        read_point_cloud2(point_cloud2([*XYZ, ("timestamp", 12, 8)], rows, 1))
    with pytest.raises(DeployError, match="numbers were expected in x, y, z, t"):
        read_point_cloud2(point_cloud2([*XYZ, ("t", 12, 99)], struct.pack("<fffI", 1.0, 2.0, 3.0, 4), 1))


@pytest.mark.parametrize("time", [np.nan, np.inf, -np.inf, 1e300])
@pytest.mark.parametrize("field", ["timestamp", "time"])
def test_times_that_are_none_are_refused(field, time):
    rows = struct.pack("<fffd", 1.0, 2.0, 3.0, 5.0) + struct.pack("<fffd", 1.0, 2.0, 3.0, time)
    with pytest.raises(
        DeployError, match=rf"finite numbers were expected in {field}, .*{re.escape(str(time))}.* given"
    ):
        read_point_cloud2(point_cloud2([*XYZ, (field, 12, 8)], rows, 2))


def a_custom_msg(base, *offsets_ns):
    """Of one point 1 m ahead for each offset."""
    points = b"".join(struct.pack("<IfffBBBx", offset, 1.0, 0.0, 0.0, 9, 0, 1) for offset in offsets_ns)
    head = struct.pack("<iI", 12, 7) + text("livox_frame") + bytes(4)
    return b"\0\1\0\0" + head[:24] + struct.pack("<QIB3xI", base, len(offsets_ns), 0, len(offsets_ns)) + points


def test_a_base_of_times_that_is_none_is_refused():
    with pytest.raises(DeployError, match="CustomMsg: "):
        read_custom_msg(a_custom_msg(2**63, 0))


class Topics:
    """Stands in for `dds.Network`: a topic on which these messages have come."""

    def __init__(self, *messages):
        self.messages = list(messages)

    def reader(self, topic, kind, depth):
        return self

    def take(self):
        return self.messages


def test_a_message_whose_times_are_far_from_each_other_is_refused_and_the_next_one_read(capsys):
    """As where one point's time was never set."""
    far = struct.pack("<fffd", 1.0, 2.0, 3.0, 0.0) + struct.pack("<fffd", 1.0, 2.0, 3.0, 1.7e18)
    near = struct.pack("<fffd", 1.0, 2.0, 3.0, 1.7e18)
    clouds = [point_cloud2([*XYZ, ("timestamp", 12, 8)], rows, len(rows) // 20) for rows in (far, near)]
    topic = lidar._Topic(LidarSource(kind="PointCloud2"), Topics(*clouds))
    assert [len(points.times_ns) for points in topic.read()] == [1] and topic.counts() == {"messages refused": 1}
    assert "refused: a message's points span 1.7e+09 s, at most 1 s was expected" in capsys.readouterr().err
    customs = Topics(a_custom_msg(5, 0, 10**9 + 1), a_custom_msg(5, 0, 10**9))
    topic = lidar._Topic(LidarSource(kind="CustomMsg"), customs)
    assert [len(points.times_ns) for points in topic.read()] == [2] and topic.counts() == {"messages refused": 1}


def test_a_cloud_without_times_or_cut_off_is_refused():
    rows = struct.pack("<fff", 1.0, 2.0, 3.0)
    with pytest.raises(DeployError, match="one of timestamp, offset_time, time, t were expected, x, y, z given"):
        read_point_cloud2(point_cloud2(XYZ, rows, 1))
    with pytest.raises(DeployError, match="PointCloud2"):
        read_point_cloud2(point_cloud2(LIVOX, bytes(52), 2)[:-30])
    with pytest.raises(DeployError, match="little-endian CDR"):
        read_point_cloud2(b"\0\0\0\0" + bytes(100))


def test_livox_ros_driver2s_custom_message():
    """Its format 1; the 64-bit base of time is aligned to 8, and the last point is 19 bytes."""
    body = struct.pack("<iI", 12, 7) + text("livox_frame") + bytes(4)  # 8 + 4 + 12 = 24: aligned already
    body = body[:24] + struct.pack("<QIB3xI", 5 * 10**9, 2, 0, 2)
    body += struct.pack("<IfffBBBx", 0, 1.0, 2.0, 3.0, 9, 0, 1) + struct.pack("<IfffBBB", 480, 4.0, 5.0, 6.0, 9, 1, 1)
    read = read_custom_msg(b"\0\1\0\0" + body)
    assert read.points.tolist() == [[1, 2, 3], [0, 0, 0]]  # the second is noise
    assert read.times_ns.tolist() == [5 * 10**9, 5 * 10**9 + 480]
    with pytest.raises(DeployError, match="CustomMsg: cut off"):
        read_custom_msg(b"\0\1\0\0" + body[:-5])
