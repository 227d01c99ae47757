"""An exported policy drives MuJoCo: the actions are torch's, and so is what becomes of the robots."""

import functools
import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch
import yaml

from omniperception import build, config
from omniperception.avoidance.velocity import LAST_ASKED
from omniperception.build import build_runner, load_policy
from omniperception.config import ConfigError
from omniperception.deploy import export as export_module
from omniperception.deploy.export import describe, export
from omniperception.env.env import OmniEnv
from omniperception.evaluation.trials.episodes import run_episodes
from omniperception.learning import CheckpointError
from omniperception.learning.checkpoint import checkpoint_path, load_checkpoint, save_checkpoint

pytest.importorskip("onnxruntime", reason="extra deploy")
pytest.importorskip("onnx", reason="extra export")

from omniperception.deploy.deploy_yaml import deploy_yaml
from omniperception.evaluation.ablation import VARIANTS, overrides_of
from omniperception.evaluation.suite import Evaluation, World, evaluate
from omniperception.evaluation.trials.exported import ExportedPolicies, raw_points, record, robot_states
from omnirobot.runtime import DeployError, Description, ExportedPolicy, RobotState
from omnirobot.runtime.description import Term

sys.path.insert(0, str(Path(__file__).parents[1]))
from own_robots import BIPED, BIPED_PRESET, write_preset

ROOT = Path(__file__).resolve().parents[2]
SMALL = ("num_envs=2", "ppo.hidden_dims=[32,16]", "seed=3")
RECIPES = {
    "none": ("experiment=walk",),
    "fps_mlp": ("~experiment", "perception=fps_mlp", "perception.sampler.num_points=64", "observations=paper"),
    "fps_gru": ("~experiment", "perception=fps_gru", "perception.sampler.num_points=64"),
    "direct_mlp": ("~experiment", "perception=direct_mlp", "perception.history=3"),
    "pd_risknet": ("~experiment", "perception=pd_risknet", "obstacles=static"),
    "proximity_gru": ("~experiment", "perception=proximity_gru", "randomization=paper"),
    "pd_risknet_no_distal": overrides_of("pd_risknet_no_distal"),
    "proximity_gru_no_proximal": overrides_of("proximity_gru_no_proximal"),
    "polar_rings": ("experiment=avoid", "init=unread", "rewards.avoidance.max_acceleration=2.0"),
    "timed_rings": ("experiment=navigator", "init=unread"),
    "motion_by_fps": ("experiment=avoid", "init=unread", *overrides_of("fps_gru_small"), "perception.base_motion=true"),
    "clock": (
        *("experiment=walk", "observations=gait", "commands.standing=0.5", "commands.resample_s=[0.1,0.3]"),
        *("observations.groups.clock.terms.gait_phase.rest_s=0.1", "+stepping={lift: 1.4, rest_s: 0.1}"),
    ),
    "estimated": ("experiment=walk", "observations=gait_without_velocity"),
    "polar_rings_estimated": ("experiment=avoid", "init=unread", "observations=gait_without_velocity"),
    "motion_by_proximal": ("experiment=avoid", "init=unread", *overrides_of("pd_risknet_no_distal")),
}
ALIKE = {
    "pd_risknet_small": "pd_risknet",
    "fps_mlp_small": "fps_mlp",
    "fps_gru_small": "fps_gru",
    "direct_mlp_small": "direct_mlp",
    "pd_risknet_no_proximal": "proximity_gru_no_proximal",
    "polar_rings_no_match": "polar_rings",
}
"""Presets that differ from a recipe's in sizes, or lack a part."""
DEFAULT_POS = [0.1, 0.8, -1.5, -0.1, 0.8, -1.5, 0.1, 1.0, -1.5, -0.1, 1.0, -1.5]
STAND = RobotState(DEFAULT_POS, [0.0] * 12, [1.0, 0.0, 0.0, 0.0], [0.0] * 3, [0.0] * 3)


def actions_of(outputs):
    """Of a network that may give estimates beside them."""
    return outputs[0] if isinstance(outputs, tuple) else outputs


