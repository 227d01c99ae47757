"""Robots without legs: motion by closed forms, touches by brute force, links and rays by MuJoCo, the gait by itself."""

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

from omniperception import build, config
from omniperception.build import load_policy
from omniperception.env.env import OmniEnv
from omniperception.scene.build import OBSTACLE_FORCE
from omniperception.sim.response import FILE, GaitResponse, NoResponse
from omnirobot.common.errors import ConfigError

GAIT = Path(config.SHIPPED_RUNS) / "gait"
NAVIGATE = (
    "experiment=navigate",
    "randomization=none",
    "sim.spread=0",
    "num_envs=3",
    "obstacles=none",
    "sim.num_threads=1",
)
FAST = ("sim.acceleration=[1e6,1e6]",)


def steady(folder: Path, gain=1.0, lag=0.1, delay=0.0, offset=0.0, noise=0.0, falls=()) -> Path:
    """A run directory whose gait answers alike in all axes, without chance."""
    given = json.loads((GAIT / FILE).read_text())
    axis = {"gain": [gain, 0], "lag_s": [lag, 0], "delay_s": [delay, 0], "offset": [offset, 0], "acceleration": 9.0}
    axis |= {"noise": noise, "noise_s": 0.5}
    own = {"version": 1, "axes": dict.fromkeys(("x", "y", "yaw"), axis), "height_sd": 0, "tilt_sd": [0, 0]}
    given["conditions"] = {"ideal": own | {"falls": [list(row) for row in falls]}}
    given |= {"radius": 0.2, "half_length": 0.2}
    folder.mkdir(parents=True, exist_ok=True)
    (folder / FILE).write_text(json.dumps(given))
    shutil.copy(GAIT / "config.yaml", folder)
    return folder


def planar(folder: Path, *overrides: str) -> OmniEnv:
    given = (*NAVIGATE, "sim.under=ideal", f"sim.response={folder}", *overrides)
    return OmniEnv(build.assemble(config.compose(given)).env)


def actions(env: OmniEnv, *velocity: float) -> torch.Tensor:
    return torch.tensor(velocity).expand(env.num_envs, 3).contiguous()


