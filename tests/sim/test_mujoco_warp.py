"""MuJoCo Warp against `mj_step`, its memory, capacities and derived fields; on a CPU at small size."""

import sys

import mujoco
import numpy as np
import pytest
import torch
from robots import default_joints, simulator, stand

from benchmarks.step_errors import step_errors
from omniperception.scene import build_world
from omniperception.sim.mujoco_warp import Capacity, MujocoWarpConfig

CPU = MujocoWarpConfig(device="cpu")


def test_one_step_is_that_of_mj_step(run):
    """Robots that stand, stumble and lie; measured: 1e-5 rad/s and 1e-7 rad at most, in float32."""
    errors = step_errors(simulator(run, CPU, 24))
    assert (errors.contacts > 0).mean() > 0.7 and errors.contacts.max() >= 4
    assert np.median(errors.velocity) < 2e-5
    assert errors.velocity.max() < 1e-3 and errors.position.max() < 5e-6


def test_state_is_the_memory_of_the_engine(run):
    sim = simulator(run, CPU)
    sim.qpos[2, 7] = 0.25
    sim.mocap_pos[1, 0, 2] = -3.0
    assert sim.data.qpos.numpy()[2, 7] == np.float32(0.25) and sim.data.mocap_pos.numpy()[1, 0, 2] == -3.0
    assert sim.qpos.data_ptr() == sim.data.qpos.ptr


def test_masses_bring_what_the_engine_derives_from_them(run):
    """Inverse weights of one heavier world against `mj_setConst`; those of the others stay."""
    sim = simulator(run, CPU)
    base = sim.world.base_body
    sim.model_field("body_mass")[2, base] += 5.0
    assert sim.model.body_mass.shape[0] == 4 and sim.model.geom_solref.shape[0] == 1  # per world only when asked for
    before = sim.model.body_invweight0.numpy()[[0, 1, 3]]
    sim.update_model(torch.tensor([2]))
    model = sim.world.model
    model.body_mass[base] += 5.0
    mujoco.mj_setConst(model, mujoco.MjData(model))
    np.testing.assert_allclose(sim.model.body_invweight0.numpy()[2], model.body_invweight0, rtol=2e-3, atol=1e-6)
    np.testing.assert_allclose(sim.model.body_subtreemass.numpy()[2, base], model.body_subtreemass[base], rtol=1e-6)
    assert np.array_equal(sim.model.body_invweight0.numpy()[[0, 1, 3]], before)


def test_masses_of_more_worlds_than_are_derived_at_once(run):
    """Every world's inverse weights against `mj_setConst`, in an order that is not that of the worlds."""
    num_envs = 70
    sim = simulator(run, CPU, num_envs)
    model, base = sim.world.model, sim.world.base_body
    sim.model_field("body_mass")[:, base] += torch.linspace(-1.0, 5.0, num_envs)
    sim.update_model(torch.arange(num_envs).flip(0))
    nominal = float(model.body_mass[base])
    for env in (0, 31, 32, 37, 38, 69):
        model.body_mass[base] = nominal - 1.0 + 6.0 * env / (num_envs - 1)
        mujoco.mj_setConst(model, mujoco.MjData(model))
        weight = sim.model.body_invweight0.numpy()[env]
        np.testing.assert_allclose(weight, model.body_invweight0, rtol=2e-3, atol=1e-6)


def test_an_overflow_is_reported_and_names_the_override(run):
    sim = simulator(run, MujocoWarpConfig(device="cpu", rows_per_env=10))
    stand(sim)
    sim.qpos[1:, 2] = 3.0  # only one robot stands
    sim.step(default_joints(sim).expand(4, -1), 20)
    with pytest.warns(RuntimeWarning, match=r"raise sim\.rows_per_env \(now 10\)"):
        assert sim.anomalies() == {"constraint_overflow": 1, "contact_overflow": 0}
    assert sim.anomalies() == {"constraint_overflow": 0, "contact_overflow": 0}


def test_room_for_a_robot_on_all_of_its_geoms(run):
    """By hand: 5 spheres x 1, 8 capsules x 2, 5 cylinders and a box x 4; 3 obstacles x 6 links x 2; 12 joint limits."""
    room = Capacity.of(build_world(run.env.robot, run.env.terrain, run.env.obstacles), CPU)
    assert room.contacts == 5 + 16 + 24 + 36
    assert room.rows == 12 + 4 * room.contacts


@pytest.mark.parametrize(
    ("settings", "key"),
    [
        ({"device": "tpu"}, r"sim\.device=tpu"),
        ({"device": "cpu:1"}, r"sim\.device=cpu:1"),
        ({"rows_per_env": -1}, r"sim\.rows_per_env=-1"),
        ({"timestep": 0.0}, r"sim\.timestep=0\.0"),
    ],
)
def test_wrong_settings_are_refused(settings, key):
    with pytest.raises(ValueError, match=key):
        MujocoWarpConfig(**settings)


def test_a_missing_engine_names_its_extra(run, monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco_warp", None)
    with pytest.raises(ImportError, match=r"pip install 'omniperception\[gpu\]'.*sim=mujoco"):
        simulator(run, CPU)
