"""The paper's thirteen rows: each changes what it should, within its range, and nothing exists without it."""

from dataclasses import fields

import pytest
import torch

from omniperception.env.mdp.randomization import RandomizationConfig
from omniperception.lidar import AngularJitter, DistanceNoise, GaussianNoise, MaskNoise

N = 300
PAPER = {
    "added_mass": (-1.0, 5.0),
    "payload_mass": (-1.0, 3.0),
    "com_x": (-0.1, 0.1),
    "com_y": (-0.15, 0.15),
    "com_z": (-0.2, 0.2),
    "ground_friction": (0.4, 1.0),
    "ground_restitution": (0.0, 1.0),
    "motor_strength": (0.8, 1.2),
    "joint_offset": (-0.02, 0.02),
    "gravity_offset": (-1.0, 1.0),
    "latency_s": (0.005, 0.045),
}
"""Table 'Parameters and Ranges for Domain Randomization', without the two LiDAR rows."""
MODEL_FIELDS = (
    "body_mass",
    "body_ipos",
    "geom_friction",
    "geom_solref",
    "opt.gravity",
    "actuator_gainprm",
    "actuator_biasprm",
)


@pytest.fixture(scope="module")
def one_row(make_env):
    """An environment with a single row of the table."""

    def make(name, low, high, *overrides, num_envs=N):
        row = f"randomization.{name}=[{low},{high}]"
        return make_env(f"+{row}", "obstacles=none", *overrides, blind=True, num_envs=num_envs)

    return make


def assert_fills(values, low, high):
    """Within the range, and reaching close to both ends."""
    slack = 0.05 * (high - low)
    assert low - 1e-6 <= values.min() <= low + slack
    assert high - slack <= values.max() <= high + 1e-6


def test_the_papers_table(make_config):
    config = make_config("randomization=paper").env.randomization
    assert {name: getattr(config, name) for name in PAPER} == PAPER
    assert config.lidar_mask == MaskNoise(ratio=0.1, low=0.0, high=0.3)
    assert config.lidar_distance == DistanceNoise(ratio=0.1)
    own = {
        "lidar_device",
        "lidar_gaussian",
        "lidar_jitter",
        "lidar_dropout",
        "lidar_mixed",
    }  # of the device, not in the table
    rows = [f.name for f in fields(RandomizationConfig) if f.name not in {"payload_position", *own}]
    assert not any(getattr(config, name) for name in own)
    assert len(rows) == 13 and all(getattr(config, name) is not None for name in rows)


def test_none_changes_no_model_field(make_env):
    env = make_env()
    env.step(torch.zeros(4, 12))
    assert all(env.sim.batch.expanded(name) is None for name in MODEL_FIELDS)
    assert env.randomizer.joint_offset is None and env.randomizer.delay is None
    assert env.state.measured is env.state.kinematics
    assert env.sensing.frame.ranges is env.sensing.frame.true_ranges


def test_the_paper_changes_all_of_them(make_env):
    env = make_env("randomization=paper", blind=True)
    assert all(env.sim.batch.expanded(name) is not None for name in MODEL_FIELDS)


def test_only_the_rows_that_are_given_exist(one_row):
    env = one_row("ground_friction", 0.4, 1.0, num_envs=2)
    changed = [name for name in MODEL_FIELDS if env.sim.batch.expanded(name) is not None]
    assert changed == ["geom_friction"]


def test_masses(one_row):
    base = one_row("added_mass", -1, 5)
    body, nominal = base.world.base_body, base.world.model.body_mass
    assert_fills(base.sim.model_field("body_mass")[:, body] - nominal[body], -1, 5)
    others = [i for i in range(len(nominal)) if i != body]
    assert (base.sim.model_field("body_mass")[:, others] == torch.tensor(nominal[others])).all()
    centre = torch.tensor(base.world.model.body_ipos[body])  # added at the centre of mass: it stays
    torch.testing.assert_close(base.sim.model_field("body_ipos")[:, body], centre.expand(N, 3))


def test_a_payload_moves_the_centre_of_mass_towards_it(one_row):
    env = one_row("payload_mass", -1, 3)
    body, model = env.world.base_body, env.world.model
    payload = env.sim.model_field("body_mass")[:, body] - model.body_mass[body]
    assert_fills(payload, -1, 3)
    x, y, z = model.body_ipos[body]
    mass = model.body_mass[body]
    for i, extra in enumerate(payload[:5].tolist()):
        share = mass / (mass + extra)
        expected = [x * share, y * share, z * share + 0.1 * (1 - share)]
        assert env.sim.model_field("body_ipos")[i, body].tolist() == pytest.approx(expected, abs=1e-8)


