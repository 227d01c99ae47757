"""Errors of what the robot measures of itself: their sizes and courses, and that the truth stays as it is."""

import math

import mujoco
import numpy as np
import pytest
import torch
from stepping import assert_equal, random_actions

from omniperception.common.random import EnvRandom
from omniperception.env.mdp.randomization import Drift, RandomizationConfig
from omniperception.env.measurement import MeasurementErrors

ALL = (
    "randomization.velocity_scale=[0.9,1.1]",
    "randomization.velocity_drift={sd: 0.1, time_s: 1.0}",
    "randomization.gyro_bias=[-0.1,0.1]",
    "randomization.gyro_noise=[-0.2,0.2]",
    "randomization.attitude_bias_deg=[-2,2]",
    "randomization.attitude_noise_deg=[-1,1]",
    "randomization.joint_pos_noise=[-0.01,0.01]",
    "randomization.joint_vel_noise=[-1.5,1.5]",
)


@pytest.fixture(scope="module")
def blind(make_env):
    return lambda *rows, num_envs=4: make_env(*rows, "obstacles=none", blind=True, num_envs=num_envs)


def rotated(quat, vec, inverse=False):
    """MuJoCo's rotation, in float64."""
    out, quat = np.zeros(3), np.asarray(quat, np.float64).copy()
    if inverse:
        quat[1:] *= -1
    mujoco.mju_rotVecQuat(out, np.asarray(vec, np.float64), quat)
    return out


def test_a_bias_by_hand(blind):
    """Velocity times 1.1; gyro plus 0.1 rad/s; a base that is thought 2 deg further over in roll and in pitch."""
    env = blind(
        "randomization.velocity_scale=[1.1,1.1]",
        "randomization.gyro_bias=[0.1,0.1]",
        "randomization.attitude_bias_deg=[2,2]",
    )
    for action in random_actions(env, 12, scale=0.5):
        env.step(action)
    true, measured = env.state.kinematics, env.state.measured
    qvel = env.sim.qvel.double().numpy()
    turn = np.zeros(4)
    angle = math.radians(2.0) * math.sqrt(2.0)
    mujoco.mju_axisAngle2Quat(turn, np.array([1.0, 1.0, 0.0]) / math.sqrt(2.0), angle)
    for i in range(4):
        tilted = np.zeros(4)
        mujoco.mju_mulQuat(tilted, env.sim.qpos[i, 3:7].double().numpy(), turn)
        velocity_b = 1.1 * rotated(env.sim.qpos[i, 3:7], qvel[i, :3], inverse=True)
        expected = {
            "base_quat_w": tilted,
            "base_lin_vel_b": velocity_b,
            "base_ang_vel_b": qvel[i, 3:6] + 0.1,
            "projected_gravity_b": rotated(tilted, [0, 0, -1], inverse=True),
            "base_lin_vel_w": rotated(tilted, velocity_b),
        }
        for name, value in expected.items():
            np.testing.assert_allclose(getattr(measured, name)[i], value, atol=2e-6, err_msg=name)
    for name in ("base_pos_w", "joint_pos", "joint_vel"):
        assert torch.equal(getattr(measured, name), getattr(true, name))
    assert (true.base_lin_vel_b.abs().amax(0) > 0.01).all()


def test_only_what_is_measured_has_errors(blind):
    exact, noisy = blind(), blind(*ALL)
    for action in random_actions(exact, 20, scale=0.3):
        (seen, reward, done, _), (disturbed, same, ended, _) = exact.step(action), noisy.step(action)
        assert torch.equal(reward, same) and torch.equal(done, ended)
        assert torch.equal(exact.sim.qpos, noisy.sim.qpos) and torch.equal(exact.sim.qvel, noisy.sim.qvel)
        assert torch.equal(seen["privileged"], disturbed["privileged"])
        newest = [each["proprioception"].unflatten(1, (10, -1))[:, -1] for each in (seen, disturbed)]
        assert ((newest[0] - newest[1])[:, :33].abs() > 0).float().mean() > 0.95


def test_errors_are_added_to_what_is_late(blind):
    late = ("randomization.latency_s=[0.02,0.04]",)
    exact, noisy = blind(*late), blind(*late, "randomization.gyro_bias=[0.1,0.1]")
    for action in random_actions(exact, 6):
        exact.step(action)
        noisy.step(action)
    assert not torch.equal(exact.state.measured.base_ang_vel_b, exact.state.kinematics.base_ang_vel_b)
    torch.testing.assert_close(noisy.state.measured.base_ang_vel_b, exact.state.measured.base_ang_vel_b + 0.1)


@pytest.mark.parametrize(
    ("row", "name", "width", "lasts"),
    [
        ("gyro_bias", "base_ang_vel_b", 3, True),
        ("gyro_noise", "base_ang_vel_b", 3, False),
        ("joint_pos_noise", "joint_pos", 12, False),
        ("joint_vel_noise", "joint_vel", 12, False),
    ],
)
def test_ranges_are_filled_and_noise_is_white(blind, row, name, width, lasts):
    env = blind(f"randomization.{row}=[-0.3,0.1]", num_envs=200)
    errors = []
    for _ in range(12):
        env.step(torch.zeros(200, 12))
        errors.append(getattr(env.state.measured, name).double() - getattr(env.state.kinematics, name).double())
    errors = torch.stack(errors)  # (steps, envs, width)
    assert errors.shape == (12, 200, width)
    assert -0.3 - 1e-5 <= errors.min() < -0.29 and 0.09 < errors.max() <= 0.1 + 1e-5
    if lasts:
        torch.testing.assert_close(errors[1:], errors[:1].expand(11, -1, -1), atol=1e-5, rtol=0)
    else:
        n = errors[1:].numel()
        centred = (errors + 0.1) / (0.4 / math.sqrt(12))
        assert errors.std().item() == pytest.approx(0.4 / math.sqrt(12), rel=0.02)
        assert abs((centred[1:] * centred[:-1]).mean()) < 4 / math.sqrt(n)
        assert abs((centred[..., 1:] * centred[..., :-1]).mean()) < 4 / math.sqrt(n)
    assert abs(errors.mean() + 0.1) < 4 * 0.4 / math.sqrt(12 * 200 * width)


