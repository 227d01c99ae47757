"""Every way between the modes, and every watchdog; time is a number."""

import math

import numpy as np
import pytest

from omnirobot.drive.machine import Machine, MachineConfig, Mode, Request, Sensed
from omnirobot.runtime import DeployError

STAND, CROUCH = np.array([0.0, 0.8, -1.5] * 4), np.array([0.0, 1.36, -2.65] * 4)
CONFIG = MachineConfig(STAND, [-1.0, -1.5, -2.72] * 4, [1.0, 3.4, -0.84] * 4, 25.0, 0.6)
COOL = np.full(12, 30.0)
TICK = 0.002


class Robot:
    """A robot whose joints are where they are led, with a policy that says `targets`; ticks of 2 ms."""

    def __init__(self, config=CONFIG):
        self.machine, self.now, self.joints = Machine(config), 100.0, CROUCH.copy()
        self.targets, self.senses, self.cos, self.temperature = STAND.copy(), True, 1.0, COOL
        self.follows = True

    def run(self, seconds):
        """The last command."""
        for _ in range(round(seconds / TICK)):
            self.now += TICK
            if self.senses:
                self.machine.sense(Sensed(self.now, self.joints.copy(), self.cos, self.temperature))
            if self.targets is not None:
                self.machine.follow(self.now, self.targets)
            command = self.machine.drive(self.now)
            if command.kp and self.follows:
                self.joints = command.joint_pos.copy()
        return command

    def ask(self, request):
        self.machine.ask(self.now, request)
        return self

    @property
    def mode(self):
        return self.machine.mode


def is_damped(command):
    return command.kp == 0.0 and command.kd == CONFIG.damping_kd


def test_it_begins_damped_and_stays_so():
    robot = Robot()
    assert is_damped(robot.run(1.0)) and robot.mode is Mode.DAMPING
    robot.ask(Request.WALK).run(0.1)
    assert robot.mode is Mode.DAMPING  # not without having stood up


def test_standing_up_folds_the_legs_and_rises():
    robot = Robot()
    robot.joints = np.array([0.3, 2.0, -2.0] * 4)
    robot.run(0.1)
    robot.ask(Request.STAND)
    first = robot.run(TICK)
    np.testing.assert_allclose(first.joint_pos, [0.3, 2.0, -2.0] * 4, atol=0.01)  # no jump
    np.testing.assert_allclose(robot.run(1.0 - TICK).joint_pos, CROUCH, atol=1e-6)
    half_way = robot.run(0.5)
    np.testing.assert_allclose(half_way.joint_pos, (STAND + CROUCH) / 2, atol=1e-6)
    assert (half_way.kp, half_way.kd) == (60.0, 5.0) and robot.mode is Mode.STANDING_UP
    robot.run(0.51)
    assert robot.mode is Mode.STANDING


def test_a_robot_that_does_not_come_up_is_damped():
    robot = Robot()
    robot.follows = False
    robot.run(0.1)
    robot.ask(Request.STAND).run(2.9)
    assert robot.mode is Mode.STANDING_UP
    assert is_damped(robot.run(0.2)) and "standing up failed: a joint is 1.1 rad away" in robot.machine.reason


def test_the_policy_drives_with_its_gains_within_the_limits():
    robot = in_mode(Mode.POLICY)
    robot.targets = STAND + 0.5
    command = robot.run(TICK)
    assert (command.kp, command.kd) == (25.0, 0.6)
    assert command.joint_pos[:3].tolist() == pytest.approx([0.5, 1.3, -1.0])
    robot.targets = STAND + 0.9
    assert robot.run(TICK).joint_pos[2] == -0.84


def test_walking_needs_a_policy_that_speaks():
    robot = Robot()
    robot.targets = None
    robot.run(0.1)
    robot.ask(Request.STAND).run(2.1)
    robot.ask(Request.WALK).run(0.1)
    assert robot.mode is Mode.STANDING and "the policy is silent" in robot.machine.reason


def test_the_first_target_may_not_be_far_from_where_the_robot_stands():
    """Thighs at 0.8 rad, asked for 2.0: it goes on standing, and walks once the policy is near."""
    robot = Robot()
    robot.run(0.1)
    robot.ask(Request.STAND).run(2.1)
    robot.targets = STAND + np.array([0.0, 1.2, 0.0] * 4)
    robot.run(0.1)
    robot.ask(Request.WALK)
    np.testing.assert_allclose(robot.run(0.1).joint_pos, STAND)
    assert robot.mode is Mode.STANDING
    assert robot.machine.reason == "not walking: a target is 1.2 rad from where the joints are held"
    robot.targets = STAND + np.array([0.0, 0.9, 0.0] * 4)
    robot.run(0.1)
    robot.ask(Request.WALK).run(0.1)
    assert robot.mode is Mode.POLICY


def test_lying_down_while_it_stands_up_folds_the_legs_from_where_they_are():
    """A fifth of the way into the crouch; 1.5 s later they are folded, by a straight way."""
    robot = Robot()
    robot.joints = np.array([0.0, 2.5, -1.0] * 4)
    begin = robot.joints + 0.2 * (CROUCH - robot.joints)
    robot.run(0.1)
    robot.ask(Request.STAND).run(0.2)
    robot.ask(Request.LIE)
    for part in (0.25, 0.5, 0.75):
        np.testing.assert_allclose(robot.run(0.375).joint_pos, begin + part * (CROUCH - begin), atol=0.01)
    assert robot.mode is Mode.LYING_DOWN
    assert is_damped(robot.run(0.38)) and "lay down" in robot.machine.reason
    robot.ask(Request.STAND).run(2.1)
    robot.ask(Request.LIE).run(2.0)
    assert robot.mode is Mode.LYING_DOWN  # from standing it settles first, as ever


