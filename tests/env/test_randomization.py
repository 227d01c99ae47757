"""The paper's thirteen rows: what each changes, within which range, and that nothing else is changed."""

from dataclasses import fields, replace

import mujoco
import pytest
import torch

from omnilidar import DEVICES, AngularJitter, DistanceNoise, GaussianNoise, MaskNoise
from omniperception.env.env import OmniEnv
from omniperception.env.mdp.randomization import RandomizationConfig
from omniperception.env.mirror import Mirror
from omniperception.scene.terrain import ground_solrefs

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
    rows = {f.name: getattr(config, f.name) for f in fields(RandomizationConfig)}
    assert {name for name, value in rows.items() if value} == {
        *PAPER,
        "lidar_mask",
        "lidar_distance",
        "payload_position",
    }


def test_none_changes_no_model_field(make_env):
    env = make_env()
    env.step(torch.zeros(4, 12))
    assert all(env.sim.batch.expanded(name) is None for name in MODEL_FIELDS)
    assert env.randomizer.joint_offset is None and env.randomizer.delay is None
    assert env.state.measured is env.state.kinematics
    assert env.pushes is None and env.sensing.fresh.all()
    assert set(env.random.state_dict()["branches"]) == {"randomization"}
    assert env.sensing.frame.ranges is env.sensing.frame.true_ranges


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
    share = (model.body_mass[body] / (model.body_mass[body] + payload))[:, None]
    expected = share * torch.tensor(model.body_ipos[body]) + (1 - share) * torch.tensor([0.0, 0.0, 0.1])
    torch.testing.assert_close(env.sim.model_field("body_ipos")[:, body], expected, atol=1e-8, rtol=0)


@pytest.mark.parametrize(("axis", "bound"), [(0, 0.1), (1, 0.15), (2, 0.2)])
def test_centre_of_mass(one_row, axis, bound):
    env = one_row(f"com_{'xyz'[axis]}", -bound, bound)
    body, model = env.world.base_body, env.world.model
    shift = env.sim.model_field("body_ipos")[:, body] - torch.tensor(model.body_ipos[body])
    assert_fills(shift[:, axis], -bound, bound)
    assert shift[:, [i for i in range(3) if i != axis]].abs().max() < 1e-12


def test_ground_friction(one_row):
    env = one_row("ground_friction", 0.4, 1.0)
    assert [name for name in MODEL_FIELDS if env.sim.batch.expanded(name) is not None] == ["geom_friction"]
    ground = env.world.model.geom("ground").id
    friction, nominal = env.sim.model_field("geom_friction"), torch.tensor(env.world.model.geom_friction)
    assert_fills(friction[:, ground, 0], 0.4, 1.0)
    others = [i for i in range(len(nominal)) if i != ground]
    assert (friction[:, others] == nominal[others]).all()


def test_ground_restitution(one_row):
    """Stiffness stays; damping falls from critical (e = 0) to that of a contact with e = 0.5 (ground 1, robot 0)."""
    env, half = one_row("ground_restitution", 0, 1), one_row("ground_restitution", 0.5, 0.5, num_envs=1)
    solref, of_half = (
        each.sim.model_field("geom_solref")[:, env.world.model.geom("ground").id] for each in (env, half)
    )
    assert (solref[:, 0] == -2500.0).all()
    # -ln(e) / hypot(pi, ln(e)): 0.2154537 of e = 0.5 and 0.4037127 of e = 0.25
    assert -100.0 <= solref[:, 1].min() < -80 and -23 < solref[:, 1].max() <= -100 * 0.2154537
    assert of_half[0, 1].item() == pytest.approx(-100 * 0.4037127, rel=1e-5)