def test_attitude_noise_tilts_evenly(blind):
    """Uniform in +-1 deg each; gravity's horizontal components move by as many rad, and its length stays 1."""
    env = blind("randomization.attitude_noise_deg=[-1,1]", num_envs=300)
    env.step(torch.zeros(300, 12))
    measured, true = (each.projected_gravity_b.double() for each in (env.state.measured, env.state.kinematics))
    moved = (measured - true)[:, :2].rad2deg()
    assert moved.abs().max() < 1.01 and moved.abs().amax(0).min() > 0.97
    assert moved.std(0).tolist() == pytest.approx([1 / math.sqrt(3)] * 2, rel=0.1)
    torch.testing.assert_close(measured.norm(dim=1), torch.ones(300).double(), atol=1e-5, rtol=0)
    turned = torch.remainder(env.state.measured.yaw - env.state.kinematics.yaw + math.pi, 2 * math.pi) - math.pi
    assert turned.abs().max() < math.radians(0.1)


@pytest.fixture(scope="module")
def course():
    n, random = 2000, EnvRandom(3, 2000)
    errors = MeasurementErrors(
        RandomizationConfig(velocity_drift=Drift(0.05, 2.0)), n, 12, 0.02, random.branch("measurement")
    )
    errors.reset(torch.arange(n))
    course = [errors._drift.value.double().clone()]
    for _ in range(300):
        errors.advance()
        course.append(errors._drift.value.double().clone())
    return torch.stack(course).flatten(1)  # (steps, envs and axes)


class TestDrift:
    """An Ornstein-Uhlenbeck process of sd 0.05 m/s and 2 s."""

    @pytest.mark.parametrize("step", [0, 1, 50, 300])
    def test_its_spread_is_the_same_at_all_times(self, course, step):
        assert course[step].std().item() == pytest.approx(0.05, rel=0.03)
        assert abs(course[step].mean()) < 4 * 0.05 / math.sqrt(6000)

    @pytest.mark.parametrize("lag", [1, 50, 100, 300])
    def test_it_forgets_exponentially(self, course, lag):
        correlation = (course[lag:] * course[:-lag]).mean() / (course**2).mean()
        assert correlation.item() == pytest.approx(math.exp(-0.02 * lag / 2.0), abs=0.04)

    def test_it_is_normal_in_time_and_never_jumps(self, course):
        share = (course[300].abs() > 0.1).double().mean().item()
        assert share == pytest.approx(0.0455, abs=0.012)  # beyond two standard deviations
        assert course.diff(dim=0).abs().max() < 0.05 * math.sqrt(12 * 0.02 / 2.0) + 0.003


def test_odometry_follows_what_is_measured(make_env):
    """A velocity thought 10 % too high: the base's motion from frame to frame is 10 % too long."""
    task = ("experiment=avoid", "terrain=flat", "obstacles=static", "obstacles.curriculum=null", "lidar.num_rays=200")
    task = (*task, "randomization=lidar")
    exact, fast = make_env(*task), make_env(*task, "randomization.velocity_scale=[1.1,1.1]")
    for action in random_actions(exact, 10, scale=0.5):
        exact.step(action)
        fast.step(action)
    true, longer = (env.sensing.history.frames[:, -1, -1] for env in (exact, fast))
    assert true[:, :2].norm(dim=1).min() > 1e-4
    torch.testing.assert_close(longer[:, :2], 1.1 * true[:, :2])
    torch.testing.assert_close(longer[:, 2], true[:, 2])


def drawn(env):
    errors = env.state._errors
    parts = {"bias": errors._bias.values, "noise": errors._noise.values, "drift": errors._drift.value}
    return {name: values.clone() for name, values in parts.items()}


def test_a_reset_elsewhere_changes_no_error(blind):
    env = blind(*ALL)
    for action in random_actions(env, 3):
        env.step(action)
    before = env.state.measured.base_ang_vel_b - env.state.kinematics.base_ang_vel_b
    saved = drawn(env)
    env._reset(torch.tensor([1]))
    after = env.state.measured.base_ang_vel_b - env.state.kinematics.base_ang_vel_b
    others = [0, 2, 3]
    torch.testing.assert_close(before[others], after[others], atol=0, rtol=0)
    now = drawn(env)
    assert_equal({k: v[others] for k, v in saved.items()}, {k: v[others] for k, v in now.items()})
    assert all((saved[name][1] != now[name][1]).all() for name in saved)


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("velocity_scale=[-0.1,1]", r"velocity_scale=\[-0.1, 1\] must be \[low, high\] with 0 <= low <= high"),
        ("gyro_noise=[0.2,-0.2]", r"gyro_noise=\[0.2, -0.2\] must be \[low, high\]"),
        ("velocity_drift={sd: -1, time_s: 1}", "a drift's sd=-1"),
        ("velocity_drift={sd: 1, time_s: 0}", "a drift's time_s=0"),
        ("velocity_drift={sd: 1}", "randomization.velocity_drift lacks time_s"),
    ],
)
def test_errors_that_cannot_be_are_refused(make_config, row, message):
    with pytest.raises(ValueError, match=message):
        make_config(f"randomization.{row}")
