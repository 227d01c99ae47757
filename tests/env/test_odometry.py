"""Odometry of the task and of the runtime against a path by hand, and against each other."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from omniperception.deploy.odometry import Odometry as DeployedOdometry
from omniperception.env.odometry import Odometry

DT = 0.02
CPU = torch.device("cpu")


def measured(yaw, vx, vy):
    """Two robots that do the same; velocity in the yaw-aligned frame."""
    return SimpleNamespace(yaw=torch.full((2,), yaw), base_lin_vel_yaw=torch.tensor([[vx, vy]]).expand(2, 2))


def test_a_straight_walk_and_a_turn_by_hand():
    odometry = Odometry(2, DT, CPU)
    odometry.start(torch.arange(2), measured(1.0, 0.0, 0.0))
    for _ in range(5):
        odometry.advance(measured(1.0, 0.5, 0.1))
    assert odometry.since_last_frame()[0].tolist() == pytest.approx([0.05, 0.01, 0.0], abs=1e-6)
    odometry.advance(
        measured(1.0 + math.pi / 2, 0.5, 0.0)
    )  # has turned left and walks, as seen from before, to the left
    assert odometry.since_last_frame()[0].tolist() == pytest.approx([0.0, 0.01, math.pi / 2], abs=1e-6)
    assert odometry.since_last_frame()[0].tolist() == pytest.approx([0.0, 0.0, 0.0], abs=1e-6)


def test_the_heading_may_wrap():
    odometry = Odometry(2, DT, CPU)
    odometry.start(torch.arange(2), measured(3.1, 0.0, 0.0))
    odometry.advance(measured(-3.1, 0.0, 0.0))
    assert odometry.since_last_frame()[0, 2].item() == pytest.approx(2 * math.pi - 6.2, abs=1e-5)


def test_a_reset_touches_one_robot_alone():
    odometry = Odometry(2, DT, CPU)
    odometry.start(torch.arange(2), measured(0.0, 0.0, 0.0))
    odometry.advance(measured(0.2, 1.0, 0.0))
    odometry.start(torch.tensor([1]), measured(2.0, 0.0, 0.0))
    moved = odometry.since_last_frame()
    assert moved[1].tolist() == [0.0, 0.0, 0.0] and moved[0, 2].item() == pytest.approx(0.2)


def test_it_goes_on_from_its_state():
    one, other = Odometry(2, DT, CPU), Odometry(2, DT, CPU)
    one.start(torch.arange(2), measured(0.3, 0.0, 0.0))
    one.advance(measured(0.4, 1.0, 0.2))
    other.load_state_dict(one.state_dict())
    for odometry in (one, other):
        odometry.advance(measured(0.5, 1.0, 0.2))
    assert torch.equal(one.since_last_frame(), other.since_last_frame())


def test_the_runtime_measures_the_same():
    """A tilted, turning walk; velocities in the base frame there, in the yaw-aligned frame here."""
    generator = np.random.default_rng(0)
    task, deployed = Odometry(1, DT, CPU), DeployedOdometry(DT)
    for step in range(40):
        quat = generator.normal(size=4) * 0.1 + [1.0, 0.0, 0.0, 0.03 * step]
        quat /= np.linalg.norm(quat)
        w, x, y, z = quat
        rotation = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        velocity = generator.normal(size=3)
        yaw = math.atan2(rotation[1, 0], rotation[0, 0])
        world = rotation @ velocity
        turned = [
            math.cos(yaw) * world[0] + math.sin(yaw) * world[1],
            -math.sin(yaw) * world[0] + math.cos(yaw) * world[1],
        ]
        state = SimpleNamespace(
            yaw=torch.tensor([yaw], dtype=torch.float32), base_lin_vel_yaw=torch.tensor([turned], dtype=torch.float32)
        )
        task.start(torch.arange(1), state) if step == 0 else task.advance(state)
        deployed.advance(quat, velocity)
        if step % 7 == 3:
            assert deployed.since_last_frame() == pytest.approx(task.since_last_frame()[0].numpy(), abs=1e-5)