@pytest.mark.parametrize("restitution", [0.0, 0.5, 1.0])
def test_restitution_leaves_the_friction(restitution):
    """A block at 1 m/s is stopped by a friction of 0.8 after 0.13 s, whatever the ground's restitution."""
    stiffness, damping = ground_solrefs(torch.tensor(restitution, dtype=torch.float64)).tolist()
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep="0.005" integrator="implicitfast"/><worldbody>
        <geom type="plane" size="9 9 1" friction="0.8" solref="{stiffness} {damping}" priority="1"/>
        <body pos="0 0 0.1"><freejoint/><geom type="box" size="0.1 0.1 0.1" mass="4" friction="0.8"/></body>
        </worldbody></mujoco>"""
    )
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 400)
    data.qvel[0] = 1.0
    mujoco.mj_step(model, data, 40)
    assert abs(data.qvel[0]) < 0.1 and 0.05 < data.qpos[0] < 0.12  # by Coulomb's law 0.064 m


def test_no_restitution_throws_a_standing_robot(one_row):
    env = one_row("ground_restitution", 0.0, 1.0, num_envs=8)
    env.sim.model_field("geom_solref")[:, env.world.model.geom("ground").id, 1] = torch.linspace(
        -100.0, 0.0, 8
    ).double()
    for _ in range(100):
        env.step(torch.zeros(8, 12))
        assert env.sim.qpos[:, 2].max() < 0.34
    assert (env.episode_length_buf == 100).all()


def test_motor_strength_scales_the_torque_and_not_its_limit(one_row):
    env, nominal = (one_row("motor_strength", *bounds) for bounds in ((0.8, 1.2), (1, 1)))
    for each in (env, nominal):
        each.sim.qpos[:, 2] = 2.0
        each.sim.qvel[:] = 0.0
        each.sim.joint_torque()
    ratio = []
    for action in (0.4, 100.0):
        torques = []
        for each in (env, nominal):
            each.sim.step((each.state.default_joint_pos + 0.25 * action).expand(N, -1))
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


class TestLatency:
    def test_the_actor_sees_the_state_of_that_many_physics_steps_ago(self, one_row):
        env = one_row("latency_s", 0.005, 0.045, num_envs=64)
        generator = torch.Generator().manual_seed(0)
        positions, velocities = [], []
        for _ in range(6):
            env.step(torch.randn(64, 12, generator=generator))
            assert (env.episode_length_buf > 0).all()
            qpos, qvel = env.sim.recorded_states()  # after each physics step: tests/sim/test_simulators.py
            positions += qpos.float().unbind(1)
            velocities += qvel.float().unbind(1)
        assert set(env.randomizer.delay.tolist()) == set(range(1, 10))
        for i, delay in enumerate(env.randomizer.delay.tolist()):
            assert torch.equal(env.state.measured.joint_pos[i], positions[-1 - delay][i, 7:])
            assert torch.equal(env.state.measured.joint_vel[i], velocities[-1 - delay][i, 6:])
            assert not torch.equal(env.state.measured.joint_pos[i], env.state.kinematics.joint_pos[i])

    @pytest.mark.parametrize("latency", [0.0025, 0.0075, 0.0125, 0.0175])
    def test_a_fixed_latency_of_half_a_physics_step_more_is_kept(self, one_row, latency):
        env = one_row("latency_s", latency, latency, num_envs=2)
        for _ in range(3):
            env.step(torch.ones(2, 12))
        delay = env.randomizer.delay
        assert (delay <= env.randomizer.max_delay).all() and (delay * 0.005 - latency).abs().max() < 0.0026
        differ = (env.state.measured.joint_pos != env.state.kinematics.joint_pos).any(1)
        assert torch.equal(differ, delay > 0)

    def test_observations_are_late_privileged_ones_are_not_and_a_reset_has_no_past(self, one_row):
        env = one_row("latency_s", 0.045, 0.045, num_envs=3)
        measured, exact = (lambda: env.state.measured.joint_pos), (lambda: env.state.kinematics.joint_pos)
        for step in range(6):
            if step == 5:
                env.sim.qpos[1, 2] = 0.05
            observations = env.step(torch.ones(3, 12))[0]
        default = env.state.default_joint_pos
        newest = observations["proprioception"].unflatten(1, (10, 33))[:, -1, :12]
        torch.testing.assert_close(newest, measured() - default)
        torch.testing.assert_close(observations["privileged"][:, :12], exact() - default)
        assert torch.equal(measured()[1], default) and (measured()[0] != default).any()


def test_a_reset_draws_for_that_environment_only(make_env):
    """It starts in the default pose at rest: computing the engine's constants for new masses leaves the state alone."""
    env = make_env("randomization=paper", "obstacles=none", blind=True)
    default = env.state.default_joint_pos.double().expand(4, -1)
    assert torch.equal(env.sim.qpos[:, 7:], default) and (env.sim.qvel == 0).all()
    assert all(env.sim.batch.expanded(name) is not None for name in MODEL_FIELDS)
    before = {name: env.sim.model_field(name).clone() for name in MODEL_FIELDS}
    env.sim.qpos[2, 2] = 0.05
    env.step(torch.zeros(4, 12))
    for name in MODEL_FIELDS:
        now = env.sim.model_field(name)
        assert torch.equal(now[[0, 1, 3]], before[name][[0, 1, 3]]), name
        assert not torch.equal(now[2], before[name][2]), name


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("added_mass=[5,-1]", r"randomization\.added_mass=\[5, -1\]"),
        ("added_mass=[nan,1]", r"added_mass=\[.nan, 1\] must be finite"),
        ("com_x=[0,inf]", r"com_x=\[0, .inf\] must be finite"),
        (
            "ground_friction=[-0.1,1]",
            r"randomization\.ground_friction=\[-0\.1, 1\] must be .* with 0 <= low",
        ),
        ("ground_restitution=[0,2]", r"ground_restitution=\[0.0, 2.0\] must not exceed 1"),
        ("latency_s=[-0.005,0.045]", r"randomization\.latency_s"),
        ("added_mass=[-7,5]", "a base of 6.921 kg with -1.079 kg"),
    ],
)
def test_physics_that_cannot_be_is_refused(make_env, row, message):
    with pytest.raises(ValueError, match=message):
        make_env("obstacles=none", "randomization=paper", f"randomization.{row}", blind=True)


