"""Where commands come from: the remote's sticks, datagrams, the keyboard, a goal, or one command for good."""

from __future__ import annotations

import contextlib
import os
import re
import select
import socket
import sys
from collections.abc import Mapping, Sequence

import numpy as np

from omnirobot.drive.machine import Request
from omnirobot.runtime.description import DeployError
from omnirobot.runtime.safety import command_limits
from omnirobot.wire.messages import Remote

_STALE_S = 0.5
_SEQUENCE = re.compile("\x1b[\\[O][0-9;]*[A-Za-z~]")
"""What a terminal sends for arrows and function keys, which begin as the Escape key does."""


class Operator:
    """Somebody who commands."""

    def poll(self, now: float, remote: Remote, pose: np.ndarray) -> tuple[np.ndarray, list[Request]]:
        """(3,) v_x, v_y (m/s), yaw rate (rad/s), and what has been asked for since the call before.

        Args:
            now: s.
            remote: the robot's.
            pose: (3,) x, y (m) and heading (rad) of the base in its odometry, which begins with the policy.
        """
        raise NotImplementedError

    def close(self) -> None:
        """Ends it."""


def make_operator(text: str, ranges: Mapping[str, Sequence[float]]) -> Operator:
    """Of `steer=remote`, `keyboard`, `udp:PORT`, `goal:X,Y` or `V_X,V_Y,YAW_RATE`; ranges: of the policy's training."""
    if text == "remote":
        return Sticks(ranges)
    if text == "keyboard":
        return Keyboard(ranges)
    if text.startswith("udp:") and text[4:].isdecimal() and int(text[4:]) > 0:
        return Datagrams(int(text[4:]))
    with contextlib.suppress(ValueError):
        numbers = [float(part) for part in text.removeprefix("goal:").split(",")]
        if not np.isfinite(numbers).all():
            raise ValueError
        if text.startswith("goal:") and len(numbers) in (2, 3) and all(speed > 0 for speed in numbers[2:]):
            return Goal(numbers[:2], ranges, *numbers[2:])
        if not text.startswith("goal:") and len(numbers) == 3:
            return Constant(numbers)
    raise DeployError(f"steer={text}: remote, keyboard, udp:PORT, goal:X,Y[,SPEED] or V_X,V_Y,YAW_RATE was expected")


def scaled(shares: Sequence[float], ranges: Mapping[str, Sequence[float]]) -> np.ndarray:
    """(3,) command of shares -1 to 1 of each range, 0 being 0."""
    limits = command_limits(ranges)
    return np.array([s * (high if s > 0 else -low) for s, low, high in zip(shares, *limits, strict=True)])


class Sticks(Operator):
    """The remote: left stick ahead and aside, right stick turns. The guard reads its buttons."""

    def __init__(self, ranges: Mapping[str, Sequence[float]]) -> None:
        self._ranges = ranges

    def poll(self, now: float, remote: Remote, pose: np.ndarray) -> tuple[np.ndarray, list[Request]]:
        shares = [0.0 if abs(s) < 0.05 else s for s in (remote.ly, -remote.lx, -remote.rx)]
        return scaled(shares, self._ranges), []


class Constant(Operator):
    """One command; standing up and walking are asked for by the remote."""

    def __init__(self, command: Sequence[float]) -> None:
        self._command = np.array(command)

    def poll(self, now: float, remote: Remote, pose: np.ndarray) -> tuple[np.ndarray, list[Request]]:
        return self._command, []


