"""Sensors that are there and are not found, times that stand still, what never comes. Bytes are laid out by hand."""

import binascii
import socket
import struct
import threading
import zlib
from collections import deque

import numpy as np
import pytest
from messages_by_hand import LIVOX, point_cloud2

from omnirobot.drive import control
from omnirobot.drive.guard import StateReader
from omnirobot.runtime import DeployError
from omnirobot.wire import clouds, lidar, livox
from omnirobot.wire.clouds import FrameCutter, Points
from omnirobot.wire.lidar import LidarSource
from omnirobot.wire.livox import Mid360
from omnirobot.wire.messages import LOW_STATE, sealed

SEARCH, CONFIGURE = 0x0000, 0x0100


def answer(command, data):
    """A control message from a sensor: head of 18 bytes, its CRC16, the data's CRC32, data."""
    head = struct.pack("<BBHIHBB6x", 0xAA, 0, 24 + len(data), 1, command, 1, 1)
    return head + struct.pack("<HI", binascii.crc_hqx(head, 0xFFFF), zlib.crc32(data)) + data


class Sensor(threading.Thread):
    """Answers to what it is asked, on the loopback; codes: of its answers to CONFIGURE, all of them to the first."""

    def __init__(self, kind, codes=(0,)):
        super().__init__(daemon=True)
        self.kind, self.codes, self.socket = kind, codes, socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.settimeout(5.0)
        self.port = self.socket.getsockname()[1]

    def run(self):
        for _ in range(2):
            try:
                data, address = self.socket.recvfrom(2048)
            except TimeoutError:
                return
            if struct.unpack_from("<H", data, 8) == (SEARCH,):
                found = struct.pack("<BB16s4sH", 0, self.kind, b"47MDL1", socket.inet_aton("127.0.0.1"), self.port)
                self.socket.sendto(answer(SEARCH, found), address)
                continue
            for code in self.codes:
                self.socket.sendto(answer(CONFIGURE, struct.pack("<BH", code, 0x001A if code else 0)), address)


@pytest.fixture
def mid360():
    made = Mid360("127.0.0.1", 0)
    yield made
    made.close()


def found(mid360, kind, codes=(0,), timeout_s=5.0):
    sensor = Sensor(kind, codes)
    sensor.start()
    return mid360.find("127.0.0.1", sensor.port, timeout_s)


@pytest.mark.parametrize(("kind", "name"), [(9, "Mid-360"), (35, "Mid-360S")])
def test_a_mid360s_is_found(mid360, kind, name):
    assert str(found(mid360, kind)) == f"{name} 47MDL1"


@pytest.mark.parametrize(
    ("kind", "name"), [(10, "HAP"), (15, "HAP"), (7, "Avia"), (40, "Avia 2"), (99, "device unknown here")]
)
def test_another_device_is_named(mid360, kind, name):
    with pytest.raises(DeployError) as error:
        found(mid360, kind, timeout_s=0.3)
    expected = f"a {name}, type {kind}, answered at 127.0.0.1; points=mid360 drives Mid-360 and Mid-360S"
    assert str(error.value) == expected


def test_a_sensor_that_is_not_ready_yet_is_asked_again(mid360):
    assert found(mid360, 9, (2, 2, 0)).serial == "47MDL1"


@pytest.mark.parametrize(
    ("code", "meaning"), [(2, "not in its present state"), (0x20, "unknown to it"), (0x21, "until it is switched off")]
)
def test_a_refused_configuration_is_said_in_words(mid360, code, meaning):
    with pytest.raises(DeployError, match=f"the Mid-360 47MDL1 refuses key 0x001a .code 0x{code:02x}: .*{meaning}"):
        found(mid360, 9, (code,), timeout_s=0.3)


def test_an_address_of_no_interface_and_a_port_that_is_taken_are_named(mid360):
    with pytest.raises(DeployError, match="host=203.0.113.7: .*this machine has no such address"):
        Mid360("203.0.113.7", 0)
    with pytest.raises(DeployError, match=f"port {mid360.point_port} .*another program listens there"):
        Mid360("127.0.0.1", mid360.point_port)
    with pytest.raises(DeployError, match=r"host=no\.such\.name\.invalid: .*an address such as 192\.168\.1\.50"):
        Mid360("no.such.name.invalid", 0)


def datagram(kind, body, count, time_ns=10**9, number=0):
    """Of a Mid-360's point and IMU ports: 28 bytes of head, CRC32, time, body."""
    head = struct.pack("<BHHHHBBB12x", 0, 36 + len(body), 4800, count, number, 0, kind, 0)
    return head + struct.pack("<IQ", zlib.crc32(struct.pack("<Q", time_ns) + body), time_ns) + body


