"""Odometry of the task and of the runtime against a path by hand, and against each other."""

import math
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch

from omniperception.env.odometry import Odometry, TimedOdometry
from omnirobot.runtime.odometry import Odometry as DeployedOdometry
from omnirobot.runtime.odometry import TimedOdometry as DeployedTimes
from omnirobot.wire.sensor_clock import FrameAges

DT = 0.02
CPU = torch.device("cpu")
BOTH = torch.ones(2, dtype=torch.bool)


def measured(yaw, vx, vy):
    """Two robots that do the same; velocity in the yaw-aligned frame."""
    return SimpleNamespace(yaw=torch.full((2,), yaw), base_lin_vel_yaw=torch.tensor([[vx, vy]]).expand(2, 2))


def test_a_straight_walk_and_a_turn_by_hand():
    odometry = Odometry(2, DT, CPU)
    odometry.start(torch.arange(2), measured(1.0, 0.0, 0.0))
    for _ in range(5):
        odometry.advance(measured(1.0, 0.5, 0.1))
    assert odometry.take(BOTH)[0, 0].tolist() == pytest.approx([0.05, 0.01, 0.0], abs=1e-6)
    odometry.advance(
        measured(1.0 + math.pi / 2, 0.5, 0.0)
    )  # has turned left and walks, as seen from before, to the left
    assert odometry.take(BOTH)[0, 0].tolist() == pytest.approx([0.0, 0.01, math.pi / 2], abs=1e-6)
    assert odometry.take(BOTH)[0, 0].tolist() == pytest.approx([0.0, 0.0, 0.0], abs=1e-6)


def test_the_heading_may_wrap():
    odometry = Odometry(2, DT, CPU)
    odometry.start(torch.arange(2), measured(3.1, 0.0, 0.0))
    odometry.advance(measured(-3.1, 0.0, 0.0))
    assert odometry.take(BOTH)[0, 0, 2].item() == pytest.approx(2 * math.pi - 6.2, abs=1e-5)


def test_the_runtime_measures_the_same():
    """A tilted, turning walk; velocities in the base frame there, in the yaw-aligned frame here."""
    generator = np.random.default_rng(0)
    task, deployed = Odometry(2, DT, CPU), DeployedOdometry(DT)
    for step in range(40):
        quat = generator.normal(size=4) * 0.1 + [1.0, 0.0, 0.0, 0.03 * step]
        quat /= np.linalg.norm(quat)
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, quat)
        rotation = rotation.reshape(3, 3)
        velocity = generator.normal(size=3)
        yaw = math.atan2(rotation[1, 0], rotation[0, 0])
        world = rotation @ velocity
        cos, sin = math.cos(yaw), math.sin(yaw)
        state = measured(yaw, cos * world[0] + sin * world[1], cos * world[1] - sin * world[0])
        task.start(torch.arange(2), state) if step == 0 else task.advance(state)
        deployed.advance(quat, velocity)
        if step % 7 == 3:
            assert deployed.since_last_frame() == pytest.approx(task.take(BOTH)[0, 0].numpy(), abs=1e-5)


def circle(step: int) -> tuple[float, float, float]:
    """Place (m) and heading (rad) after as many control steps of a walk at (0.9, -0.2) m/s that turns."""
    x = y = 0.0
    for k in range(1, step + 1):
        yaw = 0.3 + 0.016 * k
        x += (0.9 * math.cos(yaw) + 0.2 * math.sin(yaw)) * DT
        y += (0.9 * math.sin(yaw) - 0.2 * math.cos(yaw)) * DT
    return x, y, 0.3 + 0.016 * step


def between(start: int, end: int) -> list[float]:
    """Motion from one control step of the circle to another, from where it began."""
    (x, y, yaw), (to_x, to_y, to_yaw) = circle(start), circle(end)
    dx, dy = to_x - x, to_y - y
    return [math.cos(yaw) * dx + math.sin(yaw) * dy, -math.sin(yaw) * dx + math.cos(yaw) * dy, to_yaw - yaw]


