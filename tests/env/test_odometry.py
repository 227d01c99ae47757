"""Odometry of the task and of the runtime against a path by hand, and against each other."""

import math
from types import SimpleNamespace

import mujoco
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


def test_a_reset_touches_one_robot_alone_and_a_saved_state_goes_on():
    odometry, other = Odometry(2, DT, CPU), Odometry(2, DT, CPU)
    odometry.start(torch.arange(2), measured(0.0, 0.0, 0.0))
    odometry.advance(measured(0.2, 1.0, 0.0))
    odometry.start(torch.tensor([1]), measured(2.0, 0.0, 0.0))
    other.load_state_dict(odometry.state_dict())
    moved = odometry.since_last_frame()
    assert moved[1].tolist() == [0.0, 0.0, 0.0] and moved[0, 2].item() == pytest.approx(0.2)
    assert torch.equal(moved, other.since_last_frame())


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
            assert deployed.since_last_frame() == pytest.approx(task.since_last_frame()[0].numpy(), abs=1e-5)
