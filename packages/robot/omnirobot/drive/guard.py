"""The process that owns rt/lowcmd, and outlives the policy's.

    python -m omnirobot.drive.guard SETTINGS FD

`robot` starts it. Targets and requests come through the socket FD; the robot's state it reads itself. When the other
end falls silent or closes, a robot that walks is damped; when it closes, one that stands lies down and is damped, and
after a while the process ends.
"""

from __future__ import annotations

import contextlib
import json
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass

import numpy as np

from omnirobot.drive.machine import DRIVEN, Drive, Machine, MachineConfig, Mode, Request, Sensed
from omnirobot.runtime.description import DeployError
from omnirobot.wire.dds import LOW_CMD_TOPIC, LOW_STATE_TOPIC, Network, Reader
from omnirobot.wire.messages import LOW_CMD, LOW_STATE, crc, low_cmd, remote, sealed
from omnirobot.wire.saying import say

PERIOD_S = 0.002
_RESTART_MS = 1000
"""A state's clock that is as much behind the one before has begun again."""
_DISCOVERY = 10
"""Times `listen_s` that a guard waits for the first state, before it listens for others."""
MODES, REQUESTS = tuple(Mode), tuple(Request)
_TARGETS = struct.Struct("<B12f")
_TARGETS_KIND = 255
REMOTE = {
    Request.STOP: frozenset({"L2", "B"}),
    Request.STAND: frozenset({"L2", "A"}),
    Request.WALK: frozenset({"start"}),
    Request.LIE: frozenset({"L2", "X"}),
    Request.DAMP: frozenset({"L2", "Y"}),
}
"""Buttons of the remote that ask for something while they are held together."""


@dataclass(frozen=True)
class GuardConfig:
    """What a guard needs.

    Attributes:
        machine: times, gains and limits.
        interface: network interface of DDS.
        domain: of DDS.
        check_crc: whether states with another checksum than theirs are refused; simulators that fill none need false.
        listen_s: how long it listens for others who write rt/lowcmd before it writes itself.
        linger_s: how long it damps the joints after the policy's process has gone, before it ends.
    """

    machine: MachineConfig
    interface: str = "lo"
    domain: int = 0
    check_crc: bool = True
    listen_s: float = 0.5
    linger_s: float = 5.0

    def to_json(self) -> str:
        """For the command line."""
        return json.dumps(asdict(self), default=list)

    @classmethod
    def from_json(cls, text: str) -> GuardConfig:
        """Of `to_json`."""
        parts = json.loads(text)
        return cls(machine=MachineConfig(**parts.pop("machine")), **parts)


class StateReader:
    """Newest valid state of the robot.

    Attributes:
        came: valid states.
        refused: states whose length or checksum was wrong.
        repeated: states that were not newer than the one before, by their own clock.
    """

    def __init__(self, reader: Reader, check_crc: bool) -> None:
        """Args: reader: of rt/lowstate; check_crc: whether checksums matter: simulators that fill none need false, and
        their states may be without a clock, too, which is then 0 in all of them."""
        self._reader, self._check_crc = reader, check_crc
        self.came = self.refused = self.repeated = 0
        self._tick: int | None = None
        self._why = ""

    def newest(self) -> np.ndarray | None:
        """() LOW_STATE that has come since the call before; None without a valid one."""
        newest = None
        for data in self._reader.take():
            try:
                state = LOW_STATE.from_cdr(data)
            except DeployError as error:
                self.refused, self._why = self.refused + 1, str(error)
                continue
            if self._check_crc and crc(state) != state["crc"]:
                self.refused += 1
                self._why = "its checksum is wrong; crc=false is for simulators that fill none"
            elif not self._is_newer(int(state["tick"])):
                self.repeated += 1
                self._why = f"it is not newer than the one before, by its tick of {state['tick']}"
            else:
                newest, self.came = state, self.came + 1
        return newest

    def why_silent(self) -> str:
        """What has come since the call before, in place of valid states."""
        why, self._why = self._why, ""
        if not why:
            return self._reader.why_silent()
        return f"{self.refused} were refused, {self.repeated} repeated so far; the newest: {why}"

    def _is_newer(self, tick: int) -> bool:
        """Whether a state's clock (ms) has gone on, or began again; always where simulators fill none."""
        before = self._tick
        has_none = not self._check_crc and tick == 0 and not before
        if before is None or has_none or not -_RESTART_MS < (tick - before + 2**31) % 2**32 - 2**31 <= 0:
            self._tick = tick
            return True
        return False