@pytest.mark.parametrize(("axis", "bound"), [(0, 0.1), (1, 0.15), (2, 0.2)])
def test_centre_of_mass(one_row, axis, bound):
    env = one_row(f"com_{'xyz'[axis]}", -bound, bound)
    body, model = env.world.base_body, env.world.model
    shift = env.sim.model_field("body_ipos")[:, body] - torch.tensor(model.body_ipos[body])
    assert_fills(shift[:, axis], -bound, bound)
    others = [i for i in range(3) if i != axis]
    assert shift[:, others].abs().max() < 1e-12


def test_ground_friction(one_row):
    env = one_row("ground_friction", 0.4, 1.0)
    ground = env.world.model.geom("ground").id
    friction = env.sim.model_field("geom_friction")
    assert_fills(friction[:, ground, 0], 0.4, 1.0)
    untouched = torch.tensor(env.world.model.geom_friction)
    untouched_rows = [i for i in range(len(untouched)) if i != ground]
    assert (friction[:, untouched_rows] == untouched[untouched_rows]).all()


def test_ground_restitution(one_row):
    """Stiffness stays; damping falls from critical (e = 0) to none (e = 1)."""
    env = one_row("ground_restitution", 0, 1)
    solref = env.sim.model_field("geom_solref")[:, env.world.model.geom("ground").id]
    assert (solref[:, 0] == -2500.0).all()
    assert (solref[:, 1] >= -100.0).all() and (solref[:, 1] <= 0.0).all()
    assert solref[:, 1].min() < -50 and solref[:, 1].max() > -2
    half = one_row("ground_restitution", 0.5, 0.5, num_envs=1)  # -ln(0.5) / hypot(pi, ln(0.5)) = 0.2154537
    damping = half.sim.model_field("geom_solref")[0, half.world.model.geom("ground").id, 1]
    assert damping.item() == pytest.approx(-100 * 0.2154537, rel=1e-5)


@pytest.mark.parametrize("restitution", [0.0, 0.5, 0.9, 1.0])
def test_no_restitution_throws_a_standing_robot(one_row, restitution):
    env = one_row("ground_restitution", restitution, restitution, num_envs=2)
    for _ in range(100):
        env.step(torch.zeros(2, 12))
        assert env.sim.qpos[:, 2].max() < 0.34
    assert (env.episode_length_buf == 100).all()


def test_motor_strength_scales_the_torque_and_not_its_limit(one_row):
    env, nominal = (one_row("motor_strength", *bounds, num_envs=N) for bounds in ((0.8, 1.2), (1, 1)))
    for each in (env, nominal):
        each.sim.qpos[:, 2] = 2.0
        each.sim.qvel[:] = 0.0
        each.sim.joint_torque()
    ratio = []
    for action in (0.4 * torch.ones(N, 12), 100.0 * torch.ones(N, 12)):
        torques = []
        for each in (env, nominal):
            each.sim.step(each.state.default_joint_pos + 0.25 * action)
            torques.append(each.sim.joint_torque().clone())
        ratio.append(torques[0] / torques[1])
    assert_fills(ratio[0], 0.8, 1.2)
    torch.testing.assert_close(ratio[1], torch.ones(N, 12))
    assert (ratio[0].amax(1) - ratio[0].amin(1)).min() > 0.05  # each motor has its own


def test_joint_offset_shifts_the_targets(one_row):
    env = one_row("joint_offset", -0.02, 0.02)
    assert_fills(env.randomizer.joint_offset, -0.02, 0.02)
    env.step(torch.full((N, 12), 0.4))
    expected = env.state.default_joint_pos.double() + 0.1 + env.randomizer.joint_offset.double()
    ctrl = torch.from_numpy(env.sim.batch.bind("ctrl"))
    torch.testing.assert_close(ctrl, expected, atol=1e-6, rtol=0)


def test_gravity_offset(one_row):
    env = one_row("gravity_offset", -1, 1)
    offset = env.sim.model_field("opt.gravity") - torch.tensor([0, 0, -9.81], dtype=torch.float64)
    for axis in range(3):
        assert_fills(offset[:, axis], -1, 1)
    env.sim.qpos[:, 2] = 3.0
    env.sim.step(env.state.default_joint_pos.expand(N, -1))
    gravity = env.sim.model_field("opt.gravity")
    torch.testing.assert_close(env.sim.qvel[:, :3], 0.005 * gravity, atol=1e-6, rtol=0)


