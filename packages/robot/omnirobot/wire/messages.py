"""Unitree's low-level messages: names and order of their fields, bytes on the wire, and their checksum.

Names, types and order are those of `unitree_go.msg.dds_` in unitree_sdk2_python. A message is a NumPy record with the C
layout, over which the checksum runs; :meth:`Struct.to_cdr` and :meth:`Struct.from_cdr` convert it from and to DDS.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from omnirobot.runtime.description import DeployError

_CDR_HEADER = b"\x00\x01\x00\x00"
"""Encapsulation: plain CDR, little endian."""


@dataclass(frozen=True)
class Struct:
    """A message type of fixed size.

    Attributes:
        name: DDS name of the type, with dots.
        fields: (name, NumPy scalar type or Struct, length of the array or 0 for a single one), in order.
    """

    name: str
    fields: tuple[tuple[str, str | Struct, int], ...]

    @cached_property
    def dtype(self) -> np.dtype:
        """C layout."""
        parts = [(name, kind.dtype if isinstance(kind, Struct) else kind, n) for name, kind, n in self.fields]
        return np.dtype([(name, kind, (n,)) if n else (name, kind) for name, kind, n in parts], align=True)

    def zeros(self) -> np.ndarray:
        """() record of zeros."""
        return np.zeros((), self.dtype)

    def to_cdr(self, record: np.ndarray) -> bytes:
        """A record as DDS sends it."""
        wire = np.zeros(self._wire_size, np.uint8)
        c, cdr = self._bytes
        wire[cdr] = np.frombuffer(record.tobytes(), np.uint8)[c]
        return _CDR_HEADER + wire.tobytes()

    def from_cdr(self, data: bytes) -> np.ndarray:
        """() record of what DDS received; a DeployError if its length or byte order is another."""
        if data[:2] != _CDR_HEADER[:2] or not self._wire_size <= len(data) - 4 < self._wire_size + 8:
            expected = f"{self._wire_size + 4} bytes of little-endian CDR"
            raise DeployError(f"{self.name}: {expected} were expected, {len(data)} beginning {data[:4].hex()} given")
        record = np.zeros(self.dtype.itemsize, np.uint8)
        c, cdr = self._bytes
        record[c] = np.frombuffer(data, np.uint8, offset=4)[cdr]
        return record.view(self.dtype)[0:1].reshape(())

    @cached_property
    def _bytes(self) -> tuple[np.ndarray, np.ndarray]:
        """Where each byte is in C's layout, and where in CDR's."""
        pairs = [(c + k, cdr + k) for c, cdr, size in self._leaves(0, [0]) for k in range(size)]
        c, cdr = np.array(pairs).T
        return c, cdr

    @cached_property
    def _wire_size(self) -> int:
        return int(self._bytes[1].max()) + 1

    def _leaves(self, start: int, end: list[int]) -> Iterator[tuple[int, int, int]]:
        """Offset in C's layout, offset in CDR's, and size of each scalar.

        CDR aligns scalars to their size and structs not at all, so a struct's padding depends on where it begins.

        Args:
            start: of this struct in C's layout.
            end: one number, where CDR has come to; advanced.
        """
        for name, kind, length in self.fields:
            offset = start + self.dtype.fields[name][1]  # type: ignore[index]
            for k in range(length or 1):
                if isinstance(kind, Struct):
                    yield from kind._leaves(offset + k * kind.dtype.itemsize, end)
                    continue
                size = np.dtype(kind).itemsize
                end[0] = -(-end[0] // size) * size
                yield offset + k * size, end[0], size
                end[0] += size


def _go(name: str, *fields: tuple[str, str | Struct, int]) -> Struct:
    return Struct(f"unitree_go.msg.dds_.{name}_", fields)


_HEAD: tuple[tuple[str, str, int], ...] = (
    ("head", "u1", 2),
    ("level_flag", "u1", 0),
    ("frame_reserve", "u1", 0),
    ("sn", "u4", 2),
    ("version", "u4", 2),
    ("bandwidth", "u2", 0),
)
_MOTOR_CMD = _go(
    "MotorCmd",
    ("mode", "u1", 0),
    *((name, "f4", 0) for name in ("q", "dq", "tau", "kp", "kd")),
    ("reserve", "u4", 3),
)
_MOTOR_STATE = _go(
    "MotorState",
    ("mode", "u1", 0),
    *((name, "f4", 0) for name in ("q", "dq", "ddq", "tau_est", "q_raw", "dq_raw", "ddq_raw")),
    ("temperature", "u1", 0),
    ("lost", "u4", 0),
    ("reserve", "u4", 2),
)
_BMS_STATE = _go(
    "BmsState",
    *((name, "u1", 0) for name in ("version_high", "version_low", "status", "soc")),
    ("current", "i4", 0),
    ("cycle", "u2", 0),
    ("bq_ntc", "u1", 2),
    ("mcu_ntc", "u1", 2),
    ("cell_vol", "u2", 15),
)
_IMU_STATE = _go(
    "IMUState",
    ("quaternion", "f4", 4),
    *((name, "f4", 3) for name in ("gyroscope", "accelerometer", "rpy")),
    ("temperature", "u1", 0),
)
LOW_CMD = _go(
    "LowCmd",
    *_HEAD,
    ("motor_cmd", _MOTOR_CMD, 20),
    ("bms_cmd", _go("BmsCmd", ("off", "u1", 0), ("reserve", "u1", 3)), 0),
    ("wireless_remote", "u1", 40),
    ("led", "u1", 12),
    ("fan", "u1", 2),
    ("gpio", "u1", 0),
    ("reserve", "u4", 0),
    ("crc", "u4", 0),
)
"""Topic rt/lowcmd: what the motors are to do."""
LOW_STATE = _go(
    "LowState",
    *_HEAD,
    ("imu_state", _IMU_STATE, 0),
    ("motor_state", _MOTOR_STATE, 20),
    ("bms_state", _BMS_STATE, 0),
    ("foot_force", "i2", 4),
    ("foot_force_est", "i2", 4),
    ("tick", "u4", 0),
    ("wireless_remote", "u1", 40),
    ("bit_flag", "u1", 0),
    ("adc_reel", "f4", 0),
    ("temperature_ntc1", "u1", 0),
    ("temperature_ntc2", "u1", 0),
    ("power_v", "f4", 0),
    ("power_a", "f4", 0),
    ("fan_frequency", "u2", 4),
    ("reserve", "u4", 0),
    ("crc", "u4", 0),
)
"""Topic rt/lowstate: what the robot senses of itself. `tick` counts milliseconds."""

MOTOR_ON = 0x01
"""Mode in which a motor follows its command."""
_LOW_LEVEL = 0xFF


def low_cmd() -> np.ndarray:
    """() LOW_CMD that asks every motor for nothing: no gains, no torque."""
    command = LOW_CMD.zeros()
    command["head"] = (0xFE, 0xEF)
    command["level_flag"] = _LOW_LEVEL
    command["motor_cmd"]["mode"] = MOTOR_ON
    return command


_REVERSED = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))


def crc(record: np.ndarray) -> int:
    """Checksum of a LOW_CMD or LOW_STATE: of all words but the last, most significant bit first.

    The polynomial is zlib's (0x04C11DB7), but no bits are mirrored and nothing is inverted at the end; with bytes
    mirrored before and the result mirrored back, zlib computes it.
    """
    words = np.frombuffer(record.tobytes(), "<u4")[:-1]
    mirrored = zlib.crc32(words.byteswap().tobytes().translate(_REVERSED)) ^ 0xFFFFFFFF
    return int(f"{mirrored:032b}"[::-1], 2)


def sealed(record: np.ndarray) -> np.ndarray:
    """The record with its checksum."""
    record["crc"] = crc(record)
    return record


BUTTONS = (["R1", "L1", "start", "select", "R2", "L2", "F1", "F2"], ["A", "B", "X", "Y", "up", "right", "down", "left"])
"""Bits of bytes 2 and 3 of `wireless_remote`, lowest first."""


@dataclass(frozen=True)
class Remote:
    """Unitree's remote control.

    Attributes:
        pressed: names of buttons, of BUTTONS.
        lx, rx, ry, ly: sticks, -1 to 1, right and up are positive.
    """

    pressed: frozenset[str]
    lx: float
    rx: float
    ry: float
    ly: float


def remote(wireless_remote: np.ndarray) -> Remote:
    """The remote's 40 bytes: two of head, two of buttons, then lx, rx, ry, L2 and ly as float32."""
    data = wireless_remote.tobytes()
    pressed = frozenset(
        name for byte, names in zip(data[2:4], BUTTONS, strict=True) for k, name in enumerate(names) if byte >> k & 1
    )
    lx, rx, ry, _, ly = (float(np.clip(np.nan_to_num(x), -1.0, 1.0)) for x in np.frombuffer(data[4:24], "<f4"))
    return Remote(pressed, lx, rx, ry, ly)