def sensed(state: np.ndarray, now: float) -> Sensed:
    """What the machine reads of a LOW_STATE."""
    w, x, y, z = state["imu_state"]["quaternion"].astype(float)
    length = w * w + x * x + y * y + z * z
    cos_tilt = 1.0 - 2.0 * (x * x + y * y) / length if length > 0.5 else float("nan")
    motors = state["motor_state"][:12]
    return Sensed(now, motors["q"].astype(float), cos_tilt, motors["temperature"].astype(float))


def command(drive: Drive) -> np.ndarray:
    """() LOW_CMD of what the motors are told, with its checksum."""
    message = low_cmd()
    motors = message["motor_cmd"][:12]
    motors["q"], motors["kp"], motors["kd"] = drive.joint_pos, drive.kp, drive.kd
    return sealed(message)


class Link:
    """The policy's end of the socket."""

    def __init__(self, end: socket.socket) -> None:
        """Args: end: connected, of SOCK_SEQPACKET."""
        self._end = end
        end.setblocking(False)
        self.mode, self.reason, self.is_closed = Mode.DAMPING, "start", False
        self._unsent: list[bytes] = []

    def send_targets(self, targets: np.ndarray) -> None:
        """Joint targets (12,), rad, in the motors' order."""
        self._send(_TARGETS.pack(_TARGETS_KIND, *targets))

    def ask(self, request: Request) -> None:
        """A request; it is sent again by `poll` where the guard is behind."""
        data = bytes([REQUESTS.index(request)])
        if not self._send(data):
            self._unsent.append(data)

    def poll(self) -> None:
        """Reads what the guard has said of itself."""
        while self._unsent and self._send(self._unsent[0]):
            self._unsent.pop(0)
        while True:
            try:
                said = self._end.recv(512)
            except BlockingIOError:
                return
            except OSError:
                said = b""
            if not said:
                self.is_closed = True
                return
            self.mode, self.reason = MODES[said[0]], said[1:].decode("utf-8", "replace")

    def close(self) -> None:
        """Leaves the guard alone: it sees to the robot and ends."""
        self._end.close()
        self.is_closed = True

    def _send(self, data: bytes) -> bool:
        """Whether it need not be sent again; targets that the guard has no room for are not: newer ones follow."""
        try:
            self._end.send(data)
        except BlockingIOError:
            return False
        except OSError:
            self.is_closed = True
        return True