def test_points_in_spherical_coordinates():
    """2 m along x, y and z, and 2 m at 60 degrees from z and 30 degrees about it."""
    rows = [(9000, 0), (9000, 9000), (0, 0), (6000, 3000)]
    body = b"".join(struct.pack("<IHHBB", 2000, *angles, 7, 0) for angles in rows)
    packet = livox.read_points(datagram(3, body, 4))
    half = np.sqrt(3) / 2
    last = (2 * half * half, 2 * half * 0.5, 1.0)
    np.testing.assert_allclose(packet.points, [(2, 0, 0), (0, 2, 0), (0, 0, 2), last], atol=1e-6)
    assert packet.times_ns.tolist() == [10**9, 10**9 + 120_000, 10**9 + 240_000, 10**9 + 360_000]


class Lidar:
    """Of a policy."""

    period_s, points_per_frame = 0.1, 20_000


@pytest.fixture
def listening():
    """Frames of packets to a port of the loopback, and something that sends there."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sensor:
        frames = lidar.Frames(LidarSource(kind="packets", host="127.0.0.1", point_port=0), Lidar, None)
        to = ("127.0.0.1", frames._source._mid360.point_port)
        yield frames, lambda data: sensor.sendto(data, to), f"{to[0]}:{to[1]}"
        frames.close()


def test_what_comes_in_place_of_points_is_named(listening):
    frames, send, here = listening
    told = f"a Mid-360 that samples was expected to send points to {here}; points=mid360 tells it to"
    assert frames.why_silent() == f"nothing came; {told}"
    for number in range(3):
        send(datagram(0, bytes(24), 1, number=number))
    send(datagram(0x11, bytes(28), 1))
    send(datagram(1, bytes(14), 1, time_ns=2**63))
    send(b"something")
    assert frames.new() == []
    came = "3 packets of the IMU, 1 packets of double echoes, 1 packets with a time that no clock shows"
    assert frames.why_silent() == f"{came}, 1 other datagrams came; {told}"
    assert frames.why_silent() == f"nothing came; {told}"  # since then
    assert frames.counts()["packets of the IMU"] == 3 and frames.counts()["LiDAR messages"] == 0


def test_points_that_are_all_misses_are_named(listening):
    frames, send, _ = listening
    for number in range(250):
        send(datagram(1, bytes(96 * 14), 96, 10**9 + number * 480_000, number))
        frames.new()
    assert frames.number == 1 and frames.came == 0
    assert frames.why_silent() == "250 LiDAR messages, 24000 LiDAR misses, 1 frames came; every point is a miss"


def test_what_has_come_is_counted_from_the_newest_frame_on(listening):
    """120 ms of points, which close a frame of 100; two packets more, and then the IMU's."""
    frames, send, _ = listening
    points = b"".join(struct.pack("<iiiBB", 1000, 0, 0, 7, 0) for _ in range(96))
    for number in range(250):
        send(datagram(1, points, 96, 10**9 + number * 480_000, number))
        frames.new()
    assert frames.came == 1
    send(datagram(0, bytes(24), 1))
    frames.new()
    left = 250 - 213  # the packet of number 212 is the first 2 ms after 100 ms
    assert frames.why_silent() == f"{left} LiDAR messages, {96 * left} LiDAR points, 1 packets of the IMU came"


def of(times_ns, count=5000):
    """A message of points numbered by x, at times from a function of the point's number."""

    def message(k):
        number = np.arange(k * count, (k + 1) * count)
        points = np.stack((number + 1, 0 * number, 0 * number), 1).astype(np.float32)
        return Points(points, np.asarray(times_ns(number, k), np.int64) + 0 * number)

    return message


EPOCH = 1_700_000_000 * 10**9
PACE_NS = 5000  # from one point to the next: 200,000 a second, 5000 in each of 40 messages a second


def run(message, seconds=5.0, rate=40, start=100.0):
    """A cutter of 100 ms, and the frames that it gives while messages come at an even rate."""
    cutter, frames = FrameCutter(0.1), []
    for k in range(round(seconds * rate)):
        frames += cutter.add(message(k), start + (k + 1) / rate)
        assert sum(len(held.points) for held in cutter._held) <= 250_000
    return cutter, frames


