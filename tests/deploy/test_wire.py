"""A simulated robot, its guard and the published policy together, step by step; and processes over DDS."""

import contextlib
import importlib.util
import itertools
import os
import pty
import signal
import socket
import struct
import subprocess
import sys
import termios
import time
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("onnxruntime", reason="extra deploy")
pytest.importorskip("onnx", reason="extra export")

from lockstep import ROOT, Lockstep, Memory
from messages_by_hand import LIVOX, point_cloud2

from omniperception.commands import main
from omniperception.deploy.export import export
from omniperception.deploy.faults import FAULTS, SENSORS
from omniperception.deploy.trials import results
from omnirobot.common.signals import interruptible
from omnirobot.drive import control, guard
from omnirobot.drive.control import machine_config, motor_order
from omnirobot.drive.machine import Mode, Request
from omnirobot.drive.recording import make_folder
from omnirobot.replay.bags import Topics, events
from omnirobot.replay.replay import draw, replay
from omnirobot.runtime import DeployError, Description, ExportedPolicy
from omnirobot.wire import lidar
from omnirobot.wire.dds import CUSTOM_MSG, LOW_CMD_TOPIC, LOW_STATE_TOPIC, POINT_CLOUD2, Network
from omnirobot.wire.lidar import Frames, LidarSource
from omnirobot.wire.messages import LOW_CMD, LOW_STATE, crc, low_cmd, sealed


@pytest.fixture(scope="session")
def exported(tmp_path_factory):
    """The published policy."""
    folder = tmp_path_factory.mktemp("avoider")
    export(ROOT / "pretrained" / "avoider", folder, ("onnx",))
    return folder


@pytest.fixture
def lockstep(exported):
    """Makes the three; all are closed at the end."""
    made = []

    def make(*overrides, **changes):
        made.append(Lockstep(exported, *overrides, **changes))
        return made[-1]

    yield make
    for each in made:
        each.close()


def walking(robot, seconds=2.0):
    """It has stood up by itself, and walked for a while."""
    robot.run(6.0, lambda: robot.machine.mode is Mode.POLICY)
    assert robot.machine.mode is Mode.POLICY and robot.robot.up_since is not None, robot.machine.reason
    return robot.run(seconds)


def speed(robot):
    return float(np.linalg.norm(robot.robot._env.sim.qvel[0, :2]))


def is_lying(robot):
    z = float(robot.robot._env.sim.qpos[0, 2])
    return z < 0.15 and robot.machine.mode in (Mode.DAMPING, Mode.STOPPED)


def test_it_stands_up_and_walks_and_is_damped_when_the_policy_dies(lockstep, exported, tmp_path):
    """And what was recorded meanwhile gives the same targets again."""
    record = tmp_path / "run.mcap" if importlib.util.find_spec("mcap_ros2") else None
    robot = walking(lockstep("scenario=static", record=record), 1.5)
    policy = robot.control.policy
    assert speed(robot) > 0.4 and policy.frame_count == policy.description.perception.history
    robot.policy_lives = False
    robot.run(0.05)
    assert robot.machine.mode is Mode.DAMPING and "the policy is silent" in robot.machine.reason
    robot.run(2.3)
    assert is_lying(robot) and robot.robot.outcome.largest_tilt_deg < 30 and not robot.robot.outcome.fell
    if record is not None:
        robot.recorder.close()
        replayed_is_recorded(record, exported)


def replayed_is_recorded(record, exported):
    """Bit by bit, and it is drawn."""
    policy = ExportedPolicy.load(exported)
    replayed = replay(policy, events(record, Topics()))
    assert len(replayed.steps) > 100 and len(replayed.frames()) > 10 and not replayed.stops
    np.testing.assert_array_equal(replayed.targets(), replayed.recorded)
    walked = [step for step in replayed.steps if step.mode.startswith("policy")]
    assert len(walked) >= 75 and np.linalg.norm(walked[-1].command[:2]) > 0.5
    draw(replayed, policy, record.with_suffix(".png"))
    assert record.with_suffix(".png").stat().st_size > 20_000
    blind = replay(ExportedPolicy.load(exported), (event for event in events(record, Topics()) if event.points is None))
    assert (
        not blind.frames() and blind.lidar[-1] == "stopped" and np.nanmax(abs(blind.targets() - blind.recorded)) > 0.05
    )
    seen = {status for status, step in zip(blind.lidar, blind.steps, strict=True) if step.mode.startswith("policy")}
    assert seen == {"stopped"}  # a policy that has never had a frame does not begin to walk


