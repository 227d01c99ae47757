"""The batched CPU engine against plain MuJoCo, and its settings."""

import mujoco
import numpy as np
import pytest
from robots import simulator, stand, targets

from omniperception.scene import build_world
from omniperception.sim import SimConfig
from omniperception.sim.mujoco import apply_options


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"integrator": "euler", "cone": "elliptic"},
        {"timestep": 0.002, "iterations": 50, "num_threads": 1},
    ],
)
def test_steps_are_those_of_mj_step(run, settings):
    sim = simulator(run, SimConfig(**settings))
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
