"""The Mid-360's own packets (Livox SDK2 protocol): finding it, pointing it at this machine, and its points.

Layouts and ports are those of Livox-SDK2's `livox_lidar_def.h`, `sdk_protocol.h` and `build_request.cpp`; that points
of a packet are `time_interval` / `dot_num` apart is livox_ros_driver2's reading.
"""

from __future__ import annotations

import binascii
import contextlib
import errno
import ipaddress
import select
import socket
import struct
import time
import zlib
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from omnirobot.runtime.description import DeployError
from omnirobot.wire.clouds import LATEST_NS

DETECTION_PORT, POINT_PORT = 56000, 56300
"""Of the sensor: discovery, and where points come from."""
HOST_COMMAND_PORT, HOST_POINT_PORT = 56101, 56301
"""Of this machine: where answers and points go to."""
MID360, MID360S = 9, 35
"""Device types that speak this protocol and measure alike."""
_DEVICES = {
    **{0: "Hub", 1: "Mid-40", 2: "Tele-15", 3: "Horizon", 6: "Mid-70", 7: "Avia", MID360: "Mid-360", 10: "HAP"},
    **{15: "HAP", 16: "PA", MID360S: "Mid-360S", 40: "Avia 2"},
}
POINTS_PER_PACKET = 96
SEARCH, CONFIGURE = 0x0000, 0x0100
_POINT_TYPE_KEY, _POINT_HOST_KEY, _WORK_MODE_KEY = 0x0000, 0x0006, 0x001A
_CARTESIAN_MM, _CARTESIAN_CM, _SPHERICAL, _SAMPLING = 1, 2, 3, 1
_IMU, _DOUBLE_ECHO = 0, 0x11
_NOT_NOW = 0x02
_REFUSALS = {
    **{0x01: "it has failed", _NOT_NOW: "not in its present state", 0x03: "out of range", 0x20: "unknown to it"},
    **{0x21: "stored, until it is switched off and on", 0x22: "read-only", 0x23: "wrong length", 0x24: "wrong number"},
}
"""Meaning of an answer's code, of Livox's "Communication Protocol--Mid360"."""
_COMMAND = struct.Struct("<BBHIHBB6sHI")
_POINTS = struct.Struct("<BHHHHBBB12sIQ")
HEADER = _POINTS.size
"""Bytes of a packet before its points."""
POINT = np.dtype([("xyz", "<i4", 3), ("reflectivity", "u1"), ("tag", "u1")])
"""Of a packet of Cartesian points, mm."""
_DETECTION = struct.Struct("<BB16s4sH")
_KINDS = {
    _CARTESIAN_MM: (POINT, 1e-3),
    _CARTESIAN_CM: (np.dtype([("xyz", "<i2", 3), ("reflectivity", "u1"), ("tag", "u1")]), 1e-2),
    _SPHERICAL: (np.dtype([("depth", "<u4"), ("angles", "<u2", 2), ("reflectivity", "u1"), ("tag", "u1")]), 1e-3),
}
"""Layout of a point, and metres of its unit of length."""


@dataclass(frozen=True)
class Packet:
    """Points of one UDP packet.

    Attributes:
        points: (n, 3) float32 m, sensor frame; a miss is zero.
        times_ns: (n,) int64 on the sensor's clock.
        tags: (n,) uint8, see `clouds.without_noise`; 0 is a normal point.
        number: counts packets, modulo 65536.
    """

    points: np.ndarray
    times_ns: np.ndarray
    tags: np.ndarray
    number: int


def read_points(data: bytes) -> Packet | None:
    """A packet of points; None for what is none of points, is cut off, or is from `LATEST_NS` or later."""
    if len(data) < _POINTS.size:
        return None
    _, length, interval, count, number, _, kind, _, _, _, time_ns = _POINTS.unpack_from(data)
    if kind not in _KINDS or time_ns >= LATEST_NS:
        return None
    dtype, metres = _KINDS[kind]
    if length != len(data) or len(data) != _POINTS.size + count * dtype.itemsize or not count:
        return None
    rows = np.frombuffer(data, dtype, count, _POINTS.size)
    times = time_ns + np.arange(count, dtype=np.int64) * (interval * 100) // count
    points = _cartesian(rows) if kind == _SPHERICAL else rows["xyz"]
    return Packet((points * metres).astype(np.float32), times, rows["tag"], number)


def _cartesian(rows: np.ndarray) -> np.ndarray:
    """(n, 3) of depths and, in hundredths of a degree, angles from the z axis and about it."""
    theta, phi = np.radians(0.01 * rows["angles"].T)
    directions = np.stack((np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)), 1)
    return rows["depth"][:, None] * directions


