"""Both simulators behave alike: the same tests for `sim=mujoco` and `sim=mujoco_warp`."""

import copy
import math

import mujoco
import numpy as np
import pytest
import torch
from robots import default_joints, simulator, stand, targets

from omniperception.sim import SimConfig
from omniperception.sim.mujoco_warp import MujocoWarpConfig


@pytest.fixture(scope="module", params=[SimConfig(), MujocoWarpConfig(device="cpu")], ids=["mujoco", "mujoco_warp"])
def engine(request):
    return request.param


@pytest.fixture
def sim(run, engine):
    sim = simulator(run, engine)
    stand(sim)
    return sim


def test_body_poses_are_those_of_the_current_state(sim):
    sim.step(targets(sim, 1, 1)[0])
    sim.qpos[1, 0] = 3.0
    sim.mocap_pos[1, 0] = torch.tensor([1.0, 2.0, 3.0])
    base, obstacle = sim.world.base_body, sim.world.model.body("obstacle_pillar_0").id
    calf = sim.world.model.body("RR_calf").id
    pos, quat = sim.body_poses((base, calf, obstacle))
    data = mujoco.MjData(sim.world.model)
    data.qpos[:], data.mocap_pos[:] = sim.qpos[1].double().numpy(), sim.mocap_pos[1].double().numpy()
    mujoco.mj_kinematics(sim.world.model, data)
    np.testing.assert_allclose(pos[1].numpy(), data.xpos[[base, calf, obstacle]], atol=1e-6)
    np.testing.assert_allclose(quat[1].numpy(), data.xquat[[base, calf, obstacle]], atol=1e-6)
    foot = sim.world.model.geom("RR_foot").id
    pos, mat = sim.geom_poses((foot,))
    np.testing.assert_allclose(pos[1, 0].numpy(), data.geom_xpos[foot], atol=1e-6)
    np.testing.assert_allclose(mat[1, 0].numpy().ravel(), data.geom_xmat[foot], atol=1e-6)


def test_a_state_that_was_read_stays_as_it_was(sim):
    before = sim.robot_state()
    kept = [values.clone() for values in before]
    sim.step(targets(sim, 1, 1)[0])
    assert all(torch.equal(a, b) for a, b in zip(before, kept, strict=True))
    assert not torch.equal(sim.robot_state()[1], before[1])


def test_recorded_states_are_those_after_each_physics_step(run, engine):
    """A call of four steps against four calls of one, positions and velocities; twice, so that nothing old is left."""
    at_once, one_by_one = simulator(run, engine, record_states=True), simulator(run, engine)
    for each in (at_once, one_by_one):
        stand(each)
    for target in targets(at_once, 7, 2):
        at_once.step(target, 4)
        states = []
        for _ in range(4):
            one_by_one.step(target, 1)
            states.append(one_by_one.robot_state())
        for recorded, expected in zip(at_once.recorded_states(), zip(*states, strict=True), strict=True):
            assert torch.equal(recorded.float(), torch.stack(expected, 1))
            assert not torch.equal(recorded[:, 2], recorded[:, 3])


def test_impulses_of_obstacles_are_those_of_the_contacts(sim, engine):
    """Against mj_contactForce, of a pillar that overlaps one robot and is far from the others."""
    model, steps = sim.world.model, 4
    pillar = model.geom("obstacle_pillar_0").id
    sim.mocap_pos[0, 0] = torch.tensor([0.32 + float(model.geom_size[pillar, 0]), 0.05, 0.5])
    data = mujoco.MjData(model)
    data.qpos[:], data.ctrl[:] = sim.qpos[0].double().numpy(), default_joints(sim).numpy()
    data.mocap_pos[:] = sim.mocap_pos[0].double().numpy()
    expected, force = 0.0, np.zeros(6)
    for _ in range(steps):
        mujoco.mj_step(model, data)
        total = np.zeros(3)
        for k in range(data.ncon):
            if pillar in data.contact[k].geom:
                mujoco.mj_contactForce(model, data, k, force)
                sign = 1.0 if data.contact[k].geom[1] == pillar else -1.0
                total += sign * data.contact[k].frame.reshape(3, 3).T @ force[:3]
        expected += float(np.linalg.norm(total)) * model.opt.timestep
    sim.step(default_joints(sim).expand(4, -1), steps)
    got = sim.contact_impulse("obstacle_force")
    assert expected > 0.1 and got[0] == pytest.approx(expected, rel=1e-3 if isinstance(engine, SimConfig) else 0.05)
    assert got[1:].tolist() == [0.0] * 3 and sim.touched("obstacle_contact").tolist() == [True, False, False, False]


