"""Faults of a robot's wire, for simulations: what becomes of LiDAR packets and states while one lasts."""

from __future__ import annotations

import struct

import numpy as np

from omnirobot.wire.livox import HEADER, POINT
from omnirobot.wire.messages import LOW_STATE, sealed

FAULTS = {
    "unplug": "no LiDAR packet comes",
    "drop": "three of ten LiDAR packets are lost",
    "double": "every LiDAR packet comes twice",
    "shuffle": "LiDAR packets come eight at a time, the last first",
    "thin": "one of ten LiDAR packets comes",
    "slice": "of each tenth of a second the packets of the first hundredth come",
    "wedge": "a tenth of the circle has points, another one in each tenth of a second",
    "covered": "half of the circle has no points",
    "clock": "the LiDAR's clock jumps ahead by an hour, and back at the end",
    "crc": "states have a wrong checksum",
    "nan": "the IMU's orientation is not a number",
    "silence": "no state comes",
}
SENSORS = ("unplug", "drop", "double", "shuffle", "thin", "slice", "wedge", "covered", "clock")
"""Faults of the LiDAR, after which the robot should walk on."""
_DROPPED, _TOGETHER, _JUMP_NS = 0.3, 8, 3600 * 10**9
_KEPT, _FRAME_NS = 0.1, 10**8
_TIME = struct.Struct("<Q")
_TIME_AT = 28
"""Of a packet's timestamp."""


class Faults:
    """One fault, for a while.

    Attributes:
        name: of FAULTS; empty: none.
        begun_s: when it began; None: it has not.
    """

    def __init__(self, name: str, lasts_s: float) -> None:
        """Args: name: of FAULTS, or empty; lasts_s: how long it lasts."""
        self.name, self._lasts_s = name, lasts_s
        self.begun_s: float | None = None
        self._random = np.random.default_rng(0)
        self._held: list[bytes] = []

    def begin(self, now: float) -> None:
        """From now on; once."""
        if self.name and self.begun_s is None:
            self.begun_s = now

    def ended(self, now: float) -> bool:
        """Whether it has come and gone."""
        return self.begun_s is not None and now >= self.begun_s + self._lasts_s

    def _is(self, now: float, *names: str) -> bool:
        return self.name in names and self.begun_s is not None and not self.ended(now)

    def packets(self, now: float, packets: list[bytes]) -> list[bytes]:
        """What arrives of LiDAR packets."""
        if self._is(now, "unplug"):
            return []
        if self._is(now, "drop"):
            return [packet for packet in packets if self._random.random() >= _DROPPED]
        if self._is(now, "thin"):
            return [packet for packet in packets if self._random.random() < _KEPT]
        if self._is(now, "slice"):
            return [packet for packet in packets if _time(packet) % _FRAME_NS < _KEPT * _FRAME_NS]
        if self._is(now, "wedge"):
            return [_within(packet, _time(packet) // _FRAME_NS * 0.37, _KEPT) for packet in packets]
        if self._is(now, "covered"):
            return [_within(packet, 0.0, 0.5) for packet in packets]
        if self._is(now, "double"):
            return [packet for packet in packets for _ in range(2)]
        if self._is(now, "clock"):
            return [_later(packet, _JUMP_NS) for packet in packets]
        held, self._held = [*self._held, *packets], []
        if self._is(now, "shuffle"):
            whole = len(held) // _TOGETHER * _TOGETHER
            self._held = held[whole:]
            groups = [held[k : k + _TOGETHER] for k in range(0, whole, _TOGETHER)]
            return [packet for group in groups for packet in reversed(group)]
        return held

    def state(self, now: float, state: np.ndarray) -> bytes | None:
        """What arrives of a LOW_STATE, as CDR; None: nothing does."""
        if self._is(now, "silence"):
            return None
        if self._is(now, "nan"):
            state["imu_state"]["quaternion"] = np.nan
            state = sealed(state)
        elif self._is(now, "crc"):
            state["crc"] ^= 1
        return LOW_STATE.to_cdr(state)


def _later(packet: bytes, by_ns: int) -> bytes:
    """A LiDAR packet with another timestamp."""
    return packet[:_TIME_AT] + _TIME.pack(_time(packet) + by_ns) + packet[_TIME_AT + _TIME.size :]


def _time(packet: bytes) -> int:
    """Of a LiDAR packet, ns."""
    return _TIME.unpack_from(packet, _TIME_AT)[0]


def _within(packet: bytes, begin: float, width: float) -> bytes:
    """A LiDAR packet whose points outside a part of the circle, in turns, are misses."""
    rows = np.frombuffer(bytearray(packet[HEADER:]), POINT)
    turns = np.arctan2(rows["xyz"][:, 1], rows["xyz"][:, 0]) / (2.0 * np.pi)
    rows["xyz"][(turns - begin) % 1.0 >= width] = 0
    return packet[:HEADER] + rows.tobytes()