def stir(actor):
    """Weights and statistics as after training: nothing is zero, what is seen matters, actions stay small."""
    torch.manual_seed(0)
    with torch.no_grad():
        for name, parameter in actor.named_parameters():
            if "std" not in name:
                parameter.add_(torch.randn_like(parameter) * (0.3 * parameter.std() if parameter.std() > 0 else 0.05))
        actor.mlp[0].weight[:, actor.blind_dim :] = 0.2 * torch.randn_like(actor.mlp[0].weight[:, actor.blind_dim :])
        actor.obs_normalizer._mean.add_(0.1 * torch.randn_like(actor.obs_normalizer._mean))
        actor.obs_normalizer._std.copy_(0.5 + torch.rand_like(actor.obs_normalizer._std))


@pytest.fixture(scope="session")
def exported_run(tmp_path_factory):
    """Run directory of a recipe, with a checkpoint and the exported policy in it."""

    @functools.cache
    def make(recipe: str) -> Path:
        run_dir = tmp_path_factory.mktemp(recipe)
        run = build.assemble(config.compose([*RECIPES[recipe], *SMALL]))
        config.save(run.composed, run_dir)
        runner = build_runner(run, run_dir)
        stir(runner.alg.actor)
        runner.save(str(checkpoint_path(run_dir, 7)))
        export(run_dir)
        return run_dir

    return make


def plain(run_dir):
    """The exported policy without limits, which training does not have."""
    return ExportedPolicy.load(run_dir / "exported", safety=None)


def trained(run_dir, *overrides):
    """Torch's policy in a fresh environment."""
    return load_policy(build.assemble(config.load(run_dir, overrides)), run_dir)


def test_every_preset_is_tried():
    assert {*config.presets("perception"), *VARIANTS} == {*RECIPES, *ALIKE} - {
        *("motion_by_fps", "motion_by_proximal", "clock", "estimated", "polar_rings_estimated")
    }


@pytest.mark.slow
@pytest.mark.parametrize("recipe", RECIPES)
def test_the_actions_are_those_of_torch(exported_run, recipe):
    """Over episodes of 0.5 s with LiDAR frames every fifth step, some lost and late, time-outs and one fall."""
    run_dir = exported_run(recipe)
    given = ("randomization=robot", "randomization.frames_lost=0.3", "randomization.pushes=null")
    torch_side = trained(run_dir, "num_envs=2", "terminations.episode_length_s=0.5", *given)
    env, policies = torch_side.env, ExportedPolicies(torch_side.env, plain(run_dir))
    scripted = torch.jit.load(str(run_dir / "exported" / "policy.pt"))
    ends, frames, lost, limited, without_frames = 0, 0, 0, 0, 0.0
    with torch.no_grad():
        for step in range(45):
            expected = torch_side.policy(env.get_observations())
            got = policies(env.get_observations())
            torch.testing.assert_close(got, expected, atol=1e-5, rtol=0.0)
            inputs = [torch.from_numpy(np.stack([robot.observation for robot in policies.robots]))]
            if policies.robots[0].frames is not None:
                assert [robot.frame_count for robot in policies.robots] == env.sensing.history.count.flatten().tolist()
                torch.testing.assert_close(
                    torch.from_numpy(np.stack([robot.frames for robot in policies.robots])),
                    env.sensing.history.frames,
                    atol=1e-5,
                    rtol=0.0,
                )
                lost += int((~env.sensing.fresh & (env.sensing.history.count[:, 0] > 1)).sum())
                frames += policies.robots[0].frame_count
                inputs.append(torch.from_numpy(np.stack([robot.frames for robot in policies.robots])))
                asked = []
                if LAST_ASKED in env.get_observations():
                    asked.append(env.get_observations()[LAST_ASKED])
                    ours = torch.from_numpy(np.stack([robot._asked for robot in policies.robots]))
                    torch.testing.assert_close(ours, torch_side.policy.asked, atol=1e-5, rtol=0.0)
                    limited += int(((ours - asked[0]).norm(dim=1) > 2.0 * env.control_dt - 1e-5).sum())
                blind = actions_of(scripted(*inputs, torch.zeros(2, 1, dtype=torch.int64), *asked))
                without_frames = max(without_frames, float((blind - expected).abs().max()))
                inputs += [env.sensing.history.count, *asked]
            torch.testing.assert_close(actions_of(scripted(*inputs)), expected, atol=1e-5, rtol=0.0)
            if torch_side.policy.estimate is not None:
                estimates = torch.from_numpy(np.stack([robot.base_lin_vel for robot in policies.robots]))
                torch.testing.assert_close(estimates, torch_side.policy.estimate, atol=1e-5, rtol=0.0)
            if step == 28:
                env.sim.qpos[1, 2] = 0.05
            ends += int(env.step(expected)[2].sum())
    assert ends == 3
    assert limited > 0 or recipe != "polar_rings"
    assert recipe in ("none", "clock", "estimated") or (
        frames > 30 and lost > 0 and without_frames > 1e-2
    )  # what it sees matters