TAKEN = ((5, 2), (10, None), (15, 0), (20, 4), (25, 1))
"""Steps at which frames come, and how many steps they are old; None: one that is lost."""


def rows_by_hand() -> list[list[list[float]]]:
    """Of all frames: motion between them, motion since, ages."""
    rows, last = [], 0
    for step, late in TAKEN:
        taken = last if late is None else step - late
        rows.append([between(last, taken), between(taken, step), [DT * (step - taken), DT * (taken - last), 0.0]])
        last = taken
    rows[0][0], rows[0][2][1] = [0.0, 0.0, 0.0], 0.0  # the first frame follows none
    return rows


def turned(step: int) -> list[float]:
    yaw = circle(step)[2]
    return [math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)]


def test_frames_that_bear_their_times():
    """Two robots, of which one loses a frame that the other gets."""
    odometry = TimedOdometry(2, DT, 4, CPU)

    def state(step):
        given = measured(circle(step)[2], 0.9, -0.2)
        return SimpleNamespace(**vars(given), base_quat_w=torch.tensor([turned(step)] * 2))

    odometry.start(torch.arange(2), state(0))
    rows, attitudes, frames = [], [], dict(TAKEN)
    for step in range(1, 26):
        odometry.advance(state(step))
        if step in frames:
            late = torch.tensor([frames[step] or 0, 0])
            attitudes.append(odometry.attitude(late)[0])
            rows.append(odometry.take(torch.tensor([frames[step] is not None, True]), late))
    assert torch.stack(rows)[:, 0].numpy() == pytest.approx(np.array(rows_by_hand()), abs=1e-5)
    assert attitudes[3].tolist() == pytest.approx(turned(16))
    assert rows[1][1, 0].tolist() == pytest.approx(between(5, 10), abs=1e-5)
    again = TimedOdometry(2, DT, 4, CPU)
    again.load_state_dict(odometry.state_dict())
    for each in (odometry, again):
        each.advance(state(26))
        each.start(torch.tensor([1]), state(26))
    late = torch.zeros(2, dtype=torch.int64)
    assert torch.equal(*(each.take(BOTH, late) for each in (odometry, again)))


def test_the_runtime_says_the_same_of_their_times():
    deployed, rows, frames = DeployedTimes(DT), [], dict(TAKEN)
    for step in range(26):
        deployed.advance(np.array(turned(step)), np.array([0.9, -0.2, 0.0]))
        if step in frames:
            rows.append(deployed.take(None if frames[step] is None else DT * frames[step]))
    assert np.array(rows) == pytest.approx(np.array(rows_by_hand()), abs=1e-5)
    assert deployed.attitude(0.1) == pytest.approx(turned(20))
    assert deployed.attitude(9.0) == pytest.approx(turned(10))  # no older than what is kept


def test_ages_are_counted_from_the_quickest_frame():
    ages, found = FrameAges(), []
    for number, late in enumerate((0.03, 0.01, 0.09, 0.05)):
        ages.add(10**12 + 10**8 * number, 5.0 + 0.1 * number + late)  # clocks that do not agree
        found.append(ages.newest_s)
    assert found == pytest.approx([0.0, 0.0, 0.08, 0.04])
    ages.add(3 * 10**9, 5.6)  # the sensor begins anew
    assert ages.newest_s == 0.0


def test_ages_are_the_same_bits_whenever_the_clock_begins():
    """As in a recording, whose clock begins with it, of a sensor that counts from 1970."""
    live, replayed = FrameAges(), FrameAges()
    for number, late in enumerate((0.0412, 0.0131, 0.0873, 0.0514)):
        end_ns, since_ns = 1_764_500_000_123_456_789 + 10**8 * number, 10**8 * number + round(1e9 * late)
        live.add(end_ns, 1e-9 * (98_765_432_101_234 + since_ns))
        replayed.add(end_ns, 1e-9 * since_ns)
        assert live.newest_s == replayed.newest_s
    assert live.newest_s == pytest.approx(0.0514 - 0.0131, abs=1e-6)
