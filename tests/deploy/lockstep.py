"""A simulated robot, a guard and a policy's loop in one process, step by step: the wire without clocks.

DDS is a dictionary of bytes here; the LiDAR's packets and the operator's words go over UDP on the loopback, where a
datagram is there when `sendto` returns.
"""

import socket
from collections import defaultdict, deque
from pathlib import Path

from omniperception import build, config
from omniperception.deploy.simulated import CONTROL_STEPS, STEP_S, SimulatedConfig, SimulatedRobot
from omniperception.env.env import OmniEnv
from omnirobot.drive.control import Control, machine_config
from omnirobot.drive.guard import Guard, GuardConfig, Link, StateReader
from omnirobot.drive.operator import make_operator
from omnirobot.drive.recording import Recorder
from omnirobot.runtime import ExportedPolicy
from omnirobot.wire.dds import LOW_STATE_TOPIC
from omnirobot.wire.lidar import Frames, LidarSource
from omnirobot.wire.messages import LOW_STATE

ROOT = Path(__file__).resolve().parents[2]


class Memory:
    """Stands in for `dds.Network`; `damage` may change or drop what a topic carries."""

    def __init__(self):
        self._queues = defaultdict(list)
        self.damage = {}

    def reader(self, topic, kind, depth=1):
        queue = deque(maxlen=depth)
        self._queues[topic].append(queue)

        class Reader:
            def take(self):
                taken = list(queue)
                queue.clear()
                return taken

        return Reader()

    def writer(self, topic, kind):
        network = self

        class Writer:
            unsent = 0

            def write(self, cdr):
                for part in network.damage.get(topic, lambda data: [data])(cdr):
                    for queue in network._queues[topic]:
                        queue.append(part)

        return Writer()


class Lockstep:
    """The three, and time; `policy_lives` and the attributes of their own are for faults.

    Attributes:
        robot, guard, control: the parts.
        time_s: simulated.
    """

    def __init__(self, exported, *overrides, run_dir=ROOT / "pretrained" / "avoider", record=None, **changes):
        steps = [f"sim.timestep={STEP_S}", f"sim.decimation={CONTROL_STEPS}", "sim.num_threads=1", "num_envs=1"]
        env = OmniEnv(build.assemble(config.load(run_dir, [*overrides, *steps])).env)
        self.network, description = Memory(), ExportedPolicy.load(exported).description
        lidar, self.operator = _free_port(), _free_port()
        wire = SimulatedConfig(point_to=lidar, steer_to=self.operator, **changes)
        self.robot = SimulatedRobot(env, wire, self.network)
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.link, crc = Link(ours), wire.crc
        guard = GuardConfig(machine_config(description), check_crc=crc, listen_s=1e-9)
        self.guard = Guard(guard, theirs, self.network)
        source = LidarSource(kind="packets", host="127.0.0.1", point_port=lidar)
        frames = Frames(source, description.lidar, self.network)
        states = StateReader(self.network.reader(LOW_STATE_TOPIC, LOW_STATE), crc)
        operator = make_operator(f"udp:{self.operator}", description.command)
        self.recorder = None if record is None else Recorder(record, description)
        self.control = Control(ExportedPolicy.load(exported), states, frames, operator, self.link, self.recorder)
        self.policy_lives, self.guard_lives = True, True

    @property
    def time_s(self):
        return self.robot.time_s

    @property
    def machine(self):
        return self.guard.machine

    def run(self, seconds, until=lambda: False):
        """Steps on for `seconds`, or until something is so."""
        end = self.time_s + seconds
        while self.time_s < end - 1e-9 and not until():
            self.robot.step()
            now = 1000.0 + self.time_s
            if self.policy_lives and round(self.time_s / STEP_S) % CONTROL_STEPS == 0:
                self.control.step(now)
            if self.guard_lives:
                self.guard.tick(now)
        return self

    def close(self):
        self.robot.close()
        self.control._frames.close()
        self.control._operator.close()


def _free_port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as found:
        found.bind(("127.0.0.1", 0))
        return found.getsockname()[1]