def test_a_policy_sees_with_a_head_that_turns(tmp_path):
    """What it makes of points is what training made of them, with the neck bent."""
    folder = write_preset(tmp_path, BIPED.replace('name="neck" axis="0 0 1"', 'name="neck" axis="0.3 1 0"'))
    given = ("~experiment", "robot=biped", "lidar.mount=eyes", "perception=proximity_gru", "obstacles=static")
    given += ("lidar.num_rays=300",)
    down = ("robot.mounts.eyes.rpy=[3.0,0.2,0.3]", "perception.sampler.band_edges=[-0.6,-0.4,-0.2,0.0,0.15,0.5,3.0]")
    run = build.assemble(config.compose([folder, *given, *down, *SMALL]))
    config.save(run.composed, tmp_path)
    runner = build_runner(run, tmp_path)
    stir(runner.alg.actor)
    runner.save(str(checkpoint_path(tmp_path, 1)))
    described = export(tmp_path, formats=("onnx",))
    assert [turn.joint for turn in described.lidar.carried_by] == ["neck"]
    side = trained(tmp_path, "num_envs=2")
    env, policies = side.env, ExportedPolicies(side.env, plain(tmp_path))
    neck = int(env.world.model.joint("neck").qposadr[0])
    with torch.no_grad():
        for step in range(11):
            expected = side.policy(env.get_observations())
            torch.testing.assert_close(policies(env.get_observations()), expected, atol=1e-5, rtol=0.0)
            frames = torch.from_numpy(np.stack([robot.frames for robot in policies.robots]))
            torch.testing.assert_close(frames, env.sensing.history.frames, atol=1e-5, rtol=0.0)
            if step == 3:
                env.sim.qpos[:, neck] = torch.tensor([0.8, -0.5], dtype=env.sim.qpos.dtype)
            env.step(expected)
    robot, seen = policies.robots[0], []
    assert robot.frame_count >= 2 and (robot.frames[-1] != 0).any(-1).sum() > 20
    points = np.random.default_rng(0).uniform(-3, 3, (300, 3))
    for angle in (0.0, 0.7):  # of the neck, the third joint
        robot.add_frame(points, [1.0, 0.0, 0.0, 0.0], [0.2, 0.4, angle, -0.2, 0.4])
        seen.append(robot.frames[-1].copy())
    assert not np.allclose(*seen, atol=1e-2)
    with pytest.raises(DeployError, match="carried by neck; angles of 5 joints were expected, none given"):
        robot.add_frame(points, [1.0, 0.0, 0.0, 0.0])


GIMBAL = """<body name="gimbal" pos="0.04 0 0.08" euler="20 0 50">
  <joint name="roll" axis="1 0.3 0" range="-2 2" ref="0.2"/><joint name="pitch" axis="0 1 0" range="-2 2"/>
  <geom type="sphere" size="0.01" mass="0.1"/>
</body>"""


def _lidar_of(folder, text=BIPED, preset=BIPED_PRESET):
    run = build.assemble(
        config.compose(
            ["~experiment", write_preset(folder, text, preset), "robot=biped", "lidar=vlp16", "perception=none"]
        )
    )
    return export_module._lidar(run.env.lidar, run.env.robot), run.env.robot