@pytest.mark.parametrize(
    ("lidar", "sigma", "angle"), [("mid360", 0.02, 0.15), ("avia", 0.02, 0.05), ("vlp16", 0.03, None)]
)
def test_the_devices_own_noise_reaches_the_lidar(make_config, lidar, sigma, angle):
    models = make_config("randomization=device", f"lidar={lidar}").env.lidar_noise
    assert models == (GaussianNoise(sigma), *([AngularJitter(angle)] if angle else []))


def test_measured_noise_reaches_the_lidar(make_config):
    noise = make_config("randomization=lidar_measured", "lidar=mid360").env.lidar_noise
    assert noise == DEVICES["mid360"].measured != ()


@pytest.mark.parametrize(
    ("randomization", "overrides", "message"),
    [
        ("device", ("lidar=custom",), r"randomization\.lidar_device needs a sensor whose maker states its noise"),
        ("lidar_measured", ("lidar=avia",), "needs a sensor of which there is a recording .*but lidar.device is avia"),
        ("lidar_measured", ("lidar=custom",), "but lidar.device is null; use randomization=device"),
        ("lidar_measured", ("lidar=mid360", "randomization.lidar_device=true"), "both true"),
        (
            "device",
            ("lidar=mid360", "randomization.lidar_gaussian={sigma: 0.05}"),
            r"lidar_gaussian are two .* \(GaussianNoise\)",
        ),
        (
            "device",
            ("lidar=mid360", "randomization.lidar_jitter={sigma_deg: 0.1}"),
            r"lidar_jitter are two .* \(AngularJitter\)",
        ),
    ],
)
def test_noise_without_a_source_or_with_two_is_refused(make_config, randomization, overrides, message):
    with pytest.raises(ValueError, match=message):
        make_config(f"randomization={randomization}", *overrides)


def test_the_critic_sees_what_was_drawn(make_env):
    """As the model that the physics has now tells, and mirrored as bodies are."""
    env = make_env("experiment=gait", "terrain=flat", "randomization=paper", num_envs=6)
    sim, model, body = env.sim, env.world.model, env.world.base_body
    seen = env.get_observations()["physics"].double()
    friction, restitution, strength, gravity, offset, late, masses, centre = seen.split([1, 1, 12, 3, 12, 1, 2, 3], 1)
    torch.testing.assert_close(friction[:, 0], sim.model_field("geom_friction")[:, model.geom("ground").id, 0])
    solrefs = sim.model_field("geom_solref")[:, model.geom("ground").id]
    torch.testing.assert_close(ground_solrefs(restitution[:, 0]), solrefs)
    torch.testing.assert_close(
        strength, sim.model_field("actuator_gainprm")[:, :, 0] / torch.tensor(model.actuator_gainprm[:, 0])
    )
    torch.testing.assert_close(gravity, sim.model_field("opt.gravity") - torch.tensor(model.opt.gravity))
    torch.testing.assert_close(offset.float(), env.randomizer.joint_offset)
    assert ((late[:, 0] / 0.005).round().long() == env.randomizer.delay).all()
    torch.testing.assert_close(masses.sum(1) + model.body_mass[body], sim.model_field("body_mass")[:, body])
    share = (masses[:, :1] + model.body_mass[body]) / sim.model_field("body_mass")[:, body, None]
    both = share * (torch.tensor(model.body_ipos[body]) + centre) + (1 - share) * torch.tensor([0.0, 0.0, 0.1])
    torch.testing.assert_close(sim.model_field("body_ipos")[:, body], both.double(), atol=1e-6, rtol=1e-6)

    image = Mirror(env)(env, env.get_observations().select("physics"), None)[0]["physics"][6:].double()
    joints = [3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8]
    sides = torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64)
    hips = torch.tensor([-1.0, 1.0, 1.0] * 4, dtype=torch.float64)
    mirrored = (friction, restitution, strength[:, joints], gravity * sides, offset[:, joints] * hips, late, masses)
    assert torch.equal(image, torch.cat((*mirrored, centre * sides), 1))