STILL = {
    "one time": lambda number, k: EPOCH,
    "zeros": lambda number, k: 0,
    "random": lambda number, k: EPOCH + np.random.default_rng(k).integers(0, 3600) * 10**9,
    "seconds": lambda number, k: (EPOCH + number * PACE_NS) // 10**9,
}


@pytest.mark.parametrize("name", STILL)
def test_points_without_a_time_are_taken_as_measured_when_they_came(name, capsys):
    """After a second in which nobody can know: 40 frames in the 4 s that are left, of 20,000 points each, in order."""
    cutter, frames = run(of(STILL[name]))
    assert 38 <= len(frames) <= 40
    for frame in frames[1:]:
        assert abs(len(frame.points) - 20_000) <= 1 and (np.diff(frame.points[:, 0]) == 1).all()
        np.testing.assert_allclose(frame.offsets_s, 5e-6 * np.arange(len(frame.points)), atol=5e-6)
    said = capsys.readouterr().err.splitlines()
    wrong = {"one time": f"stand still at {EPOCH} ns", "zeros": "stand still at 0 ns", "random": "go back and forth"}
    (line,) = [line for line in said if "taken as" in line]
    assert line.startswith(f"LiDAR: the points' times {wrong.get(name, 'go on')}")
    assert line.endswith("each message is taken as measured when it came")
    assert cutter.counts()["messages timed by their arrival"] >= 155