def test_the_link_that_carries_a_lidar_is_turned_as_in_mujoco(exported_run, tmp_path):
    """Three joints of odd axes, one of them with an angle at rest, and a turned link: against mj_kinematics."""
    joints = (*BIPED_PRESET["joints"], "roll", "pitch")
    pose = {**BIPED_PRESET["default_joint_pos"], "roll": 0.0, "pitch": 0.0}
    numbers = dict.fromkeys(("kp", "kv", "torque_limits", "action_scale"), 1.0)
    mounts = {"back": {"pos": [0, 0, 0.1], "body": "gimbal"}}
    preset = {**BIPED_PRESET, **numbers, "joints": list(joints), "default_joint_pos": pose, "mounts": mounts}
    lidar, robot = _lidar_of(tmp_path, BIPED.replace('<body name="eyes" pos="0.04 0 0.08"/>', GIMBAL), preset)
    assert [turn.joint for turn in lidar.carried_by] == ["neck", "roll", "pitch"]
    policy = plain(exported_run("none"))
    policy.description = replace(policy.description, joints=replace(policy.description.joints, names=joints))
    model = robot.compiled()
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    for _ in range(5):
        angles, quat = rng.uniform(-1.5, 1.5, len(joints)), rng.normal(size=4)
        quat /= np.linalg.norm(quat)
        data.qpos[3:7] = quat
        for name, angle in zip(joints, angles, strict=True):
            data.joint(name).qpos = angle
        mujoco.mj_kinematics(model, data)
        found = policy._carrier_quat(lidar, quat, angles)
        assert abs(float(found @ data.body("gimbal").xquat)) == pytest.approx(1.0, abs=1e-9)


def test_a_lidar_that_a_passive_joint_turns_is_not_exported(tmp_path):
    mounts = {"back": {"pos": [0, 0, 0.1], "body": "tail"}}
    with pytest.raises(config.ConfigError, match="LiDAR on tail cannot .*: tail, between it and torso, is passive"):
        _lidar_of(tmp_path, preset={**BIPED_PRESET, "mounts": mounts})


@pytest.mark.slow
def test_the_evaluation_result_is_that_of_torch(exported_run):
    """Two environments go their own ways, one driven by torch, the other by the exported policy."""
    run_dir = exported_run("proximity_gru")
    overrides = ("num_envs=4", "terminations.episode_length_s=0.8", "seed=5")
    expected = trained(run_dir, *overrides)
    expected = run_episodes(expected.env, expected.policy, 8)
    env = trained(run_dir, *overrides).env
    got = run_episodes(env, ExportedPolicies(env, plain(run_dir)), 8)
    for name in ("outcome", "contacts", "length_s"):
        assert torch.equal(getattr(got, name), getattr(expected, name)), name
    for name in ("clearance", "path", "velocity_error", "yaw_rate_error", "free_s"):
        torch.testing.assert_close(getattr(got, name), getattr(expected, name), atol=1e-5, rtol=1e-5)


def test_other_weights_of_the_same_name_are_not_evaluated_as_exported(exported_run, tmp_path):
    run_dir = shutil.copytree(exported_run("none"), tmp_path / "run")
    path = checkpoint_path(run_dir, 7)
    state = load_checkpoint(path, "cpu")
    state["actor_state_dict"]["mlp.0.bias"] += 1.0
    save_checkpoint(path, state)
    with pytest.raises(ConfigError, match=r"exported from another checkpoint \(model_7.pt\) .* export again"):
        evaluate(Evaluation([run_dir], [World("walk")], policies=("exported",), trials=1, num_envs=1, jobs=1))


def test_an_export_leaves_no_file_of_an_earlier_one(exported_run, tmp_path, monkeypatch):
    for formats in (("torchscript", "onnx"), ("onnx",)):
        export(exported_run("none"), tmp_path, formats=formats)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["deploy.yaml", "policy.json", "policy.onnx"]
    monkeypatch.setattr("omniperception.deploy.export.deploy_yaml", lambda described: None)  # as of another robot
    export(exported_run("none"), tmp_path, formats=("onnx",))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["policy.json", "policy.onnx"]