class SteppedClock:
    """In place of `time`: sleeping steps the robot and its guard on; signals (s, name) come in their order."""

    def __init__(self, robot, signals):
        self._robot, self._signals = robot, [(robot.time_s + at, name) for at, name in signals]

    def monotonic(self):
        return 1000.0 + self._robot.time_s

    def sleep(self, seconds):
        self._robot.run(seconds)
        if self._signals and self._robot.time_s >= self._signals[0][0]:
            os.kill(os.getpid(), signal.Signals[self._signals.pop(0)[1]])


@pytest.fixture
def heard():
    """Signals as at a terminal; where tests run in the background some are ignored, and so they would be here."""
    usual = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL, signal.SIGHUP: signal.SIG_DFL}
    before = {number: signal.signal(number, handler) for number, handler in usual.items()}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.usefixtures("heard")
@pytest.mark.parametrize(
    "signals",
    [[(0.3, "SIGINT"), (0.7, "SIGTERM")], pytest.param([(0.3, "SIGTERM"), (0.7, "SIGHUP")], marks=pytest.mark.slow)],
)
def test_a_signal_while_it_walks_slows_it_down_and_lays_it_down(lockstep, monkeypatch, signals):
    """And a second one changes nothing, as a service manager sends it."""
    robot = walking(lockstep("scenario=static"), 1.0)
    robot.policy_lives, modes, enter = False, [], robot.machine._enter  # `drive` steps it
    monkeypatch.setattr(robot.machine, "_enter", lambda now, mode, why: (modes.append(mode), enter(now, mode, why)))
    clock = SteppedClock(robot, signals)
    monkeypatch.setattr(control, "time", clock)
    with interruptible():
        begins, _, _ = control.drive(robot.control, robot.link, 0.02)
    assert 14 <= len(begins) <= 17 and modes == [Mode.SLOWING, Mode.LYING_DOWN] and not clock._signals
    assert speed(robot) < 0.3
    robot.link.close()
    robot.run(3.0)
    assert modes == [Mode.SLOWING, Mode.LYING_DOWN, Mode.DAMPING] and "lay down" in robot.machine.reason
    assert is_lying(robot) and not robot.robot.outcome.fell and robot.robot.outcome.largest_tilt_deg < 30


@pytest.mark.slow
def test_a_guard_that_is_told_to_leave_lays_a_walking_robot_down(lockstep, monkeypatch):
    """While the policy is there and slows it down, as where a service manager ends both."""
    robot = walking(lockstep("scenario=static"), 1.0)
    modes, enter = [], robot.machine._enter
    monkeypatch.setattr(robot.machine, "_enter", lambda now, mode, why: (modes.append(mode), enter(now, mode, why)))
    robot.guard.leave()
    robot.run(4.0)
    assert modes == [Mode.SLOWING, Mode.LYING_DOWN, Mode.DAMPING]
    assert robot.guard._is_over(1000.0 + robot.time_s + 60.0)
    assert is_lying(robot) and not robot.robot.outcome.fell and robot.robot.outcome.largest_tilt_deg < 30


@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_signals_interrupt_once_and_mean_afterwards_what_they_did(name):
    """One that was ignored, as under nohup, stays so."""
    both = (signal.SIGTERM, signal.SIGHUP)
    number, before = signal.Signals[name], [signal.signal(one, signal.SIG_DFL) for one in both]
    try:
        with interruptible():
            with pytest.raises(KeyboardInterrupt):
                os.kill(os.getpid(), number)
            os.kill(os.getpid(), number)
        assert [signal.getsignal(one) for one in both] == [signal.SIG_DFL] * 2
        signal.signal(number, signal.SIG_IGN)
        with interruptible():
            os.kill(os.getpid(), number)
        assert signal.getsignal(number) is signal.SIG_IGN
    finally:
        for one, handler in zip(both, before, strict=True):
            signal.signal(one, handler)


def unplugged(robot):
    robot.robot.scanner._to = None


def plugged(robot, to):
    robot.robot.scanner._to = to


@pytest.mark.slow
def test_without_its_lidar_it_stands_and_then_walks_on(lockstep):
    robot = walking(lockstep("scenario=static"))
    to = robot.robot.scanner._to
    unplugged(robot)
    robot.run(0.35 + 0.3 + 0.5)
    assert speed(robot) < 0.3
    robot.run(0.85)
    assert speed(robot) < 0.15 and robot.machine.mode is Mode.POLICY
    plugged(robot, to)
    robot.run(2.0)
    assert speed(robot) > 0.4 and not robot.robot.outcome.fell


