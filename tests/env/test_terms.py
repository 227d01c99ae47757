"""Terms: what is computed for them, terms with state, shapes, and the feet that they read about."""

from collections import OrderedDict
from dataclasses import replace
from functools import partial

import mujoco
import numpy as np
import pytest
import torch

from omnilidar import launch
from omnilidar.launch import default_num_threads
from omniperception.env.env import OmniEnv
from omniperception.env.mdp import rewards
from omniperception.env.mdp.terms import RewardTerm, StatefulTerm
from omniperception.env.state import AirTimes, requires

FEET = {
    "air": RewardTerm(1.0, partial(rewards.foot_air_time, target=0.1, min_speed=0.0)),
    "clearance": RewardTerm(-1.0, partial(rewards.foot_clearance, target=0.08)),
    "slip": RewardTerm(-1.0, rewards.foot_slip),
}


def with_terms(env, **terms):
    """The same task with more reward terms."""
    kept = env.config.rewards
    return OmniEnv(replace(env.config, rewards=replace(kept, terms={**kept.terms, **terms})))


class Steps(StatefulTerm):
    """Control steps since the episode began, in units of `unit`."""

    def __init__(self, unit: float) -> None:
        self.unit, self.count = unit, None

    def __call__(self, state):
        if self.count is None:
            self.count = torch.zeros(state.num_envs)
        self.count = self.count + 1.0
        return self.count / self.unit

    def reset(self, env_ids):
        self.count = self.count.index_fill(0, env_ids, 0.0)


def test_a_term_with_state_is_built_once_reset_with_its_environments_and_saved(make_env):
    def build():
        return with_terms(make_env("obstacles=none", blind=True), steps=RewardTerm(1.0, partial(Steps, unit=2.0)))

    env, still = build(), torch.zeros(4, 12)
    for _ in range(3):
        env.step(still)
    assert env.rewards.weighted["steps"].tolist() == pytest.approx([0.02 * 3 / 2] * 4)
    env.sim.qpos[1, 2] = 0.05  # falls
    env.step(still)
    resumed = build()
    resumed.load_state_dict(env.state_dict())
    for each in (env, resumed):
        each.step(still)
        assert each.rewards.weighted["steps"].tolist() == pytest.approx([0.01 * n for n in (5, 1, 5, 5)])


@pytest.mark.parametrize(
    ("term", "message"),
    [
        (lambda state: state.kinematics.joint_pos, r"rewards\.terms\.mine has shape \(4, 12\), expected \(4,\)"),
        (
            lambda state: state.foot_force[:, 0, 0],
            r"reads foot_force without declaring it; .*@requires\('foot_force'\)",
        ),
        (lambda state: state.avoidance_velocity[:, 0], r"reads avoidance without declaring it"),
    ],
)
def test_wrong_terms_are_refused_when_the_environment_is_built(make_env, term, message):
    with pytest.raises(ValueError, match=message) as error:
        with_terms(make_env("obstacles=none", blind=True), mine=RewardTerm(1.0, term))
    assert "\n" not in str(error.value)
    with pytest.raises(ValueError, match=r"@requires\(foot_forces\) is unknown; known: foot_force"):
        requires("foot_forces")


def test_a_quantity_that_is_not_read_is_not_computed(make_env):
    env = make_env("obstacles=moving", blind=True)
    computed = set()
    env.step_hooks.append(lambda: computed.update(vars(env.state)))
    env.step(torch.zeros(4, 12))
    unread = {"heights", "obstacles", "foot_force", "link_force", "foot_motion"}
    assert not unread & computed and {"kinematics", "joint_torque", "joint_acc"} <= computed
    before = env.state.kinematics
    assert env.state.kinematics is before  # computed once in a step
    env.step(torch.zeros(4, 12))
    assert env.state.before is before and env.state.kinematics is not before
    acceleration = (env.state.kinematics.joint_vel - before.joint_vel) / 0.02
    torch.testing.assert_close(env.state.joint_acc, acceleration)


def test_what_is_there_for_others_is_refused_where_it_was_not_declared(make_env):
    """A velocity risk needs avoidance and clouds, whose other figures nobody computes."""
    env = make_env("experiment=avoid", "init=null", "lidar.num_rays=100", num_envs=2)
    with pytest.raises(ValueError, match="reads avoidance without declaring it"):
        _ = env.state.avoidance_velocity
    with pytest.raises(ValueError, match="reads distal_range without declaring it"):
        env.state.mean_distal_range(5.0)
    with pytest.raises(ValueError, match="reads cloud without declaring it"):
        _ = env.state.cloud