@pytest.mark.slow
def test_a_robot_in_plain_mujoco_goes_where_the_training_environment_goes(exported_run):
    """Its own mj_step loop with the exported joint targets; only obstacles and points come from the environment."""
    run_dir = exported_run("pd_risknet")
    side = trained(run_dir, "num_envs=1")
    env, policy = side.env, plain(run_dir)
    model = env.world.model
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = env.sim.qpos[0].numpy(), env.sim.qvel[0].numpy()
    data.mocap_pos[:], data.mocap_quat[:] = env.sim.mocap_pos[0].numpy(), env.sim.mocap_quat[0].numpy()
    tick = 0
    for _ in range(40):
        points = raw_points(env.sensing.frame)[0] if env.sensing.tick != tick else None
        tick = env.sensing.tick
        world_to_base = np.zeros(9)
        mujoco.mju_quat2Mat(world_to_base, data.qpos[3:7])
        velocity = world_to_base.reshape(3, 3).T @ data.qvel[:3]
        state = RobotState(data.qpos[7:], data.qvel[6:], data.qpos[3:7], data.qvel[3:6], velocity)
        data.ctrl[:] = policy.step(state, env.command.value[0].numpy(), points)
        mujoco.mj_step(model, data, env.config.sim.decimation)
        with torch.no_grad():
            env.step(side.policy(env.get_observations()))
        np.testing.assert_allclose(data.qpos, env.sim.qpos[0].numpy(), atol=1e-4)
    assert policy.frame_count == 8 and abs(policy.action).max() > 0.05


def test_targets_are_those_of_the_training_environment_where_a_robot_steps(exported_run):
    """Over an episode's end, with commands to stand that let it rest and others that let it step on."""
    run_dir = exported_run("clock")
    side = trained(run_dir, "num_envs=2", "terminations.episode_length_s=0.7")
    env, policies = side.env, ExportedPolicies(side.env, plain(run_dir))
    moved, rested, asked = 0, 0, []
    env.step_hooks.append(lambda: asked.append(env.state.targets[0].numpy().copy()))
    for _ in range(60):
        actions = policies(env.get_observations())
        wanted = np.stack([robot.pose + 0.25 * robot.action for robot in policies.robots])
        resting = [not (robot.pose != np.float32(DEFAULT_POS)).any() for robot in policies.robots]
        env.step(actions)
        np.testing.assert_allclose(wanted, asked[-1], atol=1e-5)
        moved, rested = moved + resting.count(False), rested + resting.count(True)
    assert moved > 40 and rested > 10


def test_histories_are_filled_by_the_first_observation_and_then_move(exported_run):
    policy = plain(exported_run("none")).clone()
    described = policy.description
    assert [group.name for group in described.observations] == ["proprioception", "command", "action"]
    width, history = described.observations[0].width, described.observations[0].history
    assert width == 33
    targets = policy.step(STAND, [0.1, 0.2, 0.3])
    first = policy.observation
    assert first[history * width : history * width + 3].tolist() == pytest.approx([0.1, 0.2, 0.3])
    assert first[-12:].tolist() == [0.0] * 12
    assert first[:12].tolist() == pytest.approx([0.0] * 12)
    assert first[30:33].tolist() == [0.0, 0.0, -1.0]
    assert targets.tolist() == pytest.approx(
        [
            q + described.joints.action_scale * a
            for q, a in zip(described.joints.default_pos, policy.action, strict=True)
        ]
    )
    action = policy.action
    policy.step(STAND, [0.0, 0.0, 0.0])
    assert np.array_equal(policy.observation[-12:], action)
    policy.reset()
    policy.step(STAND, [0.1, 0.2, 0.3])
    assert np.array_equal(policy.observation, first)


@pytest.mark.slow
def test_thinning_keeps_what_training_kept(exported_run):
    """Of the whole frame of 20,000 points, the 1000 that the environment's own LiDAR measured."""
    run_dir = exported_run("pd_risknet")
    policy = plain(run_dir)
    whole = record(trained(run_dir, "num_envs=1").env, policy, 6, whole_frames=True)
    kept = record(trained(run_dir, "num_envs=1").env, policy, 6, whole_frames=False)
    frames = [(a.points, b.points) for a, b in zip(whole, kept, strict=True) if a.points is not None]
    assert len(frames) == 2
    for everything, expected in frames:
        assert everything.shape == (20000, 3)
        np.testing.assert_allclose(policy.subsample(everything), expected, atol=1e-6)


