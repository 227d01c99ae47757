"""Stepping on the spot: feet rise in turn, straight up, in the order and at the height of the robot's gait."""

import sys
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from omniperception import build
from omniperception.config import compose
from omniperception.robots.guess import guess
from omniperception.scene import RobotConfig
from omniperception.scene.stepping import ROWS, SteppingConfig, stepping_offsets
from omniperception.schema import make

sys.path.insert(0, str(Path(__file__).parents[1]))
from own_robots import HEXAPOD

DATA = Path(__file__).parents[1] / "data"
BLIND = ("lidar=none", "perception=none", "observations=walk", "rewards=walk", "obstacles=none")


def guessed(file):
    return make(RobotConfig, guess(file, str(file)).preset, "robot")


def robot_of(name):
    """A preset, or what is guessed for a robot of the tests."""
    if (DATA / f"{name}.urdf").is_file():
        return guessed(DATA / f"{name}.urdf")
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


@pytest.mark.parametrize("name", ["go2", "anymal", "strider", "spider"])
def test_feet_go_straight_up_one_after_the_other(name):
    robot, lift = robot_of(name), 1.3
    stand = np.array(robot.by_joint("default_joint_pos"))
    offsets, default = stepping_offsets(robot, lift), feet_of(robot, stand)
    highest = np.zeros(len(robot.feet))
    for row in range(ROWS):
        raised = feet_of(robot, stand + offsets[row]) - default
        swing = [(row / ROWS - offset) % 1.0 for offset in robot.gait.offsets]
        share = [np.sin(np.pi * (s - 0.5) / 0.5) ** 2 if s > 0.5 else 0.0 for s in swing]  # duty 0.5
        way = lift * robot.gait.foot_height - default[:, 2]
        np.testing.assert_allclose(raised[:, 2], np.array(share) * way, atol=1e-4)
        np.testing.assert_allclose(raised[:, :2], 0.0, atol=1e-4)
        highest = np.maximum(highest, raised[:, 2])
    np.testing.assert_allclose(highest, way, rtol=0.02)


def test_soles_stay_level():
    """Hip, knee and ankle turn about the same axis: the sole is level where their angles add up to 0."""
    robot = robot_of("strider")
    stand = np.array(robot.by_joint("default_joint_pos"))
    for row in stepping_offsets(robot, 1.6):
        angles = dict(zip(robot.joints, stand + row, strict=True))
        for side in ("left", "right"):
            assert sum(angles[f"{side}_{joint}"] for joint in ("hip_pitch", "knee", "ankle")) == pytest.approx(
                0, abs=0.01
            )


def test_joints_stay_within_their_ranges(tmp_path):
    """A foot whose ankle turns no further tilts; one whose knee does not bend enough is not lifted."""
    file, text = tmp_path / "strider.urdf", (DATA / "strider.urdf").read_text()
    file.write_text(text.replace('lower="-1.2" upper="1.2"', 'lower="-0.6" upper="0.6"'))
    robot = guessed(file)
    angles = np.array(robot.by_joint("default_joint_pos")) + stepping_offsets(robot, 1.6)
    assert angles[:, robot.joints.index("left_ankle")].min() == pytest.approx(-0.6)
    assert angles[:, robot.joints.index("left_knee")].max() > 1.5
    file.write_text(text.replace('upper="2.4"', 'upper="1.2"'))
    with pytest.raises(ValueError, match="the leg of right_foot_geom_0 does not lift it .* within the ranges"):
        stepping_offsets(guessed(file), 1.6)


def test_other_rhythms_and_orders_of_joints():
    robot = robot_of("go2")
    one = replace(robot, gait=replace(robot.gait, offsets=(0.25, 0.0, 0.5, 0.75), duty=0.75), joints=robot.joints[::-1])
    offsets = stepping_offsets(one, 1.3)
    legs = [[k for k, name in enumerate(one.joints) if name.startswith(foot)] for foot in ("FL", "FR", "RL", "RR")]
    moving = np.array([[np.abs(offsets[row][leg]).max() > 0.02 for leg in legs] for row in range(ROWS)])
    assert (moving.sum(1) <= 1).all()  # one foot at a time
    # each foot's swing is the last quarter of its period, which begins at its offset
    assert [int(moving[:, foot].nonzero()[0].mean()) for foot in range(4)] == [5, 35, 15, 25]


def test_offsets_do_not_hang_on_how_the_file_has_the_base(tmp_path):
    straight = robot_of("go2")
    text = straight.path().read_text()
    (tmp_path / "leaning.xml").write_text(text.replace('<body name="base"', '<body name="base" euler="0 0.06 0"', 1))
    assert 'euler="0 0.06 0"' in (tmp_path / "leaning.xml").read_text()
    leaning = replace(straight, file=str(tmp_path / "leaning.xml"))
    np.testing.assert_allclose(stepping_offsets(leaning, 2.0), stepping_offsets(straight, 2.0), atol=1e-9)


def test_what_no_leg_can_do_is_named(tmp_path):
    """Two joints on a leg take its foot up along an arc."""
    (tmp_path / "hexapod.urdf").write_text(HEXAPOD)
    arcs = guessed(tmp_path / "hexapod.urdf")
    for robot, lift, foot in ((robot_of("go2"), 9, "RL_foot"), (arcs, 1.6, "l1_foot_geom_0")):
        message = (
            rf"stepping.lift={lift}: the leg of {foot} does not lift it straight up to 0\..*, or use stepping=null$"
        )
        with pytest.raises(ValueError, match=message):
            stepping_offsets(robot, lift)
    with pytest.raises(ValueError, match=r"robot.gait, which is null"):
        stepping_offsets(replace(robot_of("go2"), gait=None), 1)
    with pytest.raises(ValueError, match="lift=0.0 must be positive"):
        SteppingConfig(0.0, 1.0)