def test_a_reset_robot_has_not_been_accelerated(make_env):
    env = make_env("obstacles=none", blind=True)
    env.step(torch.ones(4, 12))
    before = env.state.joint_acc.clone()
    assert (before.abs().amax(1) > 1.0).all()
    env.reset(torch.tensor([1, 3]))
    assert torch.equal(env.state.joint_acc[[0, 2]], before[[0, 2]]) and not env.state.joint_acc[[1, 3]].any()


def test_without_obstacles_there_are_none(make_env):
    state = make_env("obstacles=none", blind=True).state
    assert [tuple(part.shape) for part in state.obstacles] == [(4, 0, 2)] * 2 + [(4, 0)] * 2 + [(4, 0, 2)] * 2
    assert rewards.closing_speed(state, horizon=1.0, margin=0.5).tolist() == [0.0] * 4


@pytest.mark.parametrize("sim", ["sim=mujoco", "sim=mujoco_warp"])
def test_feet_move_as_mujoco_says(make_env, sim):
    """Positions and velocities against mj_objectVelocity in float64."""
    env = make_env(sim, *(["sim.device=cpu"] if sim.endswith("warp") else []), "obstacles=none", blind=True)
    for step in range(3):
        env.step(torch.randn(4, 12, generator=torch.Generator().manual_seed(step)))
    model, data = env.world.model, mujoco.MjData(env.world.model)
    for i in range(4):
        data.qpos[:], data.qvel[:] = env.sim.qpos[i].double().numpy(), env.sim.qvel[i].double().numpy()
        mujoco.mj_forward(model, data)
        for foot, name in enumerate(env.robot.foot_geoms):
            geom, velocity = model.geom(name).id, np.zeros(6)
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_GEOM, geom, velocity, 0)
            np.testing.assert_allclose(env.state.foot_pos_w[i, foot], data.geom_xpos[geom], atol=2e-5)
            np.testing.assert_allclose(env.state.foot_vel_w[i, foot], velocity[3:], atol=2e-4)


def test_air_times_by_hand():
    """One robot, two feet; steps of 0.5 s. The first is in the air for two steps, the second never."""
    times = AirTimes(torch.zeros(1, 2, dtype=torch.bool))
    for contact in ((False, True), (False, True), (True, True)):
        times.advance(torch.tensor([contact]), 0.5)
    assert times.touched_down.tolist() == [[True, False]] and times.last_air.tolist() == [[1.0, 0.0]]
    assert times.air.tolist() == [[0.0, 0.0]]
    times.advance(torch.tensor([[False, True]]), 0.5)
    assert not times.touched_down.any() and times.last_air.tolist() == [[1.0, 0.0]]
    times.reset(torch.tensor([0]))
    assert not any(value.any() for value in times.state_dict().values())


def test_legged_terms_in_the_task(make_env):
    """Robots that are dropped from 0.1 m: feet in the air for sqrt(2 * 0.1 / 9.81) = 0.143 s; a reset forgets it."""
    env = with_terms(make_env("obstacles=none", blind=True), **FEET)
    assert env.world.sensors == {"foot_force"}
    env.sim.qpos[:, 2] += 0.1
    for step in range(1, 9):
        env.step(torch.zeros(4, 12))
        assert env.state.foot_contact.all() == (step == 8) and env.state.foot_contact.any() == (step == 8)
    times = env.state.foot_times
    assert times.touched_down.all() and times.last_air.flatten().tolist() == pytest.approx([0.14] * 16)
    expected = [0.02 * 4 * 0.04 * bool(command.norm() > 0) for command in env.state.command[:, :2]]
    assert env.rewards.weighted["air"].tolist() == pytest.approx(expected)
    env._reset(torch.tensor([2]))
    assert not times.last_air[2].any() and times.last_air[1].all()


def test_launches_take_the_environments_threads(make_env, monkeypatch):
    taken = []
    monkeypatch.setattr(launch, "SplitLaunch", lambda *given: taken.append(given[5]) or (lambda: None))
    monkeypatch.setattr(launch, "_launches", OrderedDict())  # other tests' launches are not these
    for threads, expected in ((1, 1), (2, 2), (0, default_num_threads())):
        make_env("obstacles=none", f"sim.num_threads={threads}", blind=True, num_envs=1)
        launch.launch_over_envs("kernel", 1, [threads], torch.device("cpu"))
        launch.launch_over_envs("kernel", 1, [threads], torch.device("cpu"), num_threads=3)
        assert taken[-2:] == [expected, 3]
    launch.use_threads(None)