def not_a_number(data):
    state = LOW_STATE.from_cdr(data)
    state["imu_state"]["quaternion"] = np.nan
    return [LOW_STATE.to_cdr(sealed(state))]


def wrong_checksum(data):
    return [data[:100] + bytes([data[100] ^ 1]) + data[101:]]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (wrong_checksum, "no valid state for 40 ms"),
        (lambda data: [], "no valid state for 40 ms"),
        (lambda data: [data[:-8]], "no valid state for 40 ms"),
        (not_a_number, "the state is not finite"),
    ],
)
def test_a_state_that_is_none_damps_the_joints(lockstep, damage, reason):
    robot = walking(lockstep("scenario=static"), 1.0)
    robot.network.damage[LOW_STATE_TOPIC] = damage
    robot.run(0.06)
    assert robot.machine.mode is Mode.DAMPING and reason in robot.machine.reason
    robot.run(1.5)
    assert is_lying(robot)


@pytest.mark.slow
def test_doubled_and_out_of_order_states_change_nothing(lockstep):
    held = []

    def mixed(data):
        held.append(data)
        return [data, held[-2] if len(held) > 1 else data, data]

    robot = lockstep("scenario=static")
    robot.network.damage[LOW_STATE_TOPIC] = mixed
    walking(robot)
    assert speed(robot) > 0.4 and not robot.robot.outcome.fell


@pytest.mark.slow
def test_an_e_stop_while_it_walks(lockstep):
    robot = walking(lockstep("scenario=static"), 1.0)
    robot.link.ask(Request.STOP)
    robot.run(1.5)
    assert robot.machine.mode is Mode.STOPPED and is_lying(robot)
    robot.run(1.5)  # the operator still asks for standing and walking
    assert robot.machine.mode is Mode.STOPPED and is_lying(robot)


@pytest.mark.parametrize(
    "fault", [pytest.param(name, marks=() if name in ("unplug", "silence") else pytest.mark.slow) for name in FAULTS]
)
def test_a_fault_while_it_walks(lockstep, fault):
    """Those of the LiDAR pass; those of the state end in damping; none ends in a fall."""
    robot = lockstep("scenario=static", fault=fault)
    robot.run(20.0, lambda: robot.robot.is_over)
    assert robot.robot.is_over and not robot.robot.outcome.fell, robot.machine.reason
    if fault in SENSORS:
        assert robot.machine.mode is Mode.POLICY and robot.robot.outcome.height > 0.2
    else:
        assert is_lying(robot) and robot.robot.outcome.speed < 0.05


@pytest.mark.slow
def test_commands_are_ignored_while_its_own_controller_runs(lockstep):
    robot = lockstep("scenario=static", sport_mode="normal").run(3.0)
    assert robot.robot.up_since is None and robot.robot.outcome.commands > 1000
    robot.robot._switcher.controller = ""
    robot.link.ask(Request.DAMP)
    assert robot.run(5.0).robot.up_since is not None


@pytest.mark.slow
def test_a_simulator_without_checksums(lockstep):
    robot = lockstep("scenario=static", crc=False)
    assert speed(walking(robot)) > 0.4


def test_another_robot_is_refused_before_a_motor_moves(exported):
    described = Description.read(exported)
    object.__setattr__(described.joints, "names", [f"leg_{k}" for k in range(12)])
    with pytest.raises(DeployError, match="the policy moves another robot than a Go2"):
        machine_config(described)


def test_a_robot_whose_joints_have_the_names_of_a_go2s_and_go_farther_is_refused(exported):
    """As a Go1's do: its thighs go from -0.686 to 4.501 rad."""
    described = Description.read(exported)
    ends = zip(described.joints.names, described.joints.upper, strict=True)
    upper = [4.501 if "thigh" in name else end for name, end in ends]
    object.__setattr__(described, "joints", replace(described.joints, upper=upper))
    with pytest.raises(DeployError, match="another robot than a Go2: its FL_thigh_joint goes from .* to 4.501 rad"):
        motor_order(described)