def test_the_description_says_what_was_trained(exported_run):
    described = Description.read(exported_run("proximity_gru") / "exported")
    assert described.control_period_s == 0.02 and described.lidar.period_s == 0.1
    assert described.joints.names[0] == "FL_hip_joint" and described.joints.default_pos[:3] == [0.1, 0.8, -1.5]
    assert (described.joints.kp, described.joints.kd, described.joints.action_scale) == (25.0, 0.6, 0.25)
    assert described.lidar.mount_pos == [0.28945, 0.0, -0.046825] and described.lidar.max_range == 6.0
    assert described.inputs == {"observations": (345,), "frames": (5, 280, 3), "frame_count": (1,)}
    assert described.command == {"lin_vel_x": [-0.5, 1.0], "lin_vel_y": [-0.5, 0.5], "ang_vel_z": [-1.0, 1.0]}
    assert described.provenance["checkpoint"] == "model_7.pt" and described.provenance["iteration"] == 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"joint_pos": [0.0] * 11}, r"joint_pos_offset: shape \(12,\) was expected, \(11,\) given"),
        ({"base_lin_vel": None}, "base_lin_vel: this policy observes it, None was given"),
        ({"base_quat": [0.0, 0.0, 0.0, 0.0]}, "base_quat: a unit quaternion"),
        ({"base_ang_vel": [0.0, float("nan"), 0.0]}, "base_ang_vel: finite numbers were expected"),
    ],
)
def test_wrong_readings_are_named(exported_run, change, message):
    policy = ExportedPolicy.load(exported_run("none") / "exported")
    with pytest.raises(DeployError, match=message):
        policy.step(RobotState(**{**STAND.__dict__, **change}), [0.0] * 3)


def test_wrong_points_are_named(exported_run):
    policy = ExportedPolicy.load(exported_run("pd_risknet") / "exported")
    with pytest.raises(DeployError, match=r"points: shape \(n, 3\) was expected, \(20, 4\) given"):
        policy.step(STAND, [0.0] * 3, np.zeros((20, 4)))
    lidar, times = policy.description.lidar, np.zeros(20)
    late = times + 3.0 * lidar.period_s
    for points, offsets, message in (
        (np.zeros((20, 2)), times, r"points: shape \(n, 3\) was expected, \(20, 2\) given"),
        (np.zeros(3), None, r"points: shape \(n, 3\) was expected, \(3,\) given"),
        (np.zeros((2 * lidar.points_per_frame, 3)), None, "points: a whole frame of"),
        (
            np.zeros((20, 3)),
            late,
            "offsets_s: seconds since the frame began, 0 to 0.1, were expected, 0.3 to 0.3 given",
        ),
        (np.zeros((20, 3)), times + np.nan, "offsets_s: seconds since the frame began"),
    ):
        with pytest.raises(DeployError, match=message):
            policy.subsample(points, offsets)
    with pytest.raises(DeployError, match="this policy is blind"):
        ExportedPolicy.load(exported_run("none") / "exported").step(STAND, [0.0] * 3, np.zeros((20, 3)))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"version": 99}, "format version 99, this program reads 9"),
        ({"format": "something"}, "describes no exported policy"),
        ({"joints": None}, "is incomplete"),
        ({"control_period_s": 0.03}, "policy.onnx and policy.json are not from the same export"),
        ({"checksums": {"onnx": "0" * 64}}, "policy.onnx and policy.json are not from the same export"),
        ({"observations": []}, "policy.onnx and policy.json are not from the same export"),
    ],
)
def test_a_description_that_does_not_fit_is_refused(exported_run, tmp_path, change, message):
    source = exported_run("none") / "exported"
    content = json.loads((source / "policy.json").read_text()) | change
    (tmp_path / "policy.json").write_text(json.dumps(content))
    (tmp_path / "policy.onnx").write_bytes((source / "policy.onnx").read_bytes())
    with pytest.raises(DeployError, match=message):
        ExportedPolicy.load(tmp_path)
    with pytest.raises(DeployError, match="holds no exported policy"):
        ExportedPolicy.load(tmp_path / "elsewhere")


