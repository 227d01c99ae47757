"""The Mid-360's packets and control messages against bytes that Livox-SDK2 has made, and a sensor on the loopback.

Golden bytes: `SdkProtocol::Pack` of Livox-SDK2 (sdk_core/comm/sdk_protocol.cpp), compiled and run with a buffer of
zeros and sequence numbers 1 and 2; sizes of its packed structs: a point packet's head is 36 bytes, a point 14.
"""

import socket
import struct
import threading

import numpy as np
import pytest

from omnirobot.runtime import DeployError
from omnirobot.wire import livox
from omnirobot.wire.livox import Message, Mid360, Sensor

SEARCH = "aa0018000100000000000000000000000000a91f00000000"
CONFIGURE = "aa0032000200000000010000000000000000d16e86a7c40103000000000001000106000800c0a80132eddbecdb1a00010001"
ANSWER = "aa00300001000000000001010000000000008ab79435b7e9000934374d444c3030303030303030310000c0a8017024db"
SENSOR = Sensor("192.168.1.112", 56100, "47MDL000000001")


def test_control_messages_are_the_sdks():
    assert livox.write_message(Message(livox.SEARCH, 1, False, b"")).hex() == SEARCH
    request = Message(livox.CONFIGURE, 2, False, livox.configuration("192.168.1.50"))
    assert livox.write_message(request).hex() == CONFIGURE


def test_control_messages_are_read_back_and_damaged_ones_are_not():
    answer = livox.read_message(bytes.fromhex(ANSWER))
    assert answer is not None and livox.read_discovery(answer) == SENSOR
    for at in (0, 3, 8, 18, 22, 40):
        damaged = bytearray.fromhex(ANSWER)
        damaged[at] ^= 1
        assert livox.read_message(bytes(damaged)) is None
    assert livox.read_message(bytes.fromhex(ANSWER)[:20]) is None
    assert livox.read_discovery(Message(livox.SEARCH, 1, False, b"")) is None


def packet(points, time_ns=10**9, number=0):
    return livox.write_points(np.asarray(points), time_ns, number, 480_000)


def test_points_by_hand():
    """Two points of 1.234 m and a miss: head by the SDK's struct, millimetres, 160 us apart."""
    data = packet([[1.234, -0.5, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, -40.0]], 7, 300)
    head = struct.unpack_from("<BHHHHBBB", data)
    assert head == (0, 36 + 3 * 14, 4800, 3, 300, 0, 1, 0) and data[28:36] == (7).to_bytes(8, "little")
    assert struct.unpack_from("<iii", data, 36) == (1234, -500, 0)
    read = livox.read_points(data)
    np.testing.assert_allclose(read.points, [[1.234, -0.5, 0.0], [0, 0, 0], [0, 0, -40]], atol=1e-6)
    assert read.times_ns.tolist() == [7, 160_007, 320_007] and read.number == 300


def test_centimetres_and_tags():
    head = livox._POINTS.pack(0, 36 + 8, 4800, 1, 5, 0, 2, 0, bytes(12), 0, 9)
    read = livox.read_points(head + struct.pack("<hhhBB", 123, -4, 0, 77, 5))
    np.testing.assert_allclose(read.points, [[1.23, -0.04, 0.0]], atol=1e-6)
    assert read.tags.tolist() == [5]


ONES = np.ones((3, 3))


@pytest.mark.parametrize(
    "data",
    [b"", bytes(36), packet(ONES)[:-1], packet(ONES) + b"x", packet(ONES, 2**64 - 1), packet(ONES, 2**63 - 1)],
)
def test_what_is_no_packet_of_points_is_none(data):
    assert livox.read_points(data) is None


def test_lost_doubled_and_late_packets_are_counted():
    lidar = Mid360("127.0.0.1", 0)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sensor:
        for number in (65534, 65535, 1, 0, 0, 4):  # 0 is late and comes twice, 2 and 3 never come
            sensor.sendto(packet([[1.0, 0.0, 0.0]], number=number), ("127.0.0.1", lidar.point_port))
        sensor.sendto(b"something", ("127.0.0.1", lidar.point_port))
    numbers = [each.number for each in lidar.packets()]
    assert numbers == [65534, 65535, 1, 0, 4] and (lidar.lost, lidar.doubled, lidar.others.total()) == (2, 1, 1)
    lidar.close()


def test_a_sensor_that_counts_anew_goes_on():
    """As one does that was switched on again, or counts the packets of a frame: a later packet with a lower number."""
    lidar = Mid360("127.0.0.1", 0)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sensor:
        for frame in range(4):
            for number in range(40):
                data = packet([[1.0, 0.0, 0.0]], 10**9 + (40 * frame + number) * 480_000, number)
                sensor.sendto(data, ("127.0.0.1", lidar.point_port))
    assert [each.number for each in lidar.packets()] == [*range(40)] * 4
    assert (lidar.lost, lidar.doubled) == (0, 0) and len(lidar._recent) <= 64
    lidar.close()


class Device(threading.Thread):
    """A Mid-360 on the loopback that answers to SEARCH and CONFIGURE; `everybody` names the address to which it answers
    where it is searched, as a real one does."""

    def __init__(self, everybody=None):
        super().__init__(daemon=True)
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        self.socket.bind(("" if everybody else "127.0.0.1", 0))
        self.socket.settimeout(5.0)
        self.port, self.configured, self.everybody = self.socket.getsockname()[1], b"", everybody

    def run(self):
        while not self.configured:
            data, address = self.socket.recvfrom(2048)
            message = livox.read_message(data)
            if message.is_answer:
                continue
            if message.command == livox.SEARCH:
                answer = struct.pack("<BB16s4sH", 0, 9, b"loopback", bytes([127, 0, 0, 1]), self.port)
                address = (self.everybody or address[0], address[1])
            else:
                self.configured, answer = message.data, bytes(3)
            self.socket.sendto(livox.write_message(Message(message.command, message.number, True, answer)), address)


@pytest.mark.parametrize("everybody", [None, "127.255.255.255"])
def test_a_sensor_is_found_and_pointed_at_this_machine(everybody):
    device, lidar = Device(everybody=everybody), Mid360("127.0.0.1", 0)
    device.start()
    assert lidar.find(everybody or "127.0.0.1", device.port).serial == "loopback"
    device.join(5.0)
    assert device.configured == livox.configuration("127.0.0.1", lidar.point_port)
    lidar.close()


def test_addresses_and_ports_that_are_none_are_named():
    with pytest.raises(DeployError, match="host=127.0.0.1: port 70000 cannot be listened to"):
        Mid360("127.0.0.1", 70000)
    with pytest.raises(DeployError, match="host=localhost: an address such as 192.168.1.50 was expected"):
        livox.configuration("localhost")


def test_a_sensor_that_is_silent_is_named():
    lidar = Mid360("127.0.0.1", 0)
    with pytest.raises(DeployError, match=r"no Mid-360 has answered at 127.0.0.1 within 0.05 s"):
        lidar.find("127.0.0.1", 9, 0.05)
    lidar.close()
