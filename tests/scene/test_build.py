"""The compiled environment: which geoms may touch, contact parameters, sensors."""

import math
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

import omniperception.scene
from omniperception.scene import TerrainConfig, build_world
from omniperception.scene.terrain import GROUND, contact_solrefs, damping_ratio
from omniperception.sim import SimConfig
from omniperception.sim.mujoco import apply_options


def world_of(run, sensors=()):
    world = build_world(run.env.robot, run.env.terrain, run.env.obstacles, sensors)
    apply_options(world.model, SimConfig())
    return world


@pytest.fixture(scope="module")
def mixed(make_config):
    return world_of(make_config("obstacles=mixed"))


def contact_pairs(world, data):
    """The pairs of classes that are in contact: R(obot), G(round), O(bstacle)."""
    obstacles = set(world.obstacles.geom_names())

    def kind(geom):
        name = world.model.geom(geom).name
        return "G" if name == "ground" else "O" if name in obstacles else "R"

    return {"".join(sorted(map(kind, pair))) for pair in data.contact.geom}


def shaken(model):
    """20 states with legs inside one another and the trunk, and obstacles inside the robot."""
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    data.qpos[2] = 0.1
    for _ in range(20):
        data.qpos[7:] = rng.uniform(-1.5, 1.5, 12)
        data.mocap_pos[:] = rng.uniform([-0.3, -0.3, -0.2], [0.3, 0.3, 0.4], (model.nmocap, 3))
        mujoco.mj_forward(model, data)
        yield data


def test_only_the_robot_touches_ground_and_obstacles(mixed):
    """It would touch itself without the filter."""
    assert all(contact_pairs(mixed, data) == {"GR", "OR"} for data in shaken(mixed.model))
    spec = mixed.robot.spec()
    for geom in spec.geoms:
        geom.contype, geom.conaffinity = 1, 1
    assert sum(data.ncon for data in shaken(spec.compile())) > 0


def test_every_part_is_a_kinematic_body_with_a_geom_of_its_name(make_config):
    """In the order of the parts; as large as they can be, so that what is derived from the model has room."""
    run = make_config("obstacles=corridor", "commands=corridor")
    model, parts = world_of(run).model, run.env.obstacles.parts()
    names = [f"obstacle_walker_{k}" for k in range(6)] + [f"obstacle_wall_{k}" for k in range(8)]
    assert [part.name for part in parts] == [*names, "obstacle_back_wall_0"] and model.nmocap == 15
    for k, part in enumerate(parts):
        geom, body = model.geom(part.name), model.body(part.name)
        assert geom.bodyid[0] == body.id and model.body_mocapid[body.id] == k
        assert body.geomnum[0] == 1 and not geom.pos.any()
    np.testing.assert_allclose(model.geom("obstacle_walker_5").size, [0.3, 0.9, 0.0])
    np.testing.assert_allclose(model.geom("obstacle_wall_1").size, [1.65, 0.05, 1.0])


def test_sensor_columns_are_those_of_the_named_geoms(make_config):
    world = world_of(make_config("obstacles=moving"), {"foot_force", "link_force", "obstacle_contact"})
    expected = {"foot_force": 12, "link_force": 45, "obstacle_contact": 8}
    columns = {kind: world.sensor_slice(kind) for kind in expected}
    assert {kind: s.stop - s.start for kind, s in columns.items()} == expected
    assert sum(expected.values()) == world.model.nsensordata
    first = world.model.sensor("foot_force:FL_foot")
    assert first.adr[0] == columns["foot_force"].start
    with pytest.raises(ValueError, match="unknown contact sensors"):
        world_of(make_config("obstacles=moving"), {"smell"})


def test_actuators_are_pd_controllers_with_torque_limits(mixed):
    """tau = kp (target - q) - kv qdot, clipped; kp 25, kv 0.6, calf limit 45.43 N m."""
    data = mujoco.MjData(mixed.model)
    mixed_default = list(mixed.robot.default_joint_pos.values())
    data.qpos[7:] = mixed_default
    data.qpos[2] = 5.0
    data.qvel[6:] = 0.5
    data.ctrl[:] = mixed_default
    data.ctrl[0] += 0.1
    data.ctrl[2] += 3.0
    mujoco.mj_forward(mixed.model, data)
    expected = np.full(12, -0.6 * 0.5)
    expected[0] += 25 * 0.1
    expected[2] = 45.43
    np.testing.assert_allclose(data.actuator_force, expected, atol=1e-9)


GO2 = (Path(omniperception.scene.__file__).parent / "assets" / "go2.xml").read_text()
CALF = '<joint name="RR_calf_joint"'