def reads_ticks(check_crc):
    """A reader of states, and what it says of states with these ticks: the newest one's, None without a newer one."""
    network = Memory()
    reader = guard.StateReader(network.reader(LOW_STATE_TOPIC, LOW_STATE, 4), check_crc)
    writer = network.writer(LOW_STATE_TOPIC, LOW_STATE)

    def newest(*ticks):
        for tick in ticks:
            state = LOW_STATE.zeros()
            state["tick"] = tick
            writer.write(LOW_STATE.to_cdr(sealed(state) if check_crc else state))
        found = reader.newest()
        return None if found is None else int(found["tick"])

    return reader, newest


@pytest.mark.parametrize("check_crc", [True, False])
def test_a_state_that_is_not_newer_is_none(check_crc):
    """By its own clock; one that is far behind has begun again, as after a restart."""
    reader, newest = reads_ticks(check_crc)
    assert newest(4000) == 4000 and newest(4000) is None and newest(4002, 4000) == 4002
    assert newest(3500) is None and newest(10) == 10  # half a second ago, and a restart
    assert newest(2**32 - 2) is None and reader.repeated == 4
    reader._tick = 2**32 - 2
    assert newest(4) == 4  # the clock's end


def test_states_of_a_simulator_without_a_clock_are_all_new():
    """Once one has a clock, it must go on."""
    reader, newest = reads_ticks(check_crc=False)
    assert [newest(0), newest(0, 0), newest(0)] == [0, 0, 0] and reader.repeated == 0
    assert [newest(2), newest(2), newest(0), newest(4)] == [2, None, None, 4]
    _, newest = reads_ticks(check_crc=True)
    assert [newest(0), newest(0)] == [0, None]


def test_requests_are_sent_again_where_the_guard_is_behind():
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    link = guard.Link(ours)
    for _ in range(5000):
        link.send_targets(np.zeros(12))
    link.ask(Request.STOP)
    theirs.setblocking(False)

    def read():
        with contextlib.suppress(BlockingIOError):
            while True:
                yield theirs.recv(256)

    stop = bytes([guard.REQUESTS.index(Request.STOP)])
    assert stop not in list(read())
    link.poll()
    assert list(read()) == [stop]


def test_from_a_state_that_has_stopped_coming_no_targets_follow(lockstep):
    """The policy's own reader is silent, the guard's is not."""
    robot = lockstep("scenario=static").run(0.2)
    sent = []
    robot.link.send_targets = sent.append
    robot.run(0.1)
    assert len(sent) == 5
    robot.control._states.newest = lambda: None
    robot.run(0.2)
    assert len(sent) in (6, 7)  # the last of them by rounding


def test_a_bag_of_ros_2_is_replayed_and_drawn(exported, tmp_path, capsys):
    """Its joints are where no Go2's can be, which is said."""
    for library in ("rosbags", "mcap_ros2", "matplotlib"):
        pytest.importorskip(library)
    from test_recording import a_ros_bag

    a_ros_bag(tmp_path / "bag")
    main(["replay-bag", str(tmp_path / "bag"), f"policy={exported}"])
    said = capsys.readouterr()
    assert "joints from /joint_states, orientation from /imu, points from /cloud, commands from /cmd_vel" in said.err
    assert "beyond its limit" in said.err + said.out
    assert (tmp_path / "bag.png").read_bytes()[:4] == b"\x89PNG"


@pytest.mark.parametrize(
    ("points", "unread"),
    [
        ("none", ["host=192.168.1.5", "point_port=56302", "topic=rt/cloud", "extrinsic=0,0,0,1,0,0,0"]),
        ("mid360", ["topic=rt/cloud", "extrinsic=0,0,0,1,0,0,0"]),
        ("packets", ["topic=rt/cloud", "extrinsic=0,0,0,1,0,0,0"]),
        ("PointCloud2", ["host=192.168.1.5", "point_port=56302"]),
        ("CustomMsg", ["host=192.168.1.5", "point_port=56302"]),
    ],
)
def test_arguments_that_say_nothing_of_these_points_are_refused(points, unread, monkeypatch, capsys):
    monkeypatch.setattr("omnirobot.commands.drive.run", lambda config: config)
    given = {"host=192.168.1.5", "point_port=56302", "topic=rt/cloud", "extrinsic=0,0,0,1,0,0,0"}
    for word in sorted(given):
        if word not in unread:
            main(["robot", f"points={points}", word])
            continue
        with pytest.raises(SystemExit, match="2"):
            main(["robot", f"points={points}", word])
        said = f"{word.partition('=')[0]}= would mean nothing: it is not read for points={points}; leave it out"
        assert said in capsys.readouterr().err