def test_a_robot_needs_neither_torch_nor_warp_nor_hydra(exported_run):
    folder = exported_run("none") / "exported"
    script = (
        "import sys\n"
        "from omnirobot.runtime import ExportedPolicy, RobotState\n"
        f"policy = ExportedPolicy.load({str(folder)!r})\n"
        "pose = policy.description.joints.default_pos\n"
        "policy.step(RobotState(pose, [0]*12, [1,0,0,0], [0]*3, [0]*3), [0]*3)\n"
        "assert not {'torch', 'warp', 'hydra', 'mujoco', 'rsl_rl'} & set(sys.modules)\n"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_the_commands(exported_run, tmp_path):
    run_dir = exported_run("none")

    def call(script, *arguments):
        command = [sys.executable, str(ROOT / "scripts" / script), *arguments]
        return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)

    done = call("export.py", f"run={run_dir}", f"out={tmp_path / 'there'}", "formats=torchscript")
    assert done.returncode == 0 and "wrote" in done.stdout, done.stderr
    assert sorted(path.name for path in (tmp_path / "there").iterdir()) == ["deploy.yaml", "policy.json", "policy.pt"]
    shutil.copytree(tmp_path / "there", tmp_path / "run" / "exported")
    shutil.copy(run_dir / "config.yaml", tmp_path / "run")
    done = call("benchmark_env.py", "what=inference", f"run={tmp_path / 'run'}")
    assert done.returncode == 2 and "has no ONNX file" in done.stderr and "Traceback" not in done.stderr
    done = call("benchmark_env.py", "what=inference", f"run={run_dir}", "steps=20", f"out={tmp_path}")
    assert done.returncode == 0, done.stderr
    (row,) = json.loads((tmp_path / "latency.json").read_text())["rows"]
    assert row["case"] == "as trained" and row["step"] == "without frame" and 0 < row["p50_ms"] < 1000


@pytest.mark.parametrize(
    "recipe",
    [
        pytest.param(name, marks=() if name in ("none", "pd_risknet", "estimated") else pytest.mark.slow)
        for name in RECIPES
    ],
)
def test_declared_shapes_are_those_of_every_batch(exported_run, recipe, capfd):
    """onnxruntime, which compares each tensor with its declared shape, has nothing to say."""
    import onnxruntime

    path = exported_run(recipe) / "exported" / "policy.onnx"
    capfd.readouterr()
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    for batch in (1, 2, 7):
        feed = {}
        for given in session.get_inputs():
            assert given.shape[0] == "batch"
            feed[given.name] = np.ones((batch, *given.shape[1:]), np.int64 if "int64" in given.type else np.float32)
        outputs = session.run(None, feed)
        assert [list(out.shape) for out in outputs] == [[batch, *out.shape[1:]] for out in session.get_outputs()]
    assert capfd.readouterr().err == ""


def test_deploy_yaml_has_the_motors_order(exported_run):
    """Keys and types of unitree_rl_lab's own `deploy/robots/g1/config/policy/velocity/v0/params/deploy.yaml`."""
    read = yaml.safe_load((exported_run("estimated") / "exported" / "deploy.yaml").read_text())
    keys = ["joint_ids_map", "step_dt", "stiffness", "damping", "default_joint_pos", "commands", "actions"]
    assert [*read] == [*keys, "observations"]
    assert read["joint_ids_map"] == [3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8]  # FL FR RL RR are motors of legs 1 0 3 2
    assert read["step_dt"] == 0.02 and read["stiffness"] == [25.0] * 12 and read["damping"] == [0.6] * 12
    assert read["default_joint_pos"] == DEFAULT_POS
    assert read["commands"]["base_velocity"]["ranges"]["lin_vel_x"] == [-0.5, 1.0]
    action = read["actions"]["JointPositionAction"]
    assert action["offset"] == DEFAULT_POS and action["scale"] == [0.25] * 12
    assert action["clip"][2] == [-2.7227, -0.83776]
    terms = read["observations"]
    assert {"joint_pos_rel", "joint_vel_rel", "base_ang_vel", "projected_gravity", "velocity_commands"} <= {*terms}
    assert "base_lin_vel" not in terms and terms["base_ang_vel"]["scale"] == [1.0] * 3
    assert {"params", "clip", "scale", "history_length"} == {*terms["joint_pos_rel"]}