@pytest.mark.parametrize(
    ("mjcf", "overrides", "message"),
    [
        (GO2, ["robot.base=FL_hip"], "robot.base=FL_hip must be the first body .* bodies with a free joint: base"),
        (GO2.replace(CALF, CALF + ' type="ball" range="0 1"'), [], "robot.joints names RR_calf_joint: .* not balls"),
        (GO2, ["robot.foot_geoms=[FL_foot,paw]", "robot.gait=null"], "robot.foot_geoms names paw; known: .*FL_foot"),
    ],
)
def test_a_preset_that_does_not_fit_its_file_is_refused_in_one_line(make_config, tmp_path, mjcf, overrides, message):
    path = tmp_path / "robot.xml"
    path.write_text(mjcf)
    with pytest.raises(ValueError, match=message) as error:
        world_of(make_config(*overrides, f"robot.file={path}"))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(("restitution", "ratio"), [(0.0, 1.0), (1.0, 0.0), (math.exp(-math.pi), 0.7071068)])
def test_damping_ratio(restitution, ratio):
    assert damping_ratio(torch.tensor(restitution)).item() == pytest.approx(ratio, abs=1e-6)


def solref(restitution):
    return contact_solrefs(torch.tensor(restitution, dtype=torch.float64)).tolist()


def rebound(restitution, timestep, speed=1.0, gap=1e-4, ground=None):
    """Rebound speed over impact speed of a ball without weight, of a contact or, where it is given, on a ground."""
    spec = mujoco.MjSpec()
    (ground or TerrainConfig()).add_to(spec)
    if ground is None:
        spec.geom(GROUND).solref[:2] = solref(restitution)
    ball = spec.worldbody.add_body(pos=[0, 0, 0.1 + gap])
    ball.add_freejoint()
    ball.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.1, 0, 0], mass=1.0, contype=0, conaffinity=1)
    spec.option.timestep, spec.option.gravity = timestep, [0, 0, 0]
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qvel[2] = -speed
    mujoco.mj_step(model, data, nstep=int(0.5 / timestep))
    return data.qvel[2] / speed


@pytest.mark.parametrize("timestep", [0.001, 0.005])
@pytest.mark.parametrize(("restitution", "tolerance"), [(0.5, 0.1), (0.7, 0.06), (0.9, 0.03), (0.99, 0.02)])
def test_a_ball_rebounds_with_the_restitution(restitution, tolerance, timestep):
    """A contact cannot pull, so little restitution comes out a little larger than the linear formula says."""
    for gap in (1e-4, 2e-3, 4e-3):
        assert rebound(restitution, timestep, gap=gap) == pytest.approx(restitution, abs=tolerance)


@pytest.mark.parametrize("restitution", [0.0, 0.2, 0.4, 0.6, 0.8, 0.95, 1.0])
def test_no_contact_gains_energy(restitution):
    assert max(rebound(restitution, 0.005, speed, gap) for speed in (0.5, 3.0) for gap in (1e-4, 3e-3)) < 1.02


def test_without_restitution_the_contact_is_the_default_one():
    """solref (0.02, 1) in MuJoCo's other format: stiffness 1 / 0.02^2, damping 2 / 0.02."""
    assert solref(0.0) == [-2500.0, -100.0]


def test_a_ground_that_rebounds_wholly_rebounds_by_half_and_keeps_its_friction():
    """The robot's own coefficient is 0 and a contact has the mean; Coulomb stops 1 m/s after 0.13 s and 0.064 m."""
    ground = TerrainConfig(friction=0.8, restitution=1.0)
    assert rebound(None, 0.001, ground=ground) == pytest.approx(0.5, abs=0.1)
    spec = mujoco.MjSpec()
    ground.add_to(spec)
    block = spec.worldbody.add_body(pos=[0, 0, 0.1])
    block.add_freejoint()
    block.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.1, 0.1, 0.1], mass=4.0, contype=0, conaffinity=1)
    spec.option.timestep, spec.option.integrator = 0.005, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=400)
    data.qvel[0] = 1.0
    start = data.qpos[0]
    mujoco.mj_step(model, data, nstep=40)
    assert abs(data.qvel[0]) < 0.1 and 0.05 < data.qpos[0] - start < 0.12


def test_the_ground_decides_whatever_the_file_says_of_its_feet(make_config, monkeypatch):
    run = make_config("obstacles=none", "terrain.friction=0.3")
    plain = run.env.robot.spec

    def insisting(robot):
        spec = plain()
        for geom in spec.geoms:
            geom.priority, geom.margin, geom.friction = 2, 0.05, (0.9, 0.02, 0.01)
        return spec

    monkeypatch.setattr(type(run.env.robot), "spec", insisting)
    model = world_of(run).model
    data = mujoco.MjData(model)
    data.qpos[2] = 0.25
    mujoco.mj_forward(model, data)
    assert data.ncon > 0 and (data.contact.dist <= 0.0).all()
    assert np.unique(data.contact.friction[:, 0]).tolist() == [0.3]