def test_a_policy_that_acts_too_seldom_for_the_guard_is_refused(exported):
    described = replace(Description.read(exported), control_period_s=0.025)
    with pytest.raises(DeployError, match="acts every 25 ms, at most every 20 was expected"):
        machine_config(described)


def test_what_no_message_of_the_robot_holds_is_named_before_it_moves(exported):
    described = Description.read(exported)
    first, *rest = described.observations
    own = replace(first.terms[0], quantity="foot_load")
    described = replace(described, observations=[replace(first, terms=[own, *first.terms[1:]]), *rest])
    with pytest.raises(DeployError, match="the policy observes foot_load, which this robot's messages do not hold"):
        machine_config(described)


def test_packets_of_a_mid360_are_not_for_another_lidar(exported):
    lidar = Description.read(exported).lidar
    other = replace(lidar, points_per_frame=30_000)
    with pytest.raises(DeployError, match="a Mid-360 measures 20000 points in 0.1 s, the policy was trained .* 30000"):
        Frames(LidarSource(), other, None)


@pytest.mark.parametrize("taken", [False, True])
def test_files_that_cannot_be_written_are_one_line(tmp_path, taken):
    (tmp_path / "file").write_text("")
    path, message = tmp_path / "file" / "x.json", "its folder cannot be made"
    if taken:
        path, message = tmp_path, "is a folder; give a file"
    with pytest.raises(DeployError, match=f"report=.*{message}"):
        make_folder(path, "report")


def test_joints_without_limits_are_named(exported):
    described = Description.read(exported)
    lower, upper = list(described.joints.lower), list(described.joints.upper)
    lower[3], upper[3], upper[7] = None, None, None
    object.__setattr__(described, "joints", replace(described.joints, lower=lower, upper=upper))
    names = f"{described.joints.names[3]}, {described.joints.names[7]}"
    with pytest.raises(DeployError, match=rf"without limits in .*policy\.json: {names}; .*robot\.file.*export again$"):
        machine_config(described)


@pytest.mark.parametrize("choice", ["check", "ignore", "release"])
def test_the_robots_own_controller_is_ended_after_all_that_may_fail(exported, monkeypatch, tmp_path, choice):
    """Whether it runs is asked first, so that a refusal leaves no empty recording."""
    did = []

    def failing(what):
        def fail(*_):
            did.append(what)
            raise DeployError(f"no {what}")

        return fail

    monkeypatch.setattr(control, "Network", lambda *_: Memory())
    monkeypatch.setattr(control, "ensure_released", lambda network, asked: did.append(asked))
    monkeypatch.setattr(control, "start", failing("guard"))
    config = control.RobotConfig(exported, lidar=LidarSource(), steer="0,0,0", sport_mode=choice)
    for name in ("Frames", "Recorder"):
        with monkeypatch.context() as one:
            one.setattr(control, "Frames", lambda *_: type("F", (), {"close": lambda self: None})())
            one.setattr(control, name, failing(name))
            with pytest.raises(DeployError, match=f"no {name}"):
                control.run(replace(config, record=tmp_path / "a.mcap"))
    before = [] if choice == "release" else [choice]
    assert did == [*before, "Frames", *before, "Recorder"]
    did.clear()
    monkeypatch.setattr(control, "Frames", lambda *_: type("F", (), {"close": lambda self: None})())
    with pytest.raises(DeployError, match="no guard"):
        control.run(config)
    assert did == [choice, "guard"]


def test_the_machine_has_the_motors_order(exported):
    described = Description.read(exported)
    assert motor_order(described).tolist() == [3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8]
    machine = machine_config(described)
    assert machine.stand_pose[:6] == [-0.1, 0.8, -1.5, 0.1, 0.8, -1.5]  # right hips are negative
    assert machine.upper[7] == pytest.approx(4.5379) and (machine.kp, machine.kd) == ([25.0] * 12, [0.6] * 12)
    again = guard.GuardConfig.from_json(guard.GuardConfig(machine).to_json())
    assert again.machine.stand_pose == machine.stand_pose and again == guard.GuardConfig(again.machine)