def what_else(data: bytes) -> str:
    """What a datagram is of which `read_points` makes nothing."""
    if len(data) >= _POINTS.size:
        _, length, *_, kind, _, _, _, time_ns = _POINTS.unpack_from(data)
        if length == len(data) and kind in (_IMU, _DOUBLE_ECHO):
            return "packets of the IMU" if kind == _IMU else "packets of double echoes"
        if length == len(data) and kind in _KINDS and time_ns >= LATEST_NS:
            return "packets with a time that no clock shows"
    return "other datagrams"


def write_points(points: np.ndarray, time_ns: int, number: int, interval_ns: int) -> bytes:
    """The packet that a Mid-360 sends for points (n, 3), m; interval_ns: from the first point to the next packet's."""
    rows = np.zeros(len(points), _KINDS[_CARTESIAN_MM][0])
    rows["xyz"] = np.rint(np.asarray(points) * 1e3)
    body = struct.pack("<Q", time_ns) + rows.tobytes()
    length = _POINTS.size - 8 + len(body)
    head = (0, length, interval_ns // 100, len(points), number & 0xFFFF, 0, _CARTESIAN_MM, 0, bytes(12))
    return _POINTS.pack(*head, zlib.crc32(body), time_ns) + body[8:]


@dataclass(frozen=True)
class Message:
    """A control command or its answer."""

    command: int
    number: int
    is_answer: bool
    data: bytes


def write_message(message: Message) -> bytes:
    """Bytes of a command or an answer."""
    length = _COMMAND.size + len(message.data)
    parts = (0xAA, 0, length, message.number, message.command, int(message.is_answer), 0, bytes(6))
    head = _COMMAND.pack(*parts, 0, 0)[:18]
    checksum = zlib.crc32(message.data) if message.data else 0
    return head + struct.pack("<HI", binascii.crc_hqx(head, 0xFFFF), checksum) + message.data


def read_message(data: bytes) -> Message | None:
    """A command or answer; None where length or a checksum is wrong."""
    if len(data) < _COMMAND.size:
        return None
    start, version, length, number, command, kind, _, _, head_crc, data_crc = _COMMAND.unpack_from(data)
    body = data[_COMMAND.size :]
    expected = zlib.crc32(body) if body else 0
    if (start, version, length) != (0xAA, 0, len(data)) or data_crc != expected:
        return None
    if head_crc != binascii.crc_hqx(data[:18], 0xFFFF):
        return None
    return Message(command, number, bool(kind), body)


@dataclass(frozen=True)
class Sensor:
    """A sensor that has answered: address, port of its control, serial number, device type."""

    address: str
    command_port: int
    serial: str
    kind: int = MID360

    @property
    def name(self) -> str:
        """Of its type."""
        return _DEVICES.get(self.kind, "device unknown here")

    def __str__(self) -> str:
        return f"{self.name} {self.serial}"


def read_discovery(message: Message) -> Sensor | None:
    """The sensor that has answered; None for another command."""
    if message.command != SEARCH or not message.is_answer or len(message.data) < _DETECTION.size:
        return None
    failed, kind, serial, address, port = _DETECTION.unpack_from(message.data)
    if failed:
        return None
    return Sensor(str(ipaddress.IPv4Address(address)), port, serial.rstrip(b"\0").decode("ascii", "replace"), kind)


def configuration(host: str, point_port: int = HOST_POINT_PORT) -> bytes:
    """Data of CONFIGURE: Cartesian points in mm, to this host, and sampling."""
    try:
        address = ipaddress.IPv4Address(host).packed
    except ValueError:
        raise DeployError(f"host={host}: an address such as 192.168.1.50 was expected") from None
    values = (
        (_POINT_TYPE_KEY, bytes([_CARTESIAN_MM])),
        (_POINT_HOST_KEY, address + struct.pack("<HH", point_port, POINT_PORT)),
        (_WORK_MODE_KEY, bytes([_SAMPLING])),
    )
    return struct.pack("<HH", len(values), 0) + b"".join(struct.pack("<HH", k, len(v)) + v for k, v in values)


class Mid360:
    """A Mid-360 or Mid-360S on the network; :meth:`packets` gives what has come since the call before.

    Attributes:
        sensor: which one has answered; None where it was configured before and only listened to.
        lost: packets that never came, by their numbers.
        doubled: packets that came twice.
        others: datagrams that were no packets of points, by what they were.
    """

    def __init__(self, host: str, point_port: int = HOST_POINT_PORT) -> None:
        """Args: host: this machine's address in the sensor's network; point_port: where points come to."""
        self.host = host
        self.sensor: Sensor | None = None
        self.lost = self.doubled = 0
        self.others: Counter[str] = Counter()
        self._recent: deque[tuple[int, int]] = deque(maxlen=64)
        self._newest: tuple[int, int] | None = None
        self._socket = _socket(host, point_port)
        self.point_port = self._socket.getsockname()[1]

    def find(self, broadcast: str = "255.255.255.255", port: int = DETECTION_PORT, timeout_s: float = 5.0) -> Sensor:
        """Search, and point the first Mid-360 that answers at this machine.

        Raises:
            DeployError: none has answered, or it has refused.
        """
        is_real, unfit = port == DETECTION_PORT, dict[str, str]()
        with contextlib.ExitStack() as open_sockets:
            own = open_sockets.enter_context(_socket(self.host, DETECTION_PORT if is_real else 0, shared=True))
            own.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
            # it answers to everybody, which a socket of one address does not hear
            everybody = open_sockets.enter_context(_socket("0.0.0.0", own.getsockname()[1], shared=True))
            for answer in _ask((own, everybody), Message(SEARCH, 1, False, b""), (broadcast, port), timeout_s):
                sensor = read_discovery(answer)
                if sensor is not None and sensor.kind in (MID360, MID360S):
                    self._configure(sensor, HOST_COMMAND_PORT if is_real else 0, timeout_s)
                    self.sensor = sensor
                    return sensor
                if sensor is not None:
                    unfit[sensor.address] = f"a {sensor.name}, type {sensor.kind}, answered at {sensor.address}"
        if unfit:
            raise DeployError(f"{', '.join(unfit.values())}; points=mid360 drives Mid-360 and Mid-360S")
        raise DeployError(
            f"no Mid-360 has answered at {broadcast} within {timeout_s:g} s; host={self.host} must be this machine's"
            " address in the sensor's network (usually 192.168.1.x)"
        )

    def _configure(self, sensor: Sensor, port: int, timeout_s: float) -> None:
        request = Message(CONFIGURE, 2, False, configuration(self.host, self.point_port))
        why = (
            f"at {sensor.address} has not answered to its configuration; it and host={self.host} must be in one network"
        )
        with _socket(self.host, port) as own:
            for answer in _ask((own,), request, (sensor.address, sensor.command_port), timeout_s):
                if answer.command == CONFIGURE and answer.is_answer and len(answer.data) >= 3:
                    failed, key = struct.unpack_from("<BH", answer.data)
                    if not failed:
                        return
                    meaning = _REFUSALS.get(failed, "unknown here")
                    why = f"refuses key 0x{key:04x} (code 0x{failed:02x}: {meaning})"
                    if failed != _NOT_NOW:  # it may be about to start
                        break
        raise DeployError(f"the {sensor} {why}")

    def packets(self) -> Iterator[Packet]:
        """Every packet that waits, in the order of arrival, doubled ones left out."""
        while True:
            try:
                data = self._socket.recv(2048)
            except BlockingIOError:
                return
            packet = read_points(data)
            if packet is None:
                self.others[what_else(data)] += 1
            elif (which := (packet.number, int(packet.times_ns[0]))) in self._recent:
                self.doubled += 1
            else:
                self._recent.append(which)
                self._note(*which)
                yield packet

    def _note(self, number: int, time_ns: int) -> None:
        """Counts gaps in the packets' numbers. One that comes late after all is no gap; where a later packet has a
        lower number, the counter has restarted: after a power cycle, or where it counts the packets of a frame."""
        if self._newest is not None:
            ahead, later = (number - self._newest[0]) & 0xFFFF, time_ns > self._newest[1]
            if 1 <= ahead < 0x8000:
                self.lost += ahead - 1
            elif not later:
                self.lost = max(0, self.lost - 1)
                return
        self._newest = (number, time_ns)

    def close(self) -> None:
        """Ends listening."""
        self._socket.close()


def _socket(host: str, port: int, shared: bool = False) -> socket.socket:
    """Listens at an address; shared: also where another does."""
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
    if shared:
        made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    made.setblocking(False)
    try:
        made.bind((host, port))
    except (OSError, OverflowError) as error:
        made.close()
        raise DeployError(f"host={host}: port {port} cannot be listened to: {_why_not(error)}") from None
    return made


def _why_not(error: OSError | OverflowError) -> str:
    if isinstance(error, socket.gaierror):
        return "an address such as 192.168.1.50 was expected"
    if isinstance(error, OverflowError):
        return "a port is at most 65535"
    return {
        errno.EADDRNOTAVAIL: "this machine has no such address; give the one that it has in the sensor's network",
        errno.EADDRINUSE: "another program listens there, such as a driver of the sensor",
    }.get(error.errno or 0, str(error.strerror))


def _ask(heard: Sequence[socket.socket], request: Message, to: tuple[str, int], timeout_s: float) -> Iterator[Message]:
    """Answers that come to any of some sockets, while the first of them repeats the request once a second."""
    end, again = time.monotonic() + timeout_s, 0.0
    while time.monotonic() < end:
        if time.monotonic() >= again:
            again = time.monotonic() + 1.0
            with contextlib.suppress(OSError):  # a network that is still down
                heard[0].sendto(write_message(request), to)
        ready, _, _ = select.select(heard, [], [], 0.005)
        for one in ready:
            answer = read_message(one.recv(2048))
            if answer is not None:
                yield answer
