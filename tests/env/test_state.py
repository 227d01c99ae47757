"""Robot state in its frames, against MuJoCo's own quaternion functions; the height grid."""

import math

import mujoco
import numpy as np
import pytest
import torch

from omniperception.common.rotations import rotate_inverse, rotate_yaw, yaw_of, yaw_quat
from omniperception.env.heights import flat_heights, height_grid
from omniperception.env.kinematics import Kinematics


def random_states(n=50, seed=0):
    rng = np.random.default_rng(seed)
    qpos, qvel = rng.normal(size=(n, 19)), rng.normal(size=(n, 18))
    qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
    return qpos, qvel


def rotated(vector, quat):
    result = np.zeros(3)
    mujoco.mju_rotVecQuat(result, np.array(vector, dtype=float), quat)
    return result


def test_base_frame_quantities_are_those_of_mujoco(make_config):
    """Which velocity is given in which frame is the engine's convention, so the engine decides."""
    spec = make_config().env.robot.spec()
    spec.body("base").add_site(name="origin")
    for kind, name in (
        (mujoco.mjtSensor.mjSENS_VELOCIMETER, "velocimeter"),
        (mujoco.mjtSensor.mjSENS_GYRO, "gyro"),
    ):
        spec.add_sensor(name=name, type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname="origin")
    model = spec.compile()
    data = mujoco.MjData(model)
    qpos, qvel = random_states(10, seed=1)
    k = Kinematics(torch.tensor(qpos), torch.tensor(qvel))
    for i in range(len(qpos)):
        data.qpos[:], data.qvel[:] = qpos[i], qvel[i]
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(k.base_lin_vel_b[i], data.sensor("velocimeter").data, atol=1e-5)
        np.testing.assert_allclose(k.base_ang_vel_b[i], data.sensor("gyro").data, atol=1e-5)
        gravity = -data.body("base").xmat.reshape(3, 3)[2]
        np.testing.assert_allclose(k.projected_gravity_b[i], gravity, atol=1e-5)
    np.testing.assert_allclose(k.joint_pos, qpos[:, 7:], rtol=1e-6)
    np.testing.assert_allclose(k.joint_vel, qvel[:, 6:], rtol=1e-6)


def test_yaw_is_the_heading_of_the_x_axis():
    qpos, qvel = random_states()
    k = Kinematics(torch.tensor(qpos), torch.tensor(qvel))
    for i in range(len(qpos)):
        ahead = rotated([1, 0, 0], qpos[i, 3:7])
        assert k.yaw[i].item() == pytest.approx(math.atan2(ahead[1], ahead[0]), abs=1e-5)
        cos, sin = math.cos(k.yaw[i]), math.sin(k.yaw[i])
        x, y = qvel[i, :2]
        expected = [cos * x + sin * y, cos * y - sin * x]
        assert k.base_lin_vel_yaw[i].tolist() == pytest.approx(expected, abs=1e-5)


def test_rotations_by_hand():
    quarter = torch.tensor([[math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)]])  # 90 degrees to the left
    in_body = rotate_inverse(quarter, torch.tensor([[0.0, 1.0, 2.0]]))
    assert in_body[0].tolist() == pytest.approx([1, 0, 2], abs=1e-6)
    assert yaw_of(quarter).item() == pytest.approx(math.pi / 2)
    torch.testing.assert_close(yaw_quat(torch.tensor([math.pi / 2])), quarter)
    turned = rotate_yaw(torch.tensor([math.pi / 2]), torch.tensor([[[1.0, 0.0], [0.0, 2.0]]]))
    torch.testing.assert_close(turned, torch.tensor([[[0.0, 1.0], [-2.0, 0.0]]]), atol=1e-6, rtol=0)


class TestHeights:
    def test_grid(self):
        grid = height_grid()
        assert grid.shape == (187, 2)
        torch.testing.assert_close(grid[0], torch.tensor([-0.8, -0.5]))
        torch.testing.assert_close(grid[1], torch.tensor([-0.8, -0.4]))  # y is fast
        torch.testing.assert_close(grid[11], torch.tensor([-0.7, -0.5]))  # x is slow
        torch.testing.assert_close(grid[-1], torch.tensor([0.8, 0.5]))
        torch.testing.assert_close(grid[93], torch.zeros(2))  # the middle lies under the base

    def test_heights_over_flat_ground_are_clipped(self):
        heights = flat_heights(torch.tensor([0.3, -0.2, 5.0, -5.0]))
        assert heights.shape == (4, 187)
        torch.testing.assert_close(heights, torch.tensor([[0.3], [-0.2], [1.0], [-1.0]]).expand(4, 187))
