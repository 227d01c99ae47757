"""Which of the robot's own controllers moves it, by Unitree's service motion_switcher, and its release.

Topics, types, numbers and the JSON in them are those of unitree_sdk2_python's MotionSwitcherClient.
"""

from __future__ import annotations

import itertools
import json
import struct
import time
from dataclasses import dataclass

from omnirobot.runtime.description import DeployError
from omnirobot.wire.dds import REQUEST, RESPONSE, Network

REQUEST_TOPIC, RESPONSE_TOPIC = "rt/api/motion_switcher/request", "rt/api/motion_switcher/response"
CHECK, RELEASE = 1001, 1003
CHOICES = ("check", "release", "ignore")
_HEADER = b"\x00\x01\x00\x00"
_ASKED = struct.Struct("<qqqi?3xI")
_ANSWERED = struct.Struct("<qqiI")
_REPEAT_S = 0.5


@dataclass(frozen=True)
class Asked:
    """A request: its own number, that of the function, and parameters as JSON."""

    number: int
    function: int
    parameter: str = "{}"

    def to_cdr(self) -> bytes:
        """A unitree_api Request_ without lease, priority or binary part."""
        return _HEADER + _with_text(_ASKED, (self.number, self.function, 0, 0, False), self.parameter)

    @classmethod
    def from_cdr(cls, data: bytes) -> Asked:
        """Of `to_cdr`; a DeployError for what is cut off."""
        (number, function, *_), text = _read(_ASKED, data)
        return cls(number, function, text)


@dataclass(frozen=True)
class Answered:
    """An answer: numbers of the request, code (0: done), and JSON."""

    number: int
    function: int
    code: int
    data: str = ""

    def to_cdr(self) -> bytes:
        """A unitree_api Response_ without binary part."""
        return _HEADER + _with_text(_ANSWERED, (self.number, self.function, self.code), self.data)

    @classmethod
    def from_cdr(cls, data: bytes) -> Answered:
        """Of `to_cdr`; a DeployError for what is cut off."""
        (number, function, code, _), text = _read(_ANSWERED, data)
        return cls(number, function, code, text)


def _with_text(head: struct.Struct, values: tuple, text: str) -> bytes:
    """The head, whose last number is the text's length, the text, and an empty sequence."""
    encoded = text.encode() + b"\0"
    body = head.pack(*values, len(encoded)) + encoded
    return body + bytes(-len(body) % 4) + bytes(4)


def _read(head: struct.Struct, data: bytes) -> tuple[tuple, str]:
    if data[:2] != _HEADER[:2] or len(data) < 4 + head.size:
        raise DeployError(f"motion_switcher: {len(data)} bytes beginning {data[:4].hex()} are no message of it")
    values, at = head.unpack_from(data, 4), 4 + head.size
    text = data[at : at + values[-1]]
    if len(text) != values[-1]:
        raise DeployError("motion_switcher: a message is cut off")
    return values, text.rstrip(b"\0").decode("utf-8", "replace")


class Switcher:
    """The client's end."""

    def __init__(self, network: Network) -> None:
        self._answers = network.reader(RESPONSE_TOPIC, RESPONSE, 8)
        self._requests = network.writer(REQUEST_TOPIC, REQUEST)
        self._numbers = itertools.count(time.monotonic_ns())

    def controller(self, timeout_s: float = 3.0) -> str | None:
        """Name of the controller that moves the robot; empty: none does; None: the service is silent."""
        answer = self._call(CHECK, timeout_s)
        if answer is None:
            return None
        try:
            return str(json.loads(answer.data)["name"])
        except (ValueError, KeyError, TypeError):
            raise DeployError(f"motion_switcher: a name was expected, {answer.data[:80]!r} given") from None

    def release(self, timeout_s: float = 8.0) -> None:
        """Ends the controller; a DeployError if it still runs after `timeout_s`."""
        end, name = time.monotonic() + timeout_s, self.controller()
        while name:
            if time.monotonic() > end:
                raise DeployError(f"the on-board controller '{name}' still runs {timeout_s:g} s after its release")
            self._call(RELEASE, 1.0)
            name = self.controller()
        if name is None:
            raise DeployError("motion_switcher has not answered while the on-board controller was released")

    def _call(self, function: int, timeout_s: float) -> Answered | None:
        """The answer to a request, which is repeated until it comes; None: none came."""
        request = Asked(next(self._numbers), function)
        end, again = time.monotonic() + timeout_s, 0.0
        while time.monotonic() < end:
            if time.monotonic() >= again:
                again = time.monotonic() + _REPEAT_S
                self._requests.write(request.to_cdr())
            for data in self._answers.take():
                answer = Answered.from_cdr(data)
                if (answer.number, answer.function) == (request.number, function):
                    if answer.code:
                        raise DeployError(f"motion_switcher refuses function {function} (code {answer.code})")
                    return answer
            time.sleep(0.01)
        return None


def ensure_released(network: Network, choice: str) -> None:
    """Refuses to go on while a controller of the robot's own moves it.

    Args:
        network: of the robot.
        choice: 'check'; 'release': it is ended; 'ignore': nobody is asked.
    """
    if choice == "ignore":
        return
    switcher = Switcher(network)
    name = switcher.controller()
    if name is None:
        raise DeployError(
            "motion_switcher does not answer, so that nobody knows whether the on-board sport mode is released; for a"
            " simulator without it: sport_mode=ignore"
        )
    if not name:
        return
    if choice == "check":
        raise DeployError(
            f"the on-board controller '{name}' moves the robot: lay it down, then sport_mode=release ends it"
        )
    switcher.release()


class SwitcherService:
    """The robot's end, for simulations.

    Attributes:
        controller: that moves the robot; empty: none does.
    """

    def __init__(self, network: Network, controller: str) -> None:
        self.controller = controller
        self._requests = network.reader(REQUEST_TOPIC, REQUEST, 8)
        self._answers = network.writer(RESPONSE_TOPIC, RESPONSE)

    def answer(self) -> None:
        """Answers what has been asked since the call before."""
        for data in self._requests.take():
            asked = Asked.from_cdr(data)
            if asked.function == RELEASE:
                self.controller = ""
            is_known = asked.function in (CHECK, RELEASE)
            said = json.dumps({"form": "0", "name": self.controller}) if asked.function == CHECK else ""
            self._answers.write(Answered(asked.number, asked.function, 0 if is_known else 3203, said).to_cdr())