def test_back_to_standing_and_down():
    robot = in_mode(Mode.POLICY)
    robot.targets = STAND + 0.2
    robot.run(0.1)
    robot.ask(Request.STAND)
    command = robot.run(0.99)
    assert robot.mode is Mode.SLOWING and (command.kp, command.kd) == (25.0, 0.6)  # the policy drives on
    np.testing.assert_allclose(robot.run(2 * TICK).joint_pos, STAND + 0.2, atol=0.01)
    np.testing.assert_allclose(robot.run(0.4).joint_pos, STAND, atol=1e-9)
    assert robot.mode is Mode.STANDING
    robot.ask(Request.LIE).run(2.0)
    assert robot.mode is Mode.LYING_DOWN
    assert is_damped(robot.run(0.2)) and robot.mode is Mode.DAMPING
    np.testing.assert_allclose(robot.joints, CROUCH, atol=0.01)


@pytest.mark.parametrize("mode", [Mode.POLICY, Mode.SLOWING])
def test_a_silent_policy_damps(mode):
    """38 ms of silence are none; then nothing that it says again moves the robot."""
    robot = in_mode(mode)
    robot.targets = None
    robot.run(0.038)
    assert robot.mode is mode
    assert is_damped(robot.run(0.006)) and "silent for 40 ms" in robot.machine.reason
    robot.targets = STAND + 0.5
    assert is_damped(robot.run(1.0)) and robot.mode is Mode.DAMPING


def hot():
    return np.array([*COOL[:11], 81.0])


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        ({"senses": False}, "no valid state for 40 ms"),
        ({"cos": math.cos(math.radians(51))}, "leans by more than 50 degrees"),
        ({"cos": float("nan")}, "not finite"),
        ({"joints": np.full(12, np.nan), "follows": False}, "not finite"),
        ({"temperature": hot()}, "motor 11 has 81 degrees"),
        ({"targets": STAND + 1.1}, "a target is 1.1 rad from the one before"),
        ({"targets": np.full(12, np.nan)}, "targets are not finite"),
    ],
)
def test_watchdogs_damp(fault, reason):
    robot = in_mode(Mode.POLICY)
    for name, value in fault.items():
        setattr(robot, name, value)
    command = robot.run(0.046)
    assert is_damped(command) and robot.mode is Mode.DAMPING and reason in robot.machine.reason
    assert np.isfinite(command.joint_pos).all()


def test_it_does_not_stand_up_into_a_fault():
    robot = Robot()
    robot.cos = -1.0
    robot.run(0.1)
    robot.ask(Request.STAND).run(0.1)
    assert robot.mode is Mode.DAMPING and "not standing up: the base leans" in robot.machine.reason


def test_a_damped_robot_may_stand_up_again():
    robot = in_mode(Mode.POLICY).ask(Request.DAMP)
    robot.run(TICK)
    robot.ask(Request.STAND).run(2.1)
    assert robot.mode is Mode.STANDING


def in_mode(mode):
    """A robot that is in the middle of it."""
    robot = Robot()
    robot.run(0.1)
    if mode is not Mode.DAMPING:
        robot.ask(Request.STAND).run(0.5 if mode is Mode.STANDING_UP else 2.1)
    if mode in (Mode.POLICY, Mode.SLOWING):
        robot.ask(Request.WALK).run(0.1)
    if mode in (Mode.SLOWING, Mode.LYING_DOWN):
        robot.ask(Request.LIE).run(0.5)
    assert robot.mode is mode
    return robot


MODES = (Mode.DAMPING, Mode.STANDING_UP, Mode.STANDING, Mode.POLICY, Mode.SLOWING, Mode.LYING_DOWN)


@pytest.mark.parametrize("mode", MODES)
def test_damping_and_every_watchdog_act_in_every_mode(mode):
    assert is_damped(in_mode(mode).ask(Request.DAMP).run(TICK))
    robot = in_mode(mode)
    robot.senses = False
    assert is_damped(robot.run(0.05)) and robot.mode is Mode.DAMPING
    robot = in_mode(mode)
    robot.cos = 0.0
    assert is_damped(robot.run(2 * TICK)) and robot.mode is Mode.DAMPING


def test_a_walking_robot_may_be_asked_to_lie_down():
    robot = in_mode(Mode.POLICY).ask(Request.LIE)
    robot.run(CONFIG.slow_s + CONFIG.settle_s / 2)
    assert robot.mode is Mode.LYING_DOWN and robot.joints == pytest.approx(STAND, abs=0.01)
    robot.run(2.0)
    assert robot.mode is Mode.DAMPING and robot.joints == pytest.approx(CROUCH, abs=0.01)


@pytest.mark.parametrize("mode", MODES)
def test_nothing_outvotes_an_e_stop(mode):
    robot = in_mode(mode)
    robot.ask(Request.STOP)
    for request in Request:
        assert is_damped(robot.ask(request).run(0.1)) and robot.mode is Mode.STOPPED
    robot.senses = False
    assert is_damped(robot.run(0.1)) and robot.mode is Mode.STOPPED and robot.machine.reason == "e-stop"


def test_wrong_settings_are_named():
    with pytest.raises(DeployError, match=r"machine.stand_pose=\[0.0, 0.0, 0.0\]: 12 finite numbers were"):
        MachineConfig([0.0] * 3, STAND, STAND, 25.0, 0.6)
    for nothing in (None, float("nan")):
        with pytest.raises(DeployError, match=r"machine.upper=\[1.0, .*(None|nan)\]: 12 finite numbers were expected"):
            MachineConfig(STAND, [-1.0] * 12, [1.0] * 11 + [nothing], 25.0, 0.6)
