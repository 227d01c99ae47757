"""Stepping on the spot: feet rise in turn, straight up, in the order and at the height of the robot's gait."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from omniperception import build
from omniperception.config import compose
from omniperception.scene.stepping import ROWS, SteppingConfig, stepping_offsets

BLIND = ("lidar=none", "perception=none", "observations=walk", "rewards=walk", "obstacles=none")


def robot_of(name):
    return build.assemble(compose([f"robot={name}", *BLIND])).env.robot


def feet_of(robot, angles):
    """(F, 3) m: where MuJoCo puts the feet of a robot whose base is held in its default pose."""
    model = robot.compiled()
    data = mujoco.MjData(model)
    data.qpos[:7] = (0.0, 0.0, robot.base_height, 1.0, 0.0, 0.0, 0.0)
    for name, angle in zip(robot.joints, angles, strict=True):
        data.joint(name).qpos = angle
    mujoco.mj_forward(model, data)
    return np.array([np.mean([data.geom(geom).xpos for geom in foot], axis=0) for foot in robot.feet])


@pytest.mark.parametrize("name", ["go2", "anymal"])
def test_feet_go_straight_up_one_after_the_other(name):
    robot, lift = robot_of(name), 1.3
    stand = np.array(robot.by_joint("default_joint_pos"))
    offsets, default = stepping_offsets(robot, lift), feet_of(robot, stand)
    highest = np.zeros(4)
    for row in range(ROWS):
        raised = feet_of(robot, stand + offsets[row]) - default
        swing = [(row / ROWS - offset) % 1.0 for offset in robot.gait.offsets]
        share = [np.sin(np.pi * (s - 0.5) / 0.5) ** 2 if s > 0.5 else 0.0 for s in swing]  # duty 0.5
        way = lift * robot.gait.foot_height - default[:, 2]
        np.testing.assert_allclose(raised[:, 2], np.array(share) * way, atol=1e-4)
        np.testing.assert_allclose(raised[:, :2], 0.0, atol=1e-4)
        highest = np.maximum(highest, raised[:, 2])
    np.testing.assert_allclose(highest, way, rtol=0.02)


def test_other_rhythms_and_orders_of_joints():
    robot = robot_of("go2")
    one = replace(robot, gait=replace(robot.gait, offsets=(0.25, 0.0, 0.5, 0.75), duty=0.75), joints=robot.joints[::-1])
    offsets = stepping_offsets(one, 1.3)
    legs = [[k for k, name in enumerate(one.joints) if name.startswith(foot)] for foot in ("FL", "FR", "RL", "RR")]
    moving = np.array([[np.abs(offsets[row][leg]).max() > 0.02 for leg in legs] for row in range(ROWS)])
    assert (moving.sum(1) <= 1).all()  # one foot at a time
    # each foot's swing is the last quarter of its period, which begins at its offset
    assert [int(moving[:, foot].nonzero()[0].mean()) for foot in range(4)] == [5, 35, 15, 25]


def test_what_no_leg_can_do_is_named():
    with pytest.raises(ValueError, match=r"stepping.lift=9: the leg of FR_foot does not lift it to 0"):
        stepping_offsets(robot_of("go2"), 9)
    with pytest.raises(ValueError, match=r"robot.gait, which is null"):
        stepping_offsets(replace(robot_of("go2"), gait=None), 1)
    with pytest.raises(ValueError, match="lift=0.0 must be positive"):
        SteppingConfig(0.0, 1.0)