class TestMotion:
    @pytest.mark.parametrize("lag", [0.05, 0.3])
    @pytest.mark.parametrize("delay", [0.0, 0.05, 0.08])
    def test_velocity_follows_with_a_lag_after_a_dead_time(self, tmp_path, lag, delay):
        env = planar(steady(tmp_path, gain=0.8, lag=lag, delay=delay, offset=0.1), *FAST)
        for step in range(1, 8):
            env.step(actions(env, 1.0, -0.5, 0.4))
            time = 0.1 * step
            share = 1 - math.exp(-(time - delay) / lag)
            drift = 0.1 * (1 - math.exp(-time / lag))  # the offset does not wait
            velocity = env.sim._velocity[0]
            expected = [0.8 * v * share + drift for v in (1.0, -0.5, 0.4)]
            assert velocity.tolist() == pytest.approx(expected, abs=0.02 if delay else 1e-5)

    def test_the_asked_velocity_changes_no_faster_than_allowed(self, tmp_path):
        env = planar(steady(tmp_path, lag=1e-4), "sim.acceleration=[2,1]")
        env.step(actions(env, 0.6, 0.8, -1.0))
        assert env.state.asked[1].tolist() == pytest.approx([0.12, 0.16, -0.1], abs=1e-5)
        env.step(actions(env, 0.6, 0.8, -1.0))
        assert env.state.last_asked[1].tolist() == pytest.approx([0.12, 0.16], abs=1e-5)  # in the step that ended

    def test_position_is_the_integral_in_the_robots_own_heading(self, tmp_path):
        env = planar(steady(tmp_path, lag=1e-4), *FAST, "sim.timestep=0.005", "sim.decimation=20")
        for _ in range(10):
            env.step(actions(env, 1.0, 0.0, 1.0))
        x, y, yaw = env.sim._place[0].tolist()
        assert yaw == pytest.approx(1.0, abs=1e-4)
        assert (x, y) == pytest.approx((math.sin(1.0), 1.0 - math.cos(1.0)), abs=1e-3)  # a circle of radius 1 m

    def test_more_than_the_gait_can_is_not_asked_for(self, tmp_path):
        env = planar(steady(tmp_path, lag=1e-4), *FAST)
        env.step(actions(env, 9.0, -9.0, 9.0))
        assert env.state.asked[0].tolist() == pytest.approx([2.0, -1.5, 1.5])

    def test_the_wandering_error_is_as_large_and_lasting_as_given(self, tmp_path):
        env = planar(steady(tmp_path, lag=1e-4, noise=0.2), "num_envs=400", "terminations.episode_length_s=100")
        errors = []
        for _ in range(40):
            env.step(actions(env, 0.0, 0.0, 0.0))
            errors.append(env.sim._velocity[:, :2].clone())
        errors = torch.stack(errors[10:])
        assert float(errors.std()) == pytest.approx(0.2, rel=0.1)
        shift = 5  # 0.5 s: a fraction 1/e is left
        kept = float((errors[shift:] * errors[:-shift]).mean() / errors.square().mean())
        assert kept == pytest.approx(math.exp(-1), abs=0.1)

    def test_pushes_change_the_velocity_and_fade_with_the_lag(self, tmp_path):
        env = planar(steady(tmp_path, lag=0.2))
        env.sim.qvel[:, 1] += 1.0
        env.step(actions(env, 0.0, 0.0, 0.0))
        assert float(env.sim._velocity[0, 1]) == pytest.approx(math.exp(-0.5), abs=1e-4)

    def test_an_action_that_is_not_finite_is_a_failure_and_the_last_one_goes_on(self, tmp_path):
        env = planar(steady(tmp_path, lag=1e-4), *FAST)
        env.step(actions(env, 1.0, 0.0, 0.0))
        given = actions(env, 1.0, 0.0, 0.0)
        given[1, 0] = torch.nan
        env.step(given)
        assert env.outcomes["diverged"].tolist() == [False, True, False]

    def test_jumps_throw_robots_over_as_often_as_measured(self, tmp_path):
        falls = [(0.0, 1.0, 100, 0), (1.0, 5.0, 100, 30)]
        env = planar(steady(tmp_path, falls=falls), "num_envs=600", "sim.acceleration=[6,8]")
        env.step(actions(env, 0.9, 0.0, 0.0))
        assert not env.outcomes["fall"].any()
        env.step(actions(env, -1.0, 0.0, 0.0))
        share = env.outcomes["fall"].float().mean()
        assert float(share) == pytest.approx(0.3, abs=0.06)

    def test_it_goes_on_from_its_state(self, tmp_path):
        overrides = ("num_envs=5", "obstacles=crowd", "randomization=robot", "sim.spread=1")
        runs = [planar(steady(tmp_path, noise=0.2), *overrides) for _ in range(2)]
        for _ in range(7):
            runs[0].step(torch.randn(5, 3))
        runs[1].load_state_dict(runs[0].state_dict())
        for _ in range(12):
            given = torch.randn(5, 3)
            rng = torch.get_rng_state()
            one = runs[0].step(given)
            torch.set_rng_state(rng)
            other = runs[1].step(given)
            assert torch.equal(one[1], other[1]) and torch.equal(one[2], other[2])
            assert torch.equal(one[0]["truth"], other[0]["truth"])

    def test_resets_of_some_change_nothing_for_others(self, tmp_path):
        runs = [planar(steady(tmp_path, noise=0.2), "num_envs=4", "obstacles=crowd", "sim.spread=1") for _ in range(2)]
        given = torch.randn(10, 4, 3)
        for k, action in enumerate(given):
            for env in runs:
                env.step(action)
            if k == 4:
                runs[1]._reset(torch.tensor([2]))
        for name in ("qpos", "qvel", "asked"):
            one, other = (getattr(env.sim, name) for env in runs)
            assert torch.equal(one[[0, 1, 3]], other[[0, 1, 3]])
        assert not torch.equal(runs[0].sim.qpos[2], runs[1].sim.qpos[2])


def brute_gap(half_length: float, place, yaw, outline) -> float:
    """Distance of many points on the line from the outline, by many points on its edge."""
    line = np.stack((np.linspace(-half_length, half_length, 201), np.zeros(201)), 1)
    a, b = outline
    if b < 0:
        return max(float(np.linalg.norm(line - place, axis=1).min()) - a, 0.0)
    c, s = math.cos(yaw), math.sin(yaw)
    own = (line - place) @ np.array([[c, -s], [s, c]])
    outside = np.maximum(np.abs(own) - (a, b), 0.0)
    return float(np.linalg.norm(outside, axis=1).min())