def test_deploy_yaml_names_what_it_has_no_place_for(exported_run):
    text = (exported_run("polar_rings_estimated") / "exported" / "deploy.yaml").read_text()
    assert "# It also reads 'frames' and 'frame_count'" in text
    described = Description.read(exported_run("none") / "exported")
    assert "base_lin_vel is no observation of unitree_rl_lab's controller" in deploy_yaml(described)
    assert "# The network's second output, 'estimate', is its base_lin_vel.\n" in text
    assert "# Actions, and last_action, are clipped to +-100 before their scale.\n" in deploy_yaml(described)
    clocked = (exported_run("clock") / "exported" / "deploy.yaml").read_text()
    assert "NOT TO BE USED" in clocked and "# gait_phase is 0 once the command has been 0 for 0.1 s.\n" in clocked
    twice = replace(described, observations=[*described.observations, described.observations[0]])
    assert "more than once; here each has one entry" in deploy_yaml(twice)
    assert "more than once" not in deploy_yaml(described)
    other = replace(described.joints, names=[f"leg_{k}" for k in range(12)])
    assert deploy_yaml(replace(described, joints=other)) is None


def test_what_cannot_be_exported_is_named(exported_run, tmp_path):
    (tmp_path / "config.yaml").write_bytes((exported_run("none") / "config.yaml").read_bytes())
    with pytest.raises(CheckpointError, match="no checkpoint in"):
        export(tmp_path)
    privileged = ("experiment=walk", "observations.actor=[privileged,command]", "num_envs=1")
    run = build.assemble(config.compose(privileged))
    with pytest.raises(config.ConfigError, match=r"privileged\.terms\.true_proprioception cannot be exported"):
        describe(run, OmniEnv(run.env))


def test_a_range_that_is_not_the_sensors_cannot_be_exported():
    farther = ("~experiment", "perception=fps_mlp_small", "perception.sampler.max_range=5", "num_envs=1")
    run = build.assemble(config.compose(farther))
    with pytest.raises(config.ConfigError, match=r"perception\.sampler\.max_range=5(\.0)? cannot be exported"):
        describe(run, OmniEnv(run.env))


class Still:
    """A network that reads flat observations and moves nothing."""

    def __init__(self, width):
        self.width = width

    def get_inputs(self):
        return [SimpleNamespace(name="observations", shape=["batch", self.width])]

    def run(self, names, feed):
        return [np.zeros((1, 12), np.float32)]


def test_an_observation_of_ones_own_is_read_by_its_name(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "examples" / "own_project"))
    own = "+observations.groups.proprioception.terms.foot_load={func: own_project.observations.foot_load}"
    run = build.assemble(config.compose(("experiment=walk", "num_envs=2", f"+{own}")))
    env = OmniEnv(run.env)
    described = describe(run, env)
    assert described.observations[0].terms[-1] == Term("foot_load", 4)
    for _ in range(20):
        env.step(torch.zeros(2, 12))
    state, command = robot_states(env)[1], env.command.value[1].numpy()
    policy = ExportedPolicy(described, Still(described.observation_size), safety=None)
    policy.step(state, command)
    observed = torch.cat([env.get_observations()[name] for name in run.env.observations.actor], 1)[1]
    np.testing.assert_allclose(policy.observation, observed, rtol=1e-5, atol=1e-6)
    weight = float(env.world.model.body_mass.sum()) * 9.81
    assert sum(state.other["foot_load"]) == pytest.approx(weight, rel=0.2)  # it stands on its feet
    with pytest.raises(DeployError, match="foot_load: this policy observes it"):
        policy.step(replace(state, other=None), command)
