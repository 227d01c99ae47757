"""Leg kinematics against MuJoCo's."""

import mujoco
import numpy as np

from omniperception import build, config
from omniperception.scene import build_world
from omnirobot.drive.legs import base_velocity, feet
from omnirobot.runtime.go2 import MOTORS


def go2():
    env = build.assemble(config.compose(["experiment=walk", "num_envs=1"])).env
    model = build_world(env.robot, env.terrain, env.obstacles, set()).model
    return model, mujoco.MjData(model)


def test_feet_are_where_mujoco_has_them_and_move_so():
    model, data = go2()
    rng = np.random.default_rng(0)
    at = [model.joint(name).qposadr[0] for name in MOTORS]
    dof = [model.joint(name).dofadr[0] for name in MOTORS]
    for _ in range(5):
        data.qpos[:7] = [0, 0, 0, 1, 0, 0, 0]
        data.qvel[:] = 0.0
        data.qpos[at] = joints = np.array([0.0, 0.8, -1.5] * 4) + rng.uniform(-0.5, 0.5, 12)
        data.qvel[dof] = rates = rng.uniform(-5, 5, 12)
        mujoco.mj_forward(model, data)
        pos, jacobian = feet(joints, np.zeros(3))
        vel = np.einsum("fij,fj->fi", jacobian, rates.reshape(4, 3))
        for k, leg in enumerate(("FR", "FL", "RR", "RL")):
            geom, six = model.geom(f"{leg}_foot").id, np.zeros(6)
            np.testing.assert_allclose(pos[k], data.geom_xpos[geom], atol=1e-6)
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_GEOM, geom, six, 0)
            np.testing.assert_allclose(vel[k], six[3:], atol=1e-6)


STAND, DOWN = np.array([0.0, 0.8, -1.5] * 4), np.array([0.0, 0.0, -1.0])
TOUCH = 0.022 * DOWN


def torques(joints, pushes):
    """(12,) N m of massless legs whose feet push down with these forces (4,), N: virtual work, tau = J^T f."""
    return np.einsum("fij,fi->fj", feet(joints, TOUCH)[1], np.outer(pushes, DOWN)).ravel()


def test_a_base_that_turns_and_moves_over_standing_feet():
    """Joint rates that keep the points where the feet touch while the base moves: found by the feet's Jacobian."""
    velocity, turning = np.array([0.5, -0.2, 0.1]), np.array([0.1, -0.2, 0.3])
    at, jacobian = feet(STAND, TOUCH)
    wanted = -(velocity + np.cross(turning, at))
    rates = np.concatenate([np.linalg.solve(j, w) for j, w in zip(jacobian, wanted, strict=True)])
    given = base_velocity(STAND, rates, torques(STAND, [40.0] * 4), turning, DOWN)
    np.testing.assert_allclose(given, velocity, atol=1e-9)


def test_feet_that_do_not_push_do_not_count():
    """FL swings; and while no foot pushes, nothing is known."""
    rates = np.zeros(12)
    rates[3:6] = 5.0
    assert not base_velocity(STAND, rates, torques(STAND, [40.0, 20.0, 40.0, 40.0]), np.zeros(3), DOWN).any()
    assert base_velocity(STAND, rates, torques(STAND, [40.0] * 4), np.zeros(3), DOWN).any()
    assert base_velocity(STAND, rates, np.zeros(12), np.zeros(3), DOWN) is None