def test_the_robots_process_needs_neither_torch_nor_hydra():
    code = (
        "import sys; import omnirobot.commands.drive, omnirobot.drive.guard\n"
        "print(sorted({'torch', 'warp', 'hydra', 'mujoco', 'omegaconf', 'yaml', 'rsl_rl'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert done.stdout == "[]\n", done.stderr


def test_a_guard_that_fails_inside_stops_the_robot(exported):
    """And goes on damping until the policy's process has been gone for a while."""
    network, (ours, theirs) = Memory(), socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    settings = guard.GuardConfig(machine_config(Description.read(exported)), listen_s=1e-9, linger_s=0.1)
    failing, sent = guard.Guard(settings, theirs, network), network.reader(LOW_CMD_TOPIC, LOW_CMD, 100)
    failures, at_once = iter([RuntimeError("broken")]), []

    def fails_once():
        for failure in failures:
            raise failure
        at_once.append(sent.take())

    failing._states.newest = fails_once
    ours.close()
    failing.run()
    assert failing.machine.mode is Mode.STOPPED
    for data in (at_once[0][0], sent.take()[-1]):  # the period that failed has written, too
        command = LOW_CMD.from_cdr(data)
        assert not command["motor_cmd"]["kp"].any() and command["motor_cmd"]["kd"][0] == 3.0


def test_a_guard_whose_commands_are_not_sent_says_so_once(exported, capfd):
    network, (_, theirs) = Memory(), socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    settings = guard.GuardConfig(machine_config(Description.read(exported)), listen_s=1e-9)
    unheard, said = guard.Guard(settings, theirs, network), "guard: rt/lowcmd: the network has not taken a command"
    unheard.tick(0.0)
    assert said not in capfd.readouterr().err
    for unsent in (1, 2, 3):
        unheard._writer.unsent = unsent
        unheard.tick(0.002 * unsent)
    assert capfd.readouterr().err.count(said) == 1


class Silence:
    """Stands in for `dds.Network`: nobody is there."""

    def reader(self, *_):
        return self

    def take(self):
        return []

    def why_silent(self):
        return "nobody writes rt/lowstate at interface=lo domain=7"


class IdleLink:
    """Of a guard that does nothing."""

    mode, reason, is_closed = Mode.DAMPING, "start", False

    def __getattr__(self, name):
        return lambda *_: None


def test_a_robot_that_hears_nothing_says_so_and_how_many_of_each_came(exported, monkeypatch, capsys):
    """And a sensor that sends the packets of its IMU only: 60 bytes, of data type 0."""
    monkeypatch.setattr(control, "Network", lambda *_: Silence())
    monkeypatch.setattr(control, "start", lambda config: (IdleLink(), None))
    monkeypatch.setattr(control.Waiting, "SAY_EVERY_S", 0.2)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as found:
        found.bind(("127.0.0.1", 0))
        port = found.getsockname()[1]
    sender, numbers = socket.socket(socket.AF_INET, socket.SOCK_DGRAM), iter(range(20))

    def should_end():
        for number in itertools.islice(numbers, 1):
            head = struct.pack("<BHHHHBBB12xIQ", 0, 60, 0, 1, number, 0, 0, 0, 0, 10**9)
            sender.sendto(head + bytes(24), ("127.0.0.1", port))
        return False

    points = LidarSource(kind="packets", host="127.0.0.1", point_port=port)
    config = control.RobotConfig(exported, lidar=points, steer="0,0,0", sport_mode="ignore", seconds=1.0)
    with pytest.raises(DeployError) as error:
        control.run(config, should_end)
    said = capsys.readouterr().err
    assert "waiting for states of the robot: nobody writes rt/lowstate at interface=lo domain=7\n" in said
    assert "waiting for LiDAR frames: " in said and "packets of the IMU came; a Mid-360 that samples" in said
    counted = "0 frames of 0 points in 0 LiDAR messages; 20 packets of the IMU"
    assert str(error.value) == f"no state has come from the robot; {counted}"
    sender.close()


class TestDds:
    """Over CycloneDDS on the loopback."""

    pytestmark = pytest.mark.skipif(
        not __import__("importlib.util").util.find_spec("cyclonedds"), reason="cyclonedds, extra robot"
    )

    def test_states_and_commands_go_over_the_loopback(self):
        network = Network(domain=71)
        states, commands = network.reader(LOW_STATE_TOPIC, LOW_STATE), network.reader(LOW_CMD_TOPIC, LOW_CMD)
        to_states, to_commands = network.writer(LOW_STATE_TOPIC, LOW_STATE), network.writer(LOW_CMD_TOPIC, LOW_CMD)
        state, command = LOW_STATE.zeros(), low_cmd()
        state["tick"], command["motor_cmd"]["q"][3] = 123, 1.5
        came, asked = [], []
        end = time.monotonic() + 120.0
        while not (came and asked) and time.monotonic() < end:
            to_states.write(LOW_STATE.to_cdr(sealed(state)))
            to_commands.write(LOW_CMD.to_cdr(sealed(command)))
            time.sleep(0.02)
            came, asked = came + states.take(), asked + commands.take()
        assert LOW_STATE.from_cdr(came[-1])["tick"] == 123
        read = LOW_CMD.from_cdr(asked[-1])
        assert read["motor_cmd"]["q"][3] == 1.5 and crc(read) == read["crc"]

    def test_samples_that_dds_does_not_take_are_counted(self, monkeypatch):
        from cyclonedds.core import DDSException

        writer = Network(domain=80).writer(LOW_CMD_TOPIC, LOW_CMD)
        writer.write(LOW_CMD.to_cdr(low_cmd()))
        assert writer.unsent == 0

        def refuse(sample):
            raise DDSException(DDSException.DDS_RETCODE_TIMEOUT)

        monkeypatch.setattr(writer._writer, "write", refuse)
        writer.write(LOW_CMD.to_cdr(low_cmd()))
        assert writer.unsent == 1

    @pytest.mark.parametrize("kind", ["CustomMsg", "PointCloud2"])
    def test_a_drivers_cloud_goes_over_the_loopback(self, kind, capsys, monkeypatch):
        """One point of livox_ros_driver2's messages, whose layout is test_clouds'; then two that are cut off."""
        network = Network(domain={"CustomMsg": 74, "PointCloud2": 79}[kind])
        if kind == "CustomMsg":
            message = struct.pack("<iII", 12, 7, 4) + b"imu\0" + struct.pack("<QIB3xI", 5 * 10**9, 1, 0, 1)
            message = b"\0\1\0\0" + message + struct.pack("<IfffBBBx", 480, 1.0, 2.0, 3.0, 9, 0, 1)
        else:
            rows = struct.pack("<ffffBBd", 1.0, 2.0, 3.0, 9.0, 0, 1, 5e9 + 480)
            message = point_cloud2(LIVOX, rows, 1)
        source = lidar._Topic(LidarSource(kind=kind), network)
        writer = network.writer("rt/livox/lidar", {"CustomMsg": CUSTOM_MSG, "PointCloud2": POINT_CLOUD2}[kind])
        end, came = time.monotonic() + 120.0, []
        while not came and time.monotonic() < end:
            writer.write(message)
            time.sleep(0.02)
            came = source.read()
        assert came[-1].points.tolist() == [[1.0, 2.0, 3.0]] and came[-1].times_ns.tolist() == [5 * 10**9 + 480]
        monkeypatch.setattr(source._reader, "take", lambda: [message[:30], message[:30]])
        assert source.read() == [] and source.counts() == {"messages refused": 2}
        assert capsys.readouterr().err.count(f"refused: {kind}: ") == 1  # said once

    def test_a_terminated_guard_damps_and_then_ends(self, exported):
        machine = machine_config(Description.read(exported))
        link, process = guard.start(guard.GuardConfig(machine, domain=78, listen_s=0.1, linger_s=0.5))
        commands = Network(domain=78).reader(LOW_CMD_TOPIC, LOW_CMD)
        end = time.monotonic() + 120.0
        while not commands.take() and time.monotonic() < end:
            time.sleep(0.01)
        process.terminate()
        process.send_signal(signal.SIGHUP)  # as service managers do
        time.sleep(0.1)
        commands.take()
        time.sleep(0.2)
        assert commands.take() and process.wait(60.0) == 0
        link.close()

    def test_a_guard_outlives_its_policy_and_then_ends(self, exported):
        machine = machine_config(Description.read(exported))
        link, process = guard.start(guard.GuardConfig(machine, domain=72, listen_s=0.1, linger_s=0.5))
        commands = Network(domain=72).reader(LOW_CMD_TOPIC, LOW_CMD)
        end = time.monotonic() + 120.0
        while not (before := commands.take()) and time.monotonic() < end:
            time.sleep(0.01)
        command = LOW_CMD.from_cdr(before[-1])
        assert not command["motor_cmd"]["kp"].any() and command["motor_cmd"]["kd"][:12].tolist() == [3.0] * 12
        link.close()
        time.sleep(0.1)
        commands.take()
        time.sleep(0.2)
        assert commands.take()  # it damps on
        assert process.wait(60.0) == 0

    @pytest.mark.parametrize("terminal", ["closed", "stopped"])
    def test_a_guard_without_a_terminal_lays_the_robot_down(self, exported, terminal):
        """Its stderr is a pipe that nobody reads: its end is closed, or it is full."""
        machine = machine_config(Description.read(exported))
        domain = {"closed": 75, "stopped": 76}[terminal]
        network = Network(domain=domain)
        states, commands = network.writer(LOW_STATE_TOPIC, LOW_STATE), network.reader(LOW_CMD_TOPIC, LOW_CMD)
        state = LOW_STATE.zeros()
        state["imu_state"]["quaternion"] = (1, 0, 0, 0)
        state["motor_state"]["q"][:12], state["motor_state"]["temperature"] = machine.stand_pose, 30
        read, write = os.pipe()
        kept = os.dup(2)
        os.dup2(write, 2)
        try:
            link, process = guard.start(guard.GuardConfig(machine, domain=domain, listen_s=0.1, linger_s=0.3))
        finally:
            os.dup2(kept, 2)
            os.close(kept)

        def run_until(happened, seconds=120.0):
            """The newest motor commands by then; on a busy machine the first one may come later."""
            begin, newest = time.monotonic(), None
            while (not happened() and time.monotonic() < begin + seconds) or newest is None:
                assert time.monotonic() < begin + 120.0, "no command has come"
                state["tick"] += 4
                states.write(LOW_STATE.to_cdr(sealed(state)))
                time.sleep(0.004)
                link.poll()
                newest = (commands.take() or [newest])[-1]
            return LOW_CMD.from_cdr(newest)["motor_cmd"]

        def stands():
            """On a busy machine states may come so late that it is damped: it is asked again."""
            run_until(lambda: link.mode in (Mode.STANDING_UP, Mode.STANDING) or link.ask(Request.STAND))
            return run_until(lambda: False, 0.2)["kp"][0] == 60.0

        assert any(stands() for _ in range(50))
        if terminal == "closed":
            os.close(read)
        else:
            os.set_blocking(write, False)
            with contextlib.suppress(BlockingIOError):
                while True:
                    os.write(write, bytes(4096))
            os.set_blocking(write, True)
        os.close(write)
        link.poll = lambda: None
        link.close()
        assert not run_until(lambda: process.poll() is not None, 30.0)["kp"].any()
        assert process.wait(1.0) in (0, 120)  # 120: Python could not flush stderr at its end

    def test_a_start_that_is_refused_leaves_the_terminal_as_it_was(self, exported):
        terminal, stdin = pty.openpty()
        before = termios.tcgetattr(stdin)
        words = ["robot", f"policy={exported}", "points=none", "domain=77", "steer=keyboard"]
        command = [sys.executable, "-m", "omniperception", *words]
        done = subprocess.run(command, stdin=stdin, capture_output=True, text=True, timeout=120.0)
        assert done.returncode == 2 and done.stderr == "error: this policy sees: points=none is for a blind one\n"
        assert before[3] & termios.ECHO and termios.tcgetattr(stdin) == before
        os.close(terminal), os.close(stdin)

    @pytest.mark.slow
    def test_three_processes_whose_policy_is_killed(self, exported, tmp_path):
        """Whatever else the machine does, the robot stands up and lies at the end; how well it walks is for a quiet
        one."""
        words = [f"run={ROOT / 'pretrained' / 'avoider'}", f"policy={exported}", "scenario=static", "faults=kill"]
        command = [sys.executable, "-m", "omniperception", "robot-trials", *words, "trials=1", f"out={tmp_path}"]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300.0)
        assert done.returncode == 0, done.stderr
        (result,) = results(tmp_path)
        assert "guard: standing up: asked for" in result["robot_said"] and result["outcome"]["height"] < 0.2
        guards = [line for line in result["robot_said"].splitlines() if line.startswith("guard: ")]
        assert guards[-1].startswith("guard: damping")

    def test_somebody_else_who_writes_lowcmd_is_refused(self, exported):
        network = Network(domain=73)
        writer = network.writer(LOW_CMD_TOPIC, LOW_CMD)
        machine = machine_config(Description.read(exported))
        _, process = guard.start(guard.GuardConfig(machine, domain=73, listen_s=100.0))
        end = time.monotonic() + 120.0
        while process.poll() is None and time.monotonic() < end:
            writer.write(LOW_CMD.to_cdr(sealed(low_cmd())))
            time.sleep(0.01)
        assert process.wait(60.0) == 2