class TestCurriculum:
    """All rows grow together, from a robot without randomization to the whole ranges."""

    SHARE = "+randomization.curriculum={start: 0.0, max_velocity_error: 0.2, rise: 0.5}"

    def test_at_0_nothing_is_random(self, make_env):
        env = make_env("randomization=robot", self.SHARE, "obstacles=none", blind=True, num_envs=4)
        plain = make_env("obstacles=none", blind=True, num_envs=4)
        for _ in range(60):  # pushes come within 10 s, the first ones sooner
            env.step(torch.zeros(4, 12))
        for name in MODEL_FIELDS:
            drawn, nominal = env.sim.model_field(name), plain.sim.model_field(name)
            torch.testing.assert_close(drawn, nominal.expand_as(drawn), atol=1e-6, rtol=1e-6)
        assert not env.randomizer.joint_offset.any() and not env.randomizer.delay.any()
        for name in ("joint_pos", "joint_vel", "base_ang_vel_b", "base_quat_w", "base_lin_vel_b"):
            torch.testing.assert_close(
                getattr(env.state.measured, name), getattr(env.state.kinematics, name), atol=1e-6, rtol=1e-6
            )
        assert env.state.kinematics.base_lin_vel_w[:, :2].norm(dim=1).max() < 0.3

    @pytest.mark.parametrize(
        ("row", "neutral"), [("motor_strength", 1.0), ("ground_friction", 0.8), ("added_mass", 0.0)]
    )
    def test_half_way_ranges_are_half_as_wide_about_what_is_normal(self, make_env, row, neutral):
        low, high = PAPER[row]
        overrides = (f"+randomization.{row}=[{low},{high}]", self.SHARE.replace("randomization", "+randomization", 1))
        env = make_env(*overrides, "obstacles=none", blind=True, num_envs=N)
        env.difficulty.level = 0.5
        env.randomizer.reset(torch.arange(N))
        model = env.sim.world.model
        drawn = {
            "motor_strength": lambda: env.sim.model_field("actuator_gainprm")[:, 0, 0] / model.actuator_gainprm[0, 0],
            "ground_friction": lambda: env.sim.model_field("geom_friction")[:, model.geom("ground").id, 0],
            "added_mass": lambda: (
                env.sim.model_field("body_mass")[:, env.sim.world.base_body] - model.body_mass[env.sim.world.base_body]
            ),
        }[row]()
        assert_fills(drawn, neutral + 0.5 * (low - neutral), neutral + 0.5 * (high - neutral))

    def test_at_0_the_ground_rebounds_as_the_terrain_says(self, make_env):
        restitution = ("+randomization.ground_restitution=[0,1]", "terrain.restitution=0.4")
        share = self.SHARE.replace("randomization", "+randomization", 1)
        env = make_env(*restitution, share, "obstacles=none", blind=True, num_envs=4)
        ground = env.world.model.geom("ground").id
        drawn, nominal = env.sim.model_field("geom_solref")[:, ground], env.world.model.geom_solref[ground]
        torch.testing.assert_close(drawn, torch.tensor(nominal).expand(4, -1), atol=1e-4, rtol=1e-6)

    def test_at_full_level_it_is_over_from_the_first_step_on(self, make_env):
        rising = make_env("randomization=robot", self.SHARE, "obstacles=none", blind=True, num_envs=2).config
        env = OmniEnv(replace(rising, skip_curricula=True, log_interval=1))
        logs = [env.step(torch.zeros(2, 12))[3]["log"] for _ in range(3)]
        assert all(log["Metrics/randomization_level"] == log["Metrics/command_level"] == 1.0 for log in logs)

    def test_it_rises_while_robots_walk_well_and_lasts_in_a_checkpoint(self, make_env):
        env = make_env("randomization=robot", self.SHARE, "obstacles=none", blind=True, num_envs=2)
        env.difficulty.follow(0.3, 1.0)
        assert env.difficulty.level == 0.0
        env.difficulty.follow(0.1, 1.0)
        other = make_env("randomization=robot", self.SHARE, "obstacles=none", blind=True, num_envs=2)
        other.load_state_dict(env.state_dict())
        assert other.difficulty.level == env.difficulty.level == 0.5
        assert make_env("randomization=robot", "obstacles=none", blind=True, num_envs=2).difficulty.level == 1.0
