"""The batched CPU engine against plain MuJoCo, resets, failures and saved states."""

import copy

import mujoco
import numpy as np
import pytest
import torch

from omniperception.sim import MujocoSimulator, SimConfig
from omniperception.sim.mujoco import apply_options
from omniperception.world import build_world

DEFAULT = SimConfig()


def simulator(run, num_envs=4, sensors=("foot_force", "obstacle_contact"), **settings):
    world = build_world(run.env.robot, run.env.terrain, run.env.obstacles, sensors)
    return MujocoSimulator(world, SimConfig(**settings), num_envs)


@pytest.fixture(scope="module")
def run(make_config):
    return make_config("obstacles=static")


@pytest.fixture
def sim(run):
    sim = simulator(run)
    stand(sim)
    return sim


def stand(sim):
    """Puts every robot into its default pose, obstacles out of reach."""
    qpos = torch.zeros(sim.num_envs, 19, dtype=torch.float64)
    qpos[:, 2], qpos[:, 3] = 0.33, 1.0
    qpos[:, 7:] = default_joints(sim)
    sim.mocap_pos[:] = torch.tensor([0.0, 0.0, -100.0])
    sim.mocap_quat[:] = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    sim.reset(torch.arange(sim.num_envs), qpos, torch.zeros(sim.num_envs, 18))


def default_joints(sim):
    return torch.tensor(list(sim.world.robot.default_joint_pos.values()), dtype=torch.float64)


def targets(sim, seed, steps):
    generator = torch.Generator().manual_seed(seed)
    noise = 0.3 * torch.randn(steps, sim.num_envs, 12, generator=generator, dtype=torch.float64)
    return default_joints(sim) + noise


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"integrator": "euler", "cone": "elliptic"},
        {"timestep": 0.002, "iterations": 50, "num_threads": 1},
    ],
)
def test_steps_are_those_of_mj_step(run, settings):
    sim = simulator(run, **settings)
    stand(sim)
    model = build_world(run.env.robot, run.env.terrain, run.env.obstacles, ("foot_force",)).model
    apply_options(model, SimConfig(**settings))
    data = mujoco.MjData(model)
    data.qpos[:], data.mocap_pos[:] = sim.qpos[2].numpy(), [0, 0, -100]
    sim.joint_torque()  # what is asked for once is kept from then on
    for target in targets(sim, 0, 100):
        sim.step(target)
        data.ctrl[:] = target[2].numpy()
        mujoco.mj_step(model, data)
    np.testing.assert_allclose(sim.qpos[2].numpy(), data.qpos, rtol=0, atol=1e-10)
    np.testing.assert_allclose(sim.qvel[2].numpy(), data.qvel, rtol=0, atol=1e-10)
    sim.body_poses((sim.world.base_body,))  # computed in the engine's scratch memory, where torques lie too
    np.testing.assert_allclose(sim.joint_torque()[2].numpy(), data.actuator_force, atol=1e-4)
    forces = sim.contact_sensor("foot_force")[2].numpy()
    np.testing.assert_allclose(forces, data.sensordata[: forces.size], atol=1e-4)


def test_body_poses_are_those_of_the_current_state(sim):
    sim.step(targets(sim, 1, 1)[0])
    sim.qpos[1, 0] = 3.0
    sim.mocap_pos[1, 0] = torch.tensor([1.0, 2.0, 3.0])
    base, obstacle = sim.world.base_body, sim.world.model.body("obstacle_pillar_0").id
    calf = sim.world.model.body("RR_calf").id
    pos, quat = sim.body_poses((base, calf, obstacle))
    data = mujoco.MjData(sim.world.model)
    data.qpos[:], data.mocap_pos[:] = sim.qpos[1].numpy(), sim.mocap_pos[1].numpy()
    mujoco.mj_kinematics(sim.world.model, data)
    np.testing.assert_allclose(pos[1].numpy(), data.xpos[[base, calf, obstacle]], atol=1e-6)
    np.testing.assert_allclose(quat[1].numpy(), data.xquat[[base, calf, obstacle]], atol=1e-6)


def test_standing_feet_carry_the_weight(sim):
    """The reading is what a foot does to the ground: downwards."""
    target = default_joints(sim).expand(4, -1)
    total = torch.zeros(4)
    for step in range(400):
        sim.step(target)
        if step >= 300:
            total += sim.contact_sensor("foot_force").unflatten(1, (4, 3))[..., 2].sum(1) / 100
    weight = sim.world.model.body_subtreemass[sim.world.base_body] * 9.81
    assert 140 < weight < 160
    torch.testing.assert_close(-total, torch.full((4,), weight, dtype=torch.float32), rtol=0.03, atol=0)