class TestTouches:
    def test_outlines_are_touched_where_they_are_nearer_than_the_radius(self, tmp_path):
        """Cylinders and boxes of any kind at random, none of which moves."""
        env = planar(steady(tmp_path), "num_envs=64", "obstacles=all", "terminations.on_collision=false")
        env.obstacles.level = 1.0
        env.reset()
        agree = touches = 0
        for _ in range(20):
            env.step(actions(env, 0.3, 0.0, 0.0))
            field, sim = env.obstacles, env.sim
            radius = sim._radius[0].item()
            for k in range(env.num_envs):
                x, y, yaw = sim._places[k, -1].tolist()
                gaps = [
                    brute_gap(
                        0.2,
                        np.array(
                            [
                                math.cos(yaw) * (p[0] - x) + math.sin(yaw) * (p[1] - y),
                                -math.sin(yaw) * (p[0] - x) + math.cos(yaw) * (p[1] - y),
                            ]
                        ),
                        float(field.yaw[k, o]) - yaw,
                        field.outline[k, o].tolist(),
                    )
                    for o, p in enumerate(field.pos_w[k].tolist())
                    if field.active[k, o] and p[2] - float(field.half_height[k, o]) < env.world.obstacles.headroom
                ]
                assert min(gaps) > radius - 0.011  # it has been pushed out
                touches += bool(sim._touched[k])
                agree += (min(gaps) < radius + 1e-3) <= bool(sim._touched[k])
        assert touches > 5 and agree == 20 * env.num_envs

    @pytest.mark.parametrize("heading_deg", [0.0, 40.0])
    def test_a_wall_holds_a_robot_up_and_takes_its_momentum(self, tmp_path, heading_deg):
        size = "[[0.1, 0.1], [4.0, 4.0], [0.5, 0.5]]"
        wall = "obstacles.groups.wall={kind: box, count: 1, size: " + size + ", poses: [[1.5, 0.0, 0.0]]}"
        spawn = f"commands.spawn.yaw_deg=[{heading_deg},{heading_deg}]"
        env = planar(
            steady(tmp_path, lag=1e-4),
            f"+{wall}",
            spawn,
            "terminations.on_collision=false",
            "+obstacles.area=[-5,5,-5,5]",
        )
        angle = math.radians(heading_deg)
        impulse = 0.0
        for _ in range(20):
            env.step(actions(env, 1.0, 0.0, 0.0))
            impulse = max(impulse, float(env.sim.contact_impulse(OBSTACLE_FORCE)[0]))
        reach = 0.2 + 0.2 * math.cos(angle)
        assert float(env.sim._place[0, 0]) == pytest.approx(1.4 - reach, abs=5e-3)
        assert env.contacts.all()
        assert impulse >= 0.9 * env.sim._mass * math.cos(angle)


class TestSeen:
    def test_links_are_where_mujoco_has_them(self, tmp_path):
        env = planar(steady(tmp_path), "sim.spread=1")
        for _ in range(9):
            env.step(actions(env, 1.0, 0.0, 0.3))
        model, data = env.world.model, mujoco.MjData(env.world.model)
        bodies = tuple(range(1, model.nbody))
        pos, quat = env.sim.body_poses(bodies)
        data.qpos[:] = env.sim.qpos[1].numpy()
        mujoco.mj_kinematics(model, data)
        assert pos[1].numpy() == pytest.approx(data.xpos[list(bodies)], abs=1e-5)
        same = np.abs((quat[1].numpy() * data.xquat[list(bodies)]).sum(1))
        assert same == pytest.approx(np.ones(len(bodies)), abs=1e-5)
        geoms = tuple(range(model.ngeom))
        assert env.sim.geom_poses(geoms)[0][1].numpy() == pytest.approx(data.geom_xpos, abs=1e-5)

    def test_the_legs_go_through_the_cycle_of_the_nearest_command(self, tmp_path):
        env = planar(steady(tmp_path, lag=1e-4))
        seen = []
        for _ in range(8):
            env.step(actions(env, 1.0, 0.0, 0.0))
            seen.append(env.sim.qpos[0, 7:].clone())
        response = GaitResponse.load(tmp_path)
        ahead = torch.tensor(next(c.joints for c in response.cycles if list(c.command) == [1.0, 0.0, 0.0]))
        away = [(ahead - pose).abs().amax(1).min() for pose in seen[2:]]
        assert max(away) < 1e-5 and (seen[-1] - seen[-2]).abs().max() > 0.05

    def test_rays_are_those_of_mujoco_in_the_same_scene(self, tmp_path):
        """Base, joints and obstacles put where they are without legs."""
        lidar = ("lidar=mid360", "lidar.num_rays=500", "perception=polar_rings", "perception.motion_weight=1")
        lidar += (
            "perception.avoidance_weight=0",
            "obstacles=static",
            "obstacles.curriculum=null",
            "observations=perceive",
        )
        without = planar(steady(tmp_path), *lidar)
        for _ in range(5):
            without.step(actions(without, 0.5, 0.0, 0.2))
        given = ("experiment=avoid", "randomization=none", "terrain=flat", "num_envs=3", "init=null", *lidar[:2])
        full = OmniEnv(build.assemble(config.compose([*given, "obstacles=static", "obstacles.curriculum=null"])).env)
        full.sim.qpos.copy_(without.sim.qpos)
        full.sim.mocap_pos.copy_(without.sim.mocap_pos)
        full.sim.mocap_quat.copy_(without.sim.mocap_quat)
        full._resize(without.obstacles, torch.arange(3))
        ranges = []
        for env in (without, full):
            env.sensing.place_bodies()
            env.sensing.lidar.reset()
            env.sensing.take_frame(0.0, env.state.kinematics.base_quat_w, env.timer)
            ranges.append(env.sensing.lidar.frame.ranges.clone())
        assert torch.isfinite(ranges[0]).any() and torch.allclose(*ranges, atol=2e-4)


