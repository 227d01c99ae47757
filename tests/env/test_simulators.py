"""The environment behaves alike with `sim=mujoco` and `sim=mujoco_warp`: the same tests for both, at small size."""

import math

import pytest
import torch

from omniperception.learning import load_checkpoint, save_checkpoint

FULL = (
    "obstacles=moving",
    "randomization=paper",
    "perception=pd_risknet",
    "rewards=paper",
    "lidar.num_rays=200",
    "lidar.period_s=0.04",
)
OTHERS = torch.tensor([0, 2, 3])


@pytest.fixture(params=["mujoco", "mujoco_warp"])
def make(request, make_env):
    return make_with(request.param, make_env)


def make_with(sim, make_env):
    device = ("sim.device=cpu",) if sim == "mujoco_warp" else ()
    return lambda *overrides: make_env(f"sim={sim}", *device, *FULL, *overrides)


def actions(env, steps, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return 0.3 * torch.randn(steps, env.num_envs, env.num_actions, generator=generator)


def outcome(env, action, env_ids=slice(None)):
    observations, reward, done, extras = env.step(action)
    seen = {name: observations[name][env_ids].clone() for name in observations.keys()}  # noqa: SIM118
    return {**seen, "reward": reward[env_ids].clone(), "done": done[env_ids].clone()}, extras


def assert_equal(a, b):
    assert a.keys() == b.keys()
    for name in a:
        assert torch.equal(a[name], b[name]), name


def test_a_fall_in_one_environment_changes_nothing_in_the_others(make):
    quiet, disturbed = make(), make()
    for step, action in enumerate(actions(quiet, 7)):
        if step == 3:
            disturbed.sim.qpos[1, 3:7] = torch.tensor([0.0, 1.0, 0.0, 0.0], dtype=disturbed.sim.qpos.dtype)
        assert_equal(outcome(quiet, action, OTHERS)[0], outcome(disturbed, action, OTHERS)[0])
    assert disturbed.episode_length_buf.tolist() == [7, 3, 7, 7]


@pytest.mark.parametrize("field", ["qpos", "qvel"])
def test_a_diverged_environment_is_reset_counted_and_stays_alone(make, field):
    healthy, broken = (make("ppo.num_steps_per_env=4") for _ in range(2))
    for step, action in enumerate(actions(healthy, 4)):
        if step == 1:
            getattr(broken.sim, field)[1, 2] = float("nan")
        expected, _ = outcome(healthy, action, OTHERS)
        got, extras = outcome(broken, action)
        assert_equal(expected, {name: value[OTHERS] for name, value in got.items()})
        assert [name for name, value in got.items() if not torch.isfinite(value.float()).all()] == []
        assert got["done"].tolist() == [0, int(step == 1), 0, 0]
        assert step != 1 or got["reward"][1] == 0
    assert extras["log"]["Anomalies/diverged"] == 1
    assert all(math.isfinite(value) for value in extras["log"].values())


def test_a_saved_state_goes_on_bit_for_bit(make, tmp_path):
    whole, resumed = (make("terminations.episode_length_s=0.1") for _ in range(2))
    steps = actions(whole, 9)
    for action in steps[:3]:
        whole.step(action)
    save_checkpoint(tmp_path / "state.pt", whole.state_dict())
    resumed.step(steps[0])
    resumed.load_state_dict(load_checkpoint(tmp_path / "state.pt"))
    for action in steps[3:]:
        assert_equal(outcome(whole, action)[0], outcome(resumed, action)[0])
    assert (whole.episode_length_buf < 5).all()


def test_both_simulators_show_the_same(make_env):
    """The same seed gives the same world; one control step later float32 physics differs by little."""
    first, second = (make_with(sim, make_env)() for sim in ("mujoco", "mujoco_warp"))
    for action in actions(first, 2):
        one, other = outcome(first, action)[0], outcome(second, action)[0]
        for name in ("command", "proprioception", "privileged", "height_target", "reward"):
            torch.testing.assert_close(one[name], other[name], atol=2e-3, rtol=0, msg=name)
    same = (one["frames"] - other["frames"]).abs().amax(-1) < 1e-3
    assert (one["frames"] != 0).any() and same.float().mean() > 0.95  # a ray at an edge may hit the other side


@pytest.mark.slow
def test_a_height_field_carries_the_robot_in_both(make_env):
    heights = []
    for sim in ("mujoco", "mujoco_warp"):
        env = make_with(sim, make_env)("terrain=stairs", "terrain.levels=2", "terrain.curriculum=null")
        for action in actions(env, 5):
            env.step(0.1 * action)
        assert (env.state.foot_force[..., 2].sum(1) < -20).all()  # all stand
        heights.append(env.state.base_height)
    torch.testing.assert_close(*heights, atol=3e-3, rtol=0)