def test_standing_feet_carry_the_weight(sim):
    """The reading is what a foot does to the ground: downwards."""
    target = default_joints(sim).expand(4, -1)
    total = torch.zeros(4)
    for step in range(240):
        sim.step(target)
        if step >= 200:
            total += sim.contact_sensor("foot_force").unflatten(1, (4, 3))[..., 2].sum(1) / 40
    weight = sim.world.model.body_subtreemass[sim.world.base_body] * 9.81
    assert 140 < weight < 160
    torch.testing.assert_close(-total, torch.full((4,), weight, dtype=torch.float32), rtol=0.03, atol=0)


def test_an_obstacle_in_the_trunk_is_felt_in_its_own_environment_only(sim):
    sim.mocap_pos[2, 1] = torch.tensor([0.1, 0.0, 0.3])
    sim.step(default_joints(sim).expand(4, -1))
    felt = sim.contact_sensor("obstacle_contact") > 0
    assert felt.nonzero().tolist() == [[2, 1]]


def test_reset_of_one_leaves_the_others_bit_identical(run, engine):
    kept, disturbed = simulator(run, engine), simulator(run, engine)
    for sim in (kept, disturbed):
        stand(sim)
    for step, target in enumerate(targets(kept, 2, 60)):
        if step == 30:
            qpos = kept.qpos[1:2] * 0 + kept.qpos[3:4]
            disturbed.reset(torch.tensor([1]), qpos, torch.ones(1, 18))
            assert torch.equal(disturbed.qvel[1].double(), torch.ones(18).double())
            assert (disturbed.contact_sensor("foot_force")[1] == 0).all()
        kept.step(target)
        disturbed.step(target)
    others = [0, 2, 3]
    assert torch.equal(kept.qpos[others], disturbed.qpos[others])
    assert torch.equal(kept.qvel[others], disturbed.qvel[others])
    assert not torch.equal(kept.qpos[1], disturbed.qpos[1])


def test_a_reset_forgets_the_past(run, engine):
    """The same pose and targets give the same motion, whatever happened before (no warm start left over)."""
    fresh, used = simulator(run, engine), simulator(run, engine)
    for target in targets(used, 3, 50):
        used.step(target)
    for sim in (fresh, used):
        stand(sim)
        for target in targets(sim, 4, 30):
            sim.step(target)
    assert torch.equal(fresh.qpos, used.qpos)


@pytest.mark.parametrize("field", ["qpos", "qvel"])
@pytest.mark.parametrize("value", [math.nan, math.inf, 1e12])
def test_a_broken_state_is_detected_and_stays_alone(run, engine, field, value):
    healthy, broken = simulator(run, engine), simulator(run, engine)
    for sim in (healthy, broken):
        stand(sim)
    getattr(broken, field)[1, 7] = value
    steps = targets(healthy, 5, 4)
    for sim in (healthy, broken):
        for target in steps:
            sim.step(target)
        sim.detect_failures()
    assert not healthy.failed.any() and broken.failed.tolist() == [False, True, False, False]
    others = [0, 2, 3]
    assert torch.equal(healthy.qpos[others], broken.qpos[others])
    for sim in (healthy, broken):
        stand(sim)
        assert not sim.failed.any()
        sim.step(steps[0])
    assert torch.equal(healthy.qpos, broken.qpos)


def test_a_field_is_per_environment_once_it_is_asked_for(sim):
    """Free fall for one step, v = g dt, and friction that is doubled in one environment alone."""
    sim.qpos[:, 2] = 5.0
    sim.model_field("opt.gravity")[3] = torch.tensor([1.0, 0.0, -8.81], dtype=sim.qpos.dtype)
    friction = sim.model_field("geom_friction")
    friction[1] *= 2
    nominal = torch.tensor(sim.world.model.geom_friction, dtype=friction.dtype)
    torch.testing.assert_close(friction[[0, 1, 3]], torch.stack((nominal, 2 * nominal, nominal)))
    sim.step(default_joints(sim).expand(4, -1))
    assert sim.qvel[3, :3].tolist() == pytest.approx([0.005, 0.0, -8.81 * 0.005], abs=1e-6)
    assert sim.qvel[0, :3].tolist() == pytest.approx([0.0, 0.0, -9.81 * 0.005], abs=1e-6)


def test_saved_state_goes_on_bit_for_bit(run, engine):
    whole, resumed = simulator(run, engine), simulator(run, engine)
    stand(whole)
    whole.mocap_pos[0, 0] = torch.tensor([0.3, 0.0, 0.2])
    whole.model_field("body_mass")[1, whole.world.base_body] += 2.0
    whole.update_model(torch.arange(4))
    steps = targets(whole, 6, 80)
    for target in steps[:40]:
        whole.step(target)
    state = copy.deepcopy(whole.state_dict())
    for target in steps[40:]:
        whole.step(target)
    resumed.load_state_dict(state)
    for target in steps[40:]:
        resumed.step(target)
    for field in ("qpos", "qvel", "mocap_pos", "mocap_quat"):
        assert torch.equal(getattr(whole, field), getattr(resumed, field)), field
    assert torch.equal(whole.contact_sensor("foot_force"), resumed.contact_sensor("foot_force"))