def test_an_obstacle_in_the_trunk_is_felt_in_its_own_environment_only(sim):
    sim.mocap_pos[2, 1] = torch.tensor([0.1, 0.0, 0.3])
    sim.step(default_joints(sim).expand(4, -1))
    felt = sim.contact_sensor("obstacle_contact") > 0
    assert felt.nonzero().tolist() == [[2, 1]]


def test_reset_of_one_leaves_the_others_bit_identical(run):
    kept, disturbed = simulator(run), simulator(run)
    for sim in (kept, disturbed):
        stand(sim)
    for step, target in enumerate(targets(kept, 2, 60)):
        if step == 30:
            qpos = kept.qpos[1:2] * 0 + kept.qpos[3:4]
            disturbed.reset(torch.tensor([1]), qpos, torch.ones(1, 18))
            assert torch.equal(disturbed.qvel[1], torch.ones(18, dtype=torch.float64))
            assert (disturbed.contact_sensor("foot_force")[1] == 0).all()
        kept.step(target)
        disturbed.step(target)
    others = [0, 2, 3]
    assert torch.equal(kept.qpos[others], disturbed.qpos[others])
    assert torch.equal(kept.qvel[others], disturbed.qvel[others])
    assert not torch.equal(kept.qpos[1], disturbed.qpos[1])


def test_a_reset_forgets_the_past(run):
    """The same pose and targets give the same motion, whatever happened before (no warm start left over)."""
    fresh, used = simulator(run), simulator(run)
    for target in targets(used, 3, 50):
        used.step(target)
    for sim in (fresh, used):
        stand(sim)
        for target in targets(sim, 4, 30):
            sim.step(target)
    assert torch.equal(fresh.qpos, used.qpos)


@pytest.mark.parametrize("field", ["qpos", "qvel"])
@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e12])
def test_a_broken_state_is_detected_and_stays_alone(run, field, value):
    healthy, broken = simulator(run), simulator(run)
    for sim in (healthy, broken):
        stand(sim)
    getattr(broken, field)[1, 7] = value
    for target in targets(healthy, 5, 4):
        healthy.step(target)
        broken.step(target)
    healthy.detect_failures()
    broken.detect_failures()
    assert not healthy.failed.any()
    assert broken.failed.tolist() == [False, True, False, False]
    others = [0, 2, 3]
    assert torch.equal(healthy.qpos[others], broken.qpos[others])
    stand(broken)
    assert not broken.failed.any()


def test_per_environment_fields_exist_only_when_asked_for(sim):
    assert sim.batch.expanded("geom_friction") is None
    sim.model_field("geom_friction")[1] *= 2
    assert sim.batch.expanded("geom_friction") is not None and sim.batch.expanded("geom_solref") is None
    assert sim.model_field("geom_friction")[0, 0, 0] == sim.world.model.geom_friction[0, 0]


def test_gravity_of_one_environment(sim):
    """Free fall for one step: v = g dt, and only where gravity was changed."""
    sim.qpos[:, 2] = 5.0
    sim.model_field("opt.gravity")[3] = torch.tensor([1.0, 0.0, -8.81], dtype=torch.float64)
    sim.step(default_joints(sim).expand(4, -1))
    assert sim.qvel[3, :3].tolist() == pytest.approx([0.005, 0.0, -8.81 * 0.005], abs=1e-6)
    assert sim.qvel[0, :3].tolist() == pytest.approx([0.0, 0.0, -9.81 * 0.005], abs=1e-6)


def test_saved_state_goes_on_bit_for_bit(run):
    whole, resumed = simulator(run), simulator(run)
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


@pytest.mark.parametrize(
    ("settings", "key"),
    [
        ({"timestep": 0.0}, r"sim\.timestep=0\.0"),
        ({"decimation": 0}, r"sim\.decimation=0"),
        ({"iterations": 0}, r"sim\.iterations=0"),
        ({"num_threads": -1}, r"sim\.num_threads=-1"),
        ({"integrator": "leapfrog"}, r"sim\.integrator=leapfrog.*implicitfast"),
        ({"cone": "round"}, r"sim\.cone=round.*pyramidal"),
    ],
)
def test_wrong_settings_are_refused(settings, key):
    with pytest.raises(ValueError, match=key):
        SimConfig(**settings)