def start(config: GuardConfig) -> tuple[Link, subprocess.Popen]:
    """A guard as a process of its own session, which signals to this one's group do not reach."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    words = [sys.executable, "-m", "omnirobot.drive.guard", config.to_json(), str(theirs.fileno())]
    process = subprocess.Popen(words, pass_fds=(theirs.fileno(),), start_new_session=True, stdin=subprocess.DEVNULL)
    theirs.close()
    return Link(ours), process


class Guard:
    """One robot's guard on the wire.

    Attributes:
        machine: its modes.
    """

    def __init__(self, config: GuardConfig, link: socket.socket, network: Network) -> None:
        self._config, self._link = config, link
        link.setblocking(False)
        self.machine = Machine(config.machine)
        self._states = StateReader(network.reader(LOW_STATE_TOPIC, LOW_STATE, 4), config.check_crc)
        self._refuse_others(network)
        self._writer = network.writer(LOW_CMD_TOPIC, LOW_CMD)
        self._held: set[Request] = set()
        self._gone_since: float | None = None
        self._is_asked_to_leave = False
        self._said, self._has_said_unsent = b"", False

    def _refuse_others(self, network: Network) -> None:
        """Listens from the first state on: before it, nobody may have been found on the network yet."""
        others = network.reader(LOW_CMD_TOPIC, LOW_CMD)
        heard, end = False, time.monotonic() + _DISCOVERY * self._config.listen_s
        while time.monotonic() < end:
            if not heard and self._states.newest() is not None:
                heard, end = True, time.monotonic() + self._config.listen_s
            if others.take():
                raise DeployError(
                    "somebody else writes rt/lowcmd: end that program, and release the on-board sport mode in Unitree's"
                    " app or with MotionSwitcherClient.ReleaseMode()"
                )
            time.sleep(0.01)

    def leave(self, *_: object) -> None:
        """Lays the robot down and ends, a handler of signals; a policy that still drives it may slow it down first."""
        self._is_asked_to_leave = True

    def run(self) -> None:
        """Until the policy's process has gone and the joints have been damped for a while."""
        due = time.monotonic()
        while not self._is_over(time.monotonic()):
            try:
                self.tick(time.monotonic())
            except Exception as error:  # whatever it is: damped joints are better than joints left alone
                self.machine.ask(time.monotonic(), Request.STOP)
                say(f"guard: e-stop: {type(error).__name__}: {error}")
                with contextlib.suppress(Exception):  # the next period tries again
                    self._drive(time.monotonic())
            due = max(due + PERIOD_S, time.monotonic() - PERIOD_S)  # what was missed is not made up for
            time.sleep(max(0.0, due - time.monotonic()))

    def tick(self, now: float) -> None:
        """One period: reads, decides, writes."""
        state = self._states.newest()
        if state is not None:
            self.machine.sense(sensed(state, now))
            self._follow_remote(state, now)
        self._read_link(now)
        self._drive(now)
        self._report()

    def _drive(self, now: float) -> None:
        self._writer.write(LOW_CMD.to_cdr(command(self.machine.drive(now))))

    def _follow_remote(self, state: np.ndarray, now: float) -> None:
        pressed = remote(state["wireless_remote"]).pressed
        asked = {request for request, buttons in REMOTE.items() if buttons <= pressed}
        for request in asked - self._held:
            self.machine.ask(now, request)
        self._held = asked

    def _read_link(self, now: float) -> None:
        if self._is_asked_to_leave and self._gone_since is None:
            if self.machine.mode not in DRIVEN:
                self._gone_since = now
            elif self.machine.mode is not Mode.SLOWING:
                self.machine.ask(now, Request.LIE)
        while self._gone_since is None:
            try:
                data = self._link.recv(256)
            except BlockingIOError:
                return
            except OSError:
                data = b""
            if not data:
                self._gone_since = now
            elif data[0] == _TARGETS_KIND and len(data) == _TARGETS.size:
                self.machine.follow(now, np.array(_TARGETS.unpack(data)[1:]))
            elif data[0] < len(REQUESTS):
                self.machine.ask(now, REQUESTS[data[0]])

    def _report(self) -> None:
        """Says its mode when it has changed, and once that commands do not reach the network."""
        if self._writer.unsent and not self._has_said_unsent:
            self._has_said_unsent = True
            say(f"guard: {LOW_CMD_TOPIC}: the network has not taken a command: a reader is behind, or it is gone")
        said = bytes([MODES.index(self.machine.mode)]) + self.machine.reason.encode()[:200]
        if said != self._said:
            self._said = said
            say(f"guard: {self.machine.mode}: {self.machine.reason}")
            with contextlib.suppress(OSError):  # nobody listens any more
                self._link.send(said)

    def _is_over(self, now: float) -> bool:
        if self._gone_since is None:
            return False
        if self.machine.mode not in (Mode.DAMPING, Mode.STOPPED):
            if self.machine.mode is not Mode.LYING_DOWN:
                self.machine.ask(now, Request.LIE)
            self._gone_since = now
        return now - self._gone_since > self._config.linger_s


def main(argv: list[str], exit_with: Callable[[int], None] = sys.exit) -> None:
    """The process."""
    config, link = GuardConfig.from_json(argv[0]), socket.socket(fileno=int(argv[1]))
    try:
        guard = Guard(config, link, Network(config.interface, config.domain))
    except DeployError as error:
        print(f"error: {error}", file=sys.stderr, flush=True)
        return exit_with(2)
    for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT):  # service managers send several, to all processes
        signal.signal(number, guard.leave)
    guard.run()


if __name__ == "__main__":
    main(sys.argv[1:])