class Goal(Operator):
    """Leads to a place in the robot's odometry, facing it, and stays there; slower over the last metre."""

    _RADIUS, _SLOW_WITHIN, _YAW_GAIN = 0.3, 1.0, 1.0

    def __init__(self, goal: Sequence[float], ranges: Mapping[str, Sequence[float]], speed: float = 0.5) -> None:
        """Args: goal: x ahead and y to the left (m) of where the policy begins; speed: m/s."""
        self._goal, self._speed = np.array(goal), speed
        self._low, self._high = command_limits(ranges)

    def poll(self, now: float, remote: Remote, pose: np.ndarray) -> tuple[np.ndarray, list[Request]]:
        way = self._goal - pose[:2]
        distance = float(np.hypot(*way))
        if distance < self._RADIUS:
            return np.zeros(3), []
        error = np.remainder(np.arctan2(way[1], way[0]) - pose[2] + np.pi, 2 * np.pi) - np.pi
        pace = self._speed * min(1.0, distance / self._SLOW_WITHIN)
        wanted = np.array([pace * np.cos(error), pace * np.sin(error), self._YAW_GAIN * error])
        return np.clip(wanted, self._low, self._high), []


class Datagrams(Operator):
    """Text to a UDP port of this machine: 'V_X V_Y YAW_RATE' (holds for 0.5 s), or stand, walk, lie, damp, stop."""

    def __init__(self, port: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            self._socket.bind(("127.0.0.1", port))
        except (OSError, OverflowError) as error:
            self._socket.close()
            raise DeployError(f"steer=udp:{port}: the port cannot be listened to ({error})") from None
        self._command, self._since = np.zeros(3), -1e9

    def poll(self, now: float, remote: Remote, pose: np.ndarray) -> tuple[np.ndarray, list[Request]]:
        asked = []
        while True:
            try:
                words = self._socket.recv(256).decode("ascii", "replace").split()
            except BlockingIOError:
                break
            if len(words) == 1 and words[0] in tuple(Request):
                asked.append(Request(words[0]))
                continue
            with contextlib.suppress(ValueError):
                command = np.array([float(word) for word in words])
                if command.shape == (3,) and np.isfinite(command).all():
                    self._command, self._since = command, now
        is_fresh = now - self._since < _STALE_S
        return self._command if is_fresh else np.zeros(3), asked

    def close(self) -> None:
        self._socket.close()


class Keyboard(Operator):
    """w s ahead, a d aside, q e turn, by a fifth each; space stops; 1 stand, 2 walk, 3 lie, 0 damp, Escape e-stop.

    When its terminal is gone it commands 0 and asks once to lie down.
    """

    _STEPS = {"w": (0, 1), "s": (0, -1), "a": (1, 1), "d": (1, -1), "q": (2, 1), "e": (2, -1)}
    _REQUESTS = {
        "1": Request.STAND,
        "2": Request.WALK,
        "3": Request.LIE,
        "0": Request.DAMP,
        "\x1b": Request.STOP,
    }

    def __init__(self, ranges: Mapping[str, Sequence[float]]) -> None:
        if not sys.stdin.isatty():
            raise DeployError("steer=keyboard needs a terminal")
        import termios
        import tty

        self._ranges, self._shares, self._is_gone = ranges, np.zeros(3), False
        self._before = termios.tcgetattr(sys.stdin)
        tty.setcbreak(sys.stdin)

    def poll(self, now: float, remote: Remote, pose: np.ndarray) -> tuple[np.ndarray, list[Request]]:
        asked = []
        while not self._is_gone and select.select([sys.stdin], [], [], 0.0)[0]:
            typed = _typed()
            if not typed:
                self._is_gone, self._shares = True, np.zeros(3)
                asked.append(Request.LIE)
            for key in _SEQUENCE.sub("", typed):
                if key in self._REQUESTS:
                    asked.append(self._REQUESTS[key])
                elif key in self._STEPS:
                    axis, sign = self._STEPS[key]
                    self._shares[axis] = np.clip(self._shares[axis] + 0.2 * sign, -1.0, 1.0)
                elif key == " ":
                    self._shares[:] = 0.0
        return scaled(self._shares.tolist(), self._ranges), asked

    def close(self) -> None:
        import termios

        with contextlib.suppress(termios.error):  # the terminal may be gone
            termios.tcsetattr(sys.stdin, termios.TCSADRAIN, self._before)


def _typed() -> str:
    """What waits at the terminal; empty: it is gone."""
    try:
        return os.read(sys.stdin.fileno(), 64).decode("ascii", "replace")
    except OSError:
        return ""