class TestLatency:
    def test_delays_are_one_to_nine_steps(self, one_row):
        delay = one_row("latency_s", 0.005, 0.045).randomizer.delay
        assert sorted(set(delay.tolist())) == list(range(1, 10))

    def test_the_actor_sees_the_state_of_that_many_physics_steps_ago(self, one_row):
        env = one_row("latency_s", 0.005, 0.045, num_envs=64)
        history = [env.sim.qpos.float()]
        physics_step = env.sim.step

        def recorded(target, num_steps, mocap_path):
            for _ in range(num_steps):
                physics_step(target)
                history.append(env.sim.qpos.float())
            env.sim._records["qpos"] = torch.stack(history[-num_steps:], 1).double().numpy()
            env.sim._records["qvel"] = env.sim.qvel[:, None].repeat(1, num_steps, 1).numpy()

        env.sim.step = recorded
        generator = torch.Generator().manual_seed(0)
        for _ in range(6):
            env.step(torch.randn(64, 12, generator=generator))
            assert (env.episode_length_buf > 0).all()
        for i, delay in enumerate(env.randomizer.delay.tolist()):
            assert torch.equal(env.state.measured.joint_pos[i], history[-1 - delay][i, 7:])
            assert not torch.equal(env.state.measured.joint_pos[i], env.state.kinematics.joint_pos[i])

    def test_observations_are_late_and_privileged_ones_are_not(self, one_row):
        env = one_row("latency_s", 0.03, 0.03, num_envs=3)
        for _ in range(4):
            observations = env.step(torch.ones(3, 12))[0]
        newest = observations["proprioception"].unflatten(1, (10, 33))[:, -1, :12]
        torch.testing.assert_close(newest, env.state.measured.joint_pos - env.state.default_joint_pos)
        torch.testing.assert_close(
            observations["privileged"][:, :12], env.state.kinematics.joint_pos - env.state.default_joint_pos
        )

    def test_a_reset_has_no_past(self, one_row):
        env = one_row("latency_s", 0.045, 0.045, num_envs=3)
        for _ in range(5):
            env.step(torch.ones(3, 12))
        env.sim.qpos[1, 2] = 0.05
        env.step(torch.ones(3, 12))
        assert torch.equal(env.state.measured.joint_pos[1], env.state.default_joint_pos)
        assert (env.state.measured.joint_pos[0] != env.state.default_joint_pos).any()


def test_a_reset_draws_for_that_environment_only(make_env):
    env = make_env("randomization=paper", "obstacles=none", blind=True)
    before = {name: env.sim.model_field(name).clone() for name in MODEL_FIELDS}
    env.sim.qpos[2, 2] = 0.05
    env.step(torch.zeros(4, 12))
    for name in MODEL_FIELDS:
        now = env.sim.model_field(name)
        assert torch.equal(now[[0, 1, 3]], before[name][[0, 1, 3]]), name
        assert not torch.equal(now[2], before[name][2]), name


def test_a_reset_starts_in_the_default_pose_at_rest(make_env):
    """Recomputing the engine's constants for new masses must not disturb the state."""
    env = make_env("randomization=paper", "obstacles=none", blind=True, num_envs=20)
    default = env.state.default_joint_pos.double().expand(20, -1)
    assert torch.equal(env.sim.qpos[:, 7:], default) and (env.sim.qvel == 0).all()


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("added_mass=[5,-1]", r"randomization\.added_mass=\[5, -1\]"),
        ("ground_friction=[-0.1,1]", r"randomization\.ground_friction=\[-0\.1, 1\.0\] must not be negative"),
        ("latency_s=[-0.005,0.045]", r"randomization\.latency_s"),
    ],
)
def test_wrong_ranges_are_refused(make_config, row, message):
    with pytest.raises(ValueError, match=message):
        make_config(f"+randomization.{row}")


@pytest.mark.parametrize(
    ("lidar", "sigma", "angle"), [("mid360", 0.02, 0.15), ("avia", 0.02, 0.05), ("vlp16", 0.03, None)]
)
def test_the_devices_own_noise_reaches_the_lidar(make_config, lidar, sigma, angle):
    models = make_config("randomization=device", f"lidar={lidar}").env.lidar_noise
    assert models == (GaussianNoise(sigma), *([AngularJitter(angle)] if angle else []))


def test_noise_of_a_sensor_without_a_maker_is_refused(make_config):
    with pytest.raises(ValueError, match=r"randomization\.lidar_device needs a sensor whose maker states its noise"):
        make_config("randomization=device", "lidar=custom")