def test_a_robot_is_where_the_gait_would_be():
    """Both follow the same velocities for 2 s: the means of the places agree within their spread between robots."""
    given = ["condition=robot", "num_envs=96", "sim.num_threads=2", "seed=3"]
    run = build.load_run(GAIT, [*given, "scenario=walk", "terrain=flat"])
    trained = load_policy(replace(run, env=replace(run.env, rewards=replace(run.env.rewards, terms={}))), GAIT)
    walking, policy = trained.env, trained.policy
    gliding = OmniEnv(
        build.assemble(config.compose(["experiment=navigate", "obstacles=none", "sim.under=robot", *given])).env
    )
    wanted = torch.rand(96, 3) * torch.tensor([1.5, 1.2, 1.0]) - torch.tensor([0.4, 0.6, 0.5])
    asked, ends = torch.zeros(96, 3), []
    begun = walking.state.kinematics
    pose = begun.base_pos_w[:, :2].clone(), begun.yaw.clone()
    fell = torch.zeros(96, dtype=torch.bool)
    with torch.no_grad():
        for _ in range(100):
            change = (wanted - asked)[:, :2]
            asked[:, :2] += change * (0.12 / change.norm(dim=1, keepdim=True).clamp(min=0.12))
            asked[:, 2] += (wanted - asked)[:, 2].clamp(-0.16, 0.16)
            observations = walking.get_observations().clone(recurse=False)
            observations["command"] = asked.clone()
            walking.step(policy(observations))
            fell |= walking.done
    for _ in range(20):
        gliding.step(wanted)
    from omniperception.common.rotations import rotate_yaw

    k = walking.state.kinematics
    ends.append(rotate_yaw(-pose[1], k.base_pos_w[:, :2] - pose[0]))
    ends.append(gliding.state.kinematics.base_pos_w[:, :2])
    error = (ends[1] - ends[0])[~fell]
    assert len(error) > 80
    spread = 0.25  # m: of places after 2 s between robots that are asked for the same
    assert error.mean(0).abs().max() < 0.1 and error.std(0).max() < 2 * spread


class TestBadInput:
    @pytest.mark.parametrize(
        ("overrides", "said"),
        [
            (
                ("rewards=default",),
                "joint_limit_violation.* read joints, feet or torques, and sim=planar has none",
            ),
            (("observations=gait",), "joint_pos_offset.*use rewards=navigate observations=navigate, or sim=mujoco"),
            (("stepping={lift: 1.0, rest_s: 1.0}",), "stepping moves joints.*use stepping=null"),
            (("sim.response=nowhere",), "sim.response=nowhere does not exist"),
            (("robot=anymal",), "is the gait of go2.xml, this robot is .*sim.response="),
        ],
    )
    def test_what_has_no_legs_is_asked_for_none(self, overrides, said):
        with pytest.raises((ConfigError, ValueError), match=said):
            build.assemble(config.compose(["experiment=navigate", *overrides]))

    @pytest.mark.parametrize(
        ("overrides", "said"),
        [
            (("sim.under=faults",), "no response measured under condition=faults .*ideal.*sim.under"),
            (("terrain=rough",), "flat ground alone; use terrain=flat"),
            (("sim.response=pretrained/pd_risknet_taught",), "has no measured response of its gait .*measure it: "),
        ],
    )
    def test_a_response_that_does_not_fit_is_refused(self, overrides, said):
        run = build.assemble(config.compose(["experiment=navigate", "obstacles=none", "num_envs=2", *overrides]))
        with pytest.raises((ConfigError, ValueError, NoResponse), match=said):
            build.build_runner(run, None)
