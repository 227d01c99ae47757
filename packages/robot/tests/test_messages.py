"""Unitree's messages: bytes and checksums that unitree_sdk2_python itself has made.

Golden values: unitree_sdk2_python at 37116c5 (its IDL classes and CRC library) on cyclonedds 11.0.1, the scalars of a
message counted through as by `counted`: `message.serialize()` and `CRC().Crc(message)`.
"""

import hashlib

import numpy as np
import pytest

from omnirobot.runtime import DeployError
from omnirobot.wire.messages import LOW_CMD, LOW_STATE, Struct, crc, low_cmd, remote, sealed

GOLDEN = {
    "unitree_go.msg.dds_.LowCmd_": (
        *(250, 0x12F59E0D, 812, "9eb18db2eac85fc056c5ea433f6ee6983454e1712119912305bce8fd663db41f"),
        "00010000010203040500000006000000070000000800000009000a00000030400000404000005040000060400000704010000000"
        "110000001200000013000000",
    ),
    "unitree_go.msg.dds_.LowState_": (
        *(349, 0x81A289BD, 1180, "4ad556f70c4a98a5dc74935fed27b91b800853089ba0e1531f955ed024ba8804"),
        "00010000010203040500000006000000070000000800000009000000000020400000304000004040000050400000604000007040"
        "000080400000884000009040",
    ),
}
"""Scalars, checksum, length with the header, SHA-256 and the first 64 bytes of the serialized message."""


def counted(struct, record, number=0):
    """Counts up through the scalars: floats a quarter of the number, bytes modulo 127, signed ones negative."""
    for name, kind, length in struct.fields:
        for k in range(length or 1):
            if isinstance(kind, Struct):
                number = counted(kind, record[name][k] if length else record[name], number)
                continue
            number += 1
            value = {"f4": number * 0.25, "u1": number % 127, "i2": -number, "i4": -number}.get(kind, number)
            if length:
                record[name][k] = value
            else:
                record[name] = value
    return number


@pytest.mark.parametrize("struct", [LOW_CMD, LOW_STATE], ids=lambda struct: struct.name)
def test_bytes_and_checksum_are_the_sdks(struct):
    scalars, checksum, length, digest, beginning = GOLDEN[struct.name]
    record = struct.zeros()
    assert counted(struct, record) == scalars
    record["crc"] = 0
    assert crc(record) == checksum
    data = struct.to_cdr(sealed(record))
    assert data[:64].hex() == beginning and len(data) == length and hashlib.sha256(data).hexdigest() == digest
    assert struct.from_cdr(data).tobytes() == record.tobytes()


def test_a_command_of_nothing_moves_nothing():
    command = low_cmd()
    assert command["head"].tolist() == [0xFE, 0xEF] and command["level_flag"] == 0xFF
    assert command["motor_cmd"]["mode"].tolist() == [1] * 20
    for name in ("kp", "kd", "tau", "q"):
        assert not command["motor_cmd"][name].any()


@pytest.mark.parametrize("data", [b"", b"\0\1\0\0" + bytes(800), b"\0\0\0\0" + bytes(808), b"\0\1\0\0" + bytes(900)])
def test_other_bytes_are_refused(data):
    with pytest.raises(DeployError, match=r"LowCmd_: 812 bytes of little-endian CDR were expected"):
        LOW_CMD.from_cdr(data)


def test_the_remote():
    """Buttons by their bits in unitree_rl_lab's `unitree_joystick.hpp`; sticks as float32 from byte 4 on."""
    data = np.zeros(40, np.uint8)
    data[2], data[3] = 0b00100100, 0b00000010  # L2 and start; B
    data[4:24] = np.frombuffer(np.array([0.5, -0.25, 2.0, 0.0, -1.0], "<f4").tobytes(), np.uint8)
    read = remote(data)
    assert read.pressed == {"L2", "start", "B"}
    assert (read.lx, read.rx, read.ry, read.ly) == (0.5, -0.25, 1.0, -1.0)