@pytest.mark.parametrize(("unit", "ns"), [("microseconds", 1000), ("milliseconds", 10**6)])
def test_times_in_another_unit_are_taken_in_it(unit, ns, capsys):
    """The frames are those of times in nanoseconds: 20,000 points, 5 us apart, to the unit."""
    _, frames = run(of(lambda number, k: (EPOCH + number * PACE_NS) // ns))
    assert 38 <= len(frames) <= 40
    for frame in frames[1:]:
        assert abs(len(frame.points) - 20_000) <= ns / PACE_NS and (np.diff(frame.points[:, 0]) == 1).all()
        np.testing.assert_allclose(frame.offsets_s, 5e-6 * np.arange(len(frame.points)), atol=1.1e-9 * ns)
    said = f"LiDAR: the points' times go on {ns} times too slowly, as {unit} do: they are taken as {unit}\n"
    assert capsys.readouterr().err == said


def test_times_that_are_right_stay_as_they_are(capsys):
    cutter, frames = run(of(lambda number, k: EPOCH + number * PACE_NS))
    assert [len(frame.points) for frame in frames] == [20_000] * 49 and frames[7].start_ns == EPOCH + 700_000_000
    assert capsys.readouterr().err == "" and not any(cutter.counts().values())


def test_a_sensor_whose_clock_hangs_and_goes_on_again(capsys):
    """From 2 to 4 s; the first second of each is lost, the rest is not."""
    hangs = of(lambda number, k: EPOCH + np.where((k >= 80) & (k < 160), 80 * 5000, number) * PACE_NS)
    _, frames = run(hangs, 8.0)
    assert sum(len(frame.points) == 20_000 for frame in frames) >= 55
    said = capsys.readouterr().err
    assert "stand still" in said and "go on as they should" in said


@pytest.mark.parametrize("back_s", [0.2, 0.5, 0.9, 3.0])
def test_a_step_back_is_a_jump_and_loses_no_more_than_the_frame_that_it_breaks(back_s, capsys):
    stepped = of(lambda number, k: EPOCH + number * PACE_NS - (k >= 82) * round(back_s * 1e9))
    cutter, frames = run(stepped)
    assert (cutter.jumps, cutter.late, cutter.dropped) == (1, 0, 10_000)  # 50 ms of the frame from 2.0 s on
    assert [len(frame.points) for frame in frames] == [20_000] * 49
    assert capsys.readouterr().err == f"LiDAR: the points' time jumps by {-back_s + 0.05:.3g} s: a new frame begins\n"


def test_messages_whose_points_have_one_time_are_spread_and_that_is_said_once(capsys):
    """20 messages a second, each with the time of its last point only."""
    flat = of(lambda number, k: EPOCH + (k + 1) * 10_000 * PACE_NS, 10_000)
    _, frames = run(flat, rate=20)
    assert len(frames) >= 47
    for frame in frames[1:]:
        assert len(frame.points) == 20_000
        np.testing.assert_allclose(frame.offsets_s, 5e-6 * np.arange(20_000), atol=1e-8)
    said = "are one within a message: its points are taken as measured evenly since the one before"
    assert capsys.readouterr().err == f"LiDAR: the points' times {said}\n"


def test_offsets_in_microseconds_that_are_read_as_nanoseconds_are_spread_too():
    """A header with the right time, and points within 25 us of it that were measured over 25 ms."""
    short = of(lambda number, k: EPOCH + k * 25_000_000 + (number - 5000 * k) * PACE_NS // 1000)
    _, frames = run(short)
    for frame in frames[-30:]:
        np.testing.assert_allclose(np.diff(frame.offsets_s), 5e-6, atol=1e-7)


def test_lost_messages_and_a_pause_are_no_fault_of_the_clock(capsys):
    whole = of(lambda number, k: EPOCH + number * PACE_NS)
    cutter, kept = FrameCutter(0.1), np.random.default_rng(0).random(400) > 0.3
    for k in [*np.flatnonzero(kept[:200]), *(600 + np.flatnonzero(kept[200:]))]:
        cutter.add(whole(int(k)), 100.0 + (k + 1) / 40)
    counts = cutter.counts()
    assert counts["messages timed by their arrival"] == 0 and counts["jumps of time"] == 1  # the pause of 10 s
    assert "taken as" not in capsys.readouterr().err


def test_without_a_clock_points_that_wait_are_bounded_and_that_is_said(capsys):
    cutter = FrameCutter(0.1)
    for k in range(800):
        assert cutter.add(of(STILL["one time"])(k)) == []
        assert sum(len(held.points) for held in cutter._held) <= clouds.MOST_HELD
    assert cutter.dropped == 3 * 1_005_000 and capsys.readouterr().err.count("times went on by 0 s in") == 1


class Topic:
    """Stands in for `dds.Network` and a reader: what has come, and what DDS knows of who writes."""

    def __init__(self, *messages, why="nobody writes it"):
        self.messages, self.why = deque(messages), why

    def reader(self, *_):
        return self

    def take(self):
        taken = list(self.messages)
        self.messages.clear()
        return taken

    def why_silent(self):
        return self.why


def test_what_comes_of_a_topic_in_place_of_frames_is_named():
    far = struct.pack("<ffffBBd", 1.0, 2.0, 3.0, 9.0, 0, 1, 0.0) + struct.pack("<ffffBBd", 1, 2, 3, 9, 0, 1, 1.7e18)
    good = struct.pack("<ffffBBd", 1.0, 2.0, 3.0, 9.0, 0, 1, 1.7e18)
    network = Topic(why="rt/livox/lidar is written as livox_ros_driver2::msg::dds_::CustomMsg_, another was expected")
    frames = lidar.Frames(LidarSource(kind="PointCloud2"), Lidar, network)
    assert frames.why_silent() == f"nothing came; {network.why}; points=CustomMsg reads it"
    network.messages += [point_cloud2(LIVOX, far, 2)] * 3
    frames.new()
    assert frames.why_silent().startswith("3 messages refused came; the newest was refused: a message's points span")
    network.messages += [point_cloud2(LIVOX, good, 1)] * 2
    frames.new()
    assert frames.why_silent() == "2 LiDAR messages, 2 LiDAR points came"


def a_state(tick, crc=None):
    state = LOW_STATE.zeros()
    state["tick"] = tick
    sealed(state)
    state["crc"] = state["crc"] if crc is None else crc
    return LOW_STATE.to_cdr(state)


def test_states_that_cannot_be_used_are_named():
    network = Topic()
    states = StateReader(network, True)
    assert states.newest() is None and states.why_silent() == "nobody writes it"
    for data, why in (
        (a_state(1, 0), "its checksum is wrong; crc=false is for simulators that fill none"),
        (a_state(1)[:-4], "unitree_go.msg.dds_.LowState_: 1180 bytes of little-endian CDR were expected"),
    ):
        network.messages.append(data)
        assert states.newest() is None and why in states.why_silent()
    network.messages += [a_state(5), a_state(5)]
    assert states.newest()["tick"] == 5 and states.came == 1
    assert "it is not newer than the one before, by its tick of 5" in states.why_silent()


class Source:
    came = 0

    def why_silent(self):
        return "nobody is there"


def test_what_is_waited_for_is_said_every_three_seconds(capsys):
    states, frames = Source(), Source()
    waiting = control.Waiting({"states": states, "frames": frames})
    for k in range(500):  # 10 s at 50 Hz; frames come until 4 s
        frames.came += k < 200 and k % 5 == 0
        waiting.look(1000.0 + 0.02 * k)
    said = capsys.readouterr().err.splitlines()
    assert said == [
        f"waiting for {what}: nobody is there" for what in ("states", "states", "frames", "states", "frames")
    ]
