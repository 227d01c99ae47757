"""Nothing that a scene does not need: seen in the buffers, launches, model fields and modules that exist."""

import json
import os
import runpy
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
import warp as wp
import yaml
from omniperception.scene.reach import FieldOfView, unreachable_geoms

from omniperception import build, config
from omniperception.build import build_runner
from omniperception.env import sensing as sensing_module
from omniperception.inventory import walk
from omniperception.lidar import Lidar, LidarConfig, RayScene, Shape, ShapeKind, grid, ray_bytes
from omniperception.lidar.launch import SplitLaunch
from omniperception.plan import PLAN_FILE, contact_pairs, describe
from omniperception.scene import build_world, ray_shapes
from omniperception.scene.rays import hidden_geoms

ROOT = Path(__file__).resolve().parents[1]
WALK = ("experiment=walk", "num_envs=13")
QUICKSTART = ("experiment=quickstart", "num_envs=13", "obstacles.curriculum=null", "ppo.num_steps_per_env=4")
NO_LIDAR_MODULES = ("warp", "omniperception.lidar.scene", "omniperception.perception.samplers.sampling")
HEADLESS = ("matplotlib", "trimesh", "viser", "onnx", "onnxruntime", "imageio_ffmpeg", "mujoco_lidar", "mujoco_warp")


def built(*overrides):
    run = build.assemble(config.compose(overrides))
    return run, build_runner(run, None)


@pytest.fixture(scope="module")
def walk_run():
    return built(*WALK)


@pytest.fixture(scope="module")
def quick_run():
    return built(*QUICKSTART)


def arrays_of(env):
    return {name: thing for name, thing in walk({"env": env}) if hasattr(thing, "shape")}


def launches_of(env):
    return [thing.name for _, thing in walk({"env": env}) if hasattr(thing, "commands")]


def names(plan, title):
    return {entry.name for entry in plan[title].has}


def left_out(plan, title):
    return {entry.name: entry.reason for entry in plan[title].left_out}


# --- examples, each by what exists ------------------------------------------------------------------------------------

IMPORTS = """
import json, sys
sys.argv = ["train.py", *{overrides}]
import runpy
try:
    runpy.run_path({train!r}, run_name="__main__")
except SystemExit as stop:
    assert not stop.code, stop.code
import torch
heavy = sorted({{name.split(".")[0] for name in sys.modules}})
devices = []
if "warp" in sys.modules:
    import warp as wp
    devices = sorted({{str(e.device) for m in wp._src.context.user_modules.values() for e in m.execs.values()}})
print("FOUND", json.dumps([heavy, [n for n in sys.modules if n.startswith("omniperception")],
      torch.cuda.is_initialized(), devices]))
"""


def modules_after_training(folder, *overrides):
    """Of a short training: top-level modules, ours, whether CUDA is initialised, devices with Warp code, the output."""
    sizes = [
        "num_envs=8",
        "ppo.max_iterations=1",
        "ppo.num_steps_per_env=6",
        "ppo.num_mini_batches=2",
        "hydra.run.dir=run",
    ]
    code = IMPORTS.format(overrides=[*overrides, *sizes], train=str(ROOT / "train.py"))
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", code], cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    found = next(line for line in done.stdout.splitlines() if line.startswith("FOUND "))
    return (*json.loads(found.removeprefix("FOUND ")), done.stdout)


@pytest.mark.slow
def test_training_blind_imports_neither_warp_nor_anything_of_the_lidar(tmp_path):
    top, ours, cuda, _, out = modules_after_training(tmp_path, "experiment=walk")
    assert not cuda and not {*top, *ours} & {*HEADLESS, *NO_LIDAR_MODULES}
    saved = yaml.safe_load((tmp_path / "run" / PLAN_FILE).read_text())
    assert saved["num_envs"] == 8 and "rays" in saved["stages of a step"]["left_out"]
    assert sum(line.startswith("plan: ") for line in out.splitlines()) == 1


@pytest.mark.slow
def test_training_with_a_lidar_on_a_cpu_imports_no_extras_and_compiles_for_the_cpu_only(tmp_path):
    top, _, cuda, devices, _ = modules_after_training(tmp_path, "experiment=quickstart", "obstacles.curriculum=null")
    assert "warp" in top and not set(top) & set(HEADLESS)
    assert not cuda and devices == ["cpu"]


def test_without_a_lidar_there_is_no_array_launch_or_frame_of_one(walk_run):
    env = walk_run[1].env
    assert env.sensing is None and not launches_of(env)
    assert not [name for name in arrays_of(env) if "sensing" in name or "lidar" in name]
    assert "frames" not in env.observations and not walk_run[1].alg.storage.has_frames


def test_a_lidar_that_nobody_reads_is_not_built(make_env):
    env = make_env("perception=none", "rewards=walk", "observations=walk", "obstacles=none")
    assert env.config.lidar is not None and env.sensing is None


def test_flat_ground_and_shapes_have_no_tree_mesh_or_height_field(quick_run):
    geometry = quick_run[1].env.sensing.scene.geometry
    for name in ("part", "bounds", "child", "triangle"):
        assert getattr(geometry, f"mesh_{name}").size == 0
    for name in ("part", "height", "level", "extreme"):
        assert getattr(geometry, f"field_{name}").size == 0
    assert "descend" not in code_of_scan(quick_run[1].env) and "heightfield" not in code_of_scan(quick_run[1].env)


def test_tiled_ground_is_a_height_field_in_the_rays_and_their_kernel(make_env):
    env = make_env("terrain=rough", "perception=none", "lidar.num_rays=50")
    assert env.sensing.scene.geometry.field_height.size > 0
    assert "heightfield" in code_of_scan(env)


def code_of_scan(env):
    """What the scan's kernel was compiled from."""
    module = env.sensing.lidar._casts[0].kernel.module.get_module_identifier(1)  # one thread to a block, as on a CPU
    lines = Path(wp.config.kernel_cache_dir, module, f"{module}.cpp").read_text().splitlines()
    return "\n".join(line for line in lines if not line.lstrip().startswith("//"))


@pytest.fixture
def launched(monkeypatch):
    """Names of the kernels that are launched, as they are."""
    found, original = [], SplitLaunch.__call__

    def launch(self):
        found.append(self.name)
        original(self)

    monkeypatch.setattr(SplitLaunch, "__call__", launch)
    return found


def test_what_nothing_carries_is_placed_once(launched):
    shapes = [Shape(ShapeKind.SPHERE, (0.5,), pos=(2.0, 0.1 * k, 0.0)) for k in range(20)]  # enough to be packed
    moving = [Shape(ShapeKind.SPHERE, (0.5,), body=0), *shapes]
    for bodies, expected in ((0, 1), (1, 3)):
        scene = RayScene(moving if bodies else shapes, 2, bodies, num_threads=1)
        pattern = grid(16, 4, 40.0, 10.0)
        lidar = Lidar(LidarConfig(num_rays=64), pattern, scene, mount_body=-1)
        launched.clear()
        frames = [lidar.cast(0.1 * k).ranges.clone() for k in range(1, 4)]
        assert launched.count("place_shapes") == launched.count("pack_slots") == expected
        assert launched.count("cast_scan") == 3 and frames[0].isfinite().any()
    assert torch.equal(frames[0], frames[2])


def test_shapes_that_can_be_hidden_are_placed_anew(launched):
    scene = RayScene([Shape(ShapeKind.SPHERE, (0.5,), pos=(2.0, 0.0, 0.0))], 1, 0, num_threads=1)
    ray = torch.zeros(1, 1, 3), torch.tensor([[[1.0, 0.0, 0.0]]])
    assert [scene.cast(*ray).ranges.item() for _ in range(2)] == [1.5, 1.5]
    assert launched.count("place_shapes") == 1
    scene.visible[0, 0] = False
    assert scene.cast(*ray).ranges.item() == float("inf")
    scene.visible[0, 0] = True
    assert scene.cast(*ray).ranges.item() == 1.5


# --- rays -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["mid360", "avia", "depth_camera", "height_scanner"])
def test_geoms_left_out_of_the_rays_are_never_met(name, make_config):
    """Casting everything meets no geom that was left out, at random and extreme joint angles beyond the limits."""
    config = make_config(f"lidar={name}", "perception=none", "obstacles=none").env
    world = build_world(config.robot, config.terrain, config.obstacles)
    sensor, pattern = config.lidar, config.lidar.pattern()
    hidden = hidden_geoms(world, (), sensing_module.field_of_view(sensor, pattern, ()))
    assert bool(hidden) == (name in ("avia", "depth_camera"))
    poses = random_postures(world.model, NUM_POSTURES)
    seen = {}
    for left_out in ((), hidden):
        shapes = ray_shapes(world, left_out)
        scene = RayScene(shapes.shapes, NUM_POSTURES, len(shapes.bodies), num_threads=1)
        scene.set_poses(*(field[:, list(shapes.bodies)] for field in poses))
        more = replace(sensor, num_rays=min(1000, pattern.points_per_frame(sensor.period_s)), min_range=0.0)
        lidar = Lidar(more, pattern, scene, mount_body=shapes.base, outputs=("ranges", "shape_id"), seed=1)
        frame = lidar.cast(1.0)
        met = [shapes.geom_names[k] if k >= 0 else None for k in frame.shape_id.flatten().tolist()]
        seen[bool(left_out)] = frame.ranges.clone(), met
    assert not set(hidden) & set(seen[False][1])
    if hidden:
        assert torch.equal(seen[False][0], seen[True][0]) and seen[False][1] == seen[True][1]


NUM_POSTURES = 48


def random_postures(model, count):
    """Positions and orientations of all bodies: half of the joints at an end of their range, the others anywhere."""
    rng, data = np.random.default_rng(0), mujoco.MjData(model)
    low, high = model.jnt_range[1:].T
    pos, quat = np.zeros((count, model.nbody, 3)), np.zeros((count, model.nbody, 4))
    for k in range(count):
        ends = np.where(rng.random(len(low)) < 0.5, low, high)
        data.qpos[7:] = np.where(rng.random(len(low)) < 0.5, ends, rng.uniform(-np.pi, np.pi, len(low)))
        data.qpos[:7] = [*rng.uniform(-1, 1, 2), 0.4, *rng.normal(size=4)]
        mujoco.mj_kinematics(model, data)
        pos[k], quat[k] = data.xpos, data.xquat
    return pos, quat


def test_an_unknown_link_counts_as_within_reach():
    """A joint that slides, and a body that floats, are never left out."""
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><body name="base"><freejoint/><geom size="0.1"/>
        <body pos="-1 0 0"><joint type="slide" axis="1 0 0"/><geom name="slides" size="0.1"/></body>
        <body pos="-1 0 0"><geom name="behind" size="0.1"/></body></body>
        <body pos="-1 0 0"><freejoint/><geom name="floats" size="0.1"/></body></worldbody></mujoco>"""
    )
    view = FieldOfView.of([0.2, 0, 0], [1, 0, 0, 0], np.array([[1.0, 0, 0], [0.8, 0.6, 0]]))
    assert {model.geom(k).name for k in unreachable_geoms(model, 1, view)} == {"", "behind"}


def test_poses_of_base_and_obstacles_are_read_off_the_state(make_env, monkeypatch):
    env = make_env("lidar=depth_camera", "perception=none", "lidar.num_rays=50")
    legs = [body for body in env.sensing._bodies if body not in env.sim._roots]
    assert legs == [env.world.model.body(f"{side}_{link}").id for side in ("FL", "FR") for link in ("thigh", "calf")]
    calls = []
    monkeypatch.setattr(type(env.sim.batch), "forward", lambda *_, **__: calls.append(1))
    roots = tuple(sorted(env.sim._roots))
    found = env.sim.body_poses(roots)
    assert not calls
    monkeypatch.undo()
    env.sim.body_poses((*roots, *legs))
    for mine, theirs in zip(found, env.sim._poses, strict=True):
        np.testing.assert_allclose(mine.numpy(), theirs[:, list(roots)], atol=1e-6)


# --- physics and state ------------------------------------------------------------------------------------------------


def test_contact_sensors_and_torques_exist_for_terms_that_read_them(make_env):
    paper = make_env("rewards=paper", "perception=none", "lidar.num_rays=50")
    assert paper.world.sensors == {"foot_force", "link_force", "obstacle_contact"} and "sensordata" in paper.sim._record
    assert "actuator_force" in paper.sim.batch._bound
    blind = make_env("obstacles=none", blind=True)
    assert blind.world.model.nsensor == 0 and not blind.sim._record and not blind.sim._records


@pytest.mark.parametrize(
    ("term", "sensor"),
    [("foot_stumble", "foot_force"), ("joint_torques", None)],
)
def test_weight_0_removes_term_input_and_sensor(term, sensor, make_env):
    base = ("rewards=paper", "perception=none", "lidar.num_rays=50", "obstacles=none")
    for weight, there in ((-1.0, True), (0.0, False)):
        env = make_env(*base, f"rewards.terms.{term}.weight={weight}")
        assert (term in env.config.rewards.terms) == there
        model = env.world.model
        named = [model.sensor(k).name for k in range(model.nsensor)]
        if sensor:
            assert any(name.startswith(sensor) for name in named) == there
        else:
            assert ("actuator_force" in env.sim.batch._bound) == there


@pytest.mark.parametrize(("overrides", "read"), [((), False), (("observations=paper",), True)])
def test_heights_are_looked_up_for_critic_or_supervision_only(overrides, read, make_env, launched):
    env = make_env("terrain=rough", "perception=none", "lidar.num_rays=50", *overrides)
    launched.clear()
    env.step(torch.zeros(env.num_envs, env.num_actions))
    assert "base_heights" in launched and ("heights_around" in launched) == read


def test_only_what_is_randomized_is_a_field_of_its_own(make_env):
    plain = make_env(blind=True)
    assert not plain.sim.batch._expanded and not [name for name in arrays_of(plain) if "randomizer" in name]
    some = make_env("+randomization.motor_strength=[0.9,1.1]", "+randomization.latency_s=[0.005,0.02]", blind=True)
    assert set(some.sim.batch._expanded) == {"actuator_gainprm", "actuator_biasprm"}
    assert (
        some.randomizer.joint_offset is None and some.state._history._past[0].shape[1] == 1 + 4
    )  # 20 ms in steps of 5 ms


def test_only_noise_that_is_configured_is_compiled(make_env):
    rays = ("perception=none", "lidar.num_rays=50")
    assert "rand" not in code_of_scan(make_env(*rays)).replace("operand", "")
    noisy = make_env(*rays, "randomization=lidar")
    assert {"mask", "distance"} <= noisy.sensing.lidar.features and "randf" in code_of_scan(noisy)


def test_a_group_without_history_keeps_none(make_env):
    walk_env = make_env(blind=True)
    history = walk_env.config.observations.groups["proprioception"].history
    assert walk_env._groups["proprioception"].state_dict()["history"].shape[1] == history
    assert walk_env._groups["command"].state_dict()["history"] is None


def test_frames_are_kept_as_far_back_as_the_network_looks(quick_run):
    run, runner = quick_run
    assert runner.env.sensing.frames.shape[1] == run.perception.history
    windows = 1 + -(-(run.ppo.num_steps_per_env - 1) // runner.env.sensing.period_steps)
    assert runner.alg.storage.frames.shape[1] == run.perception.history - 1 + windows


# --- the plan ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "overrides",
    [
        ("experiment=walk",),
        ("experiment=quickstart", "obstacles.curriculum=null"),
        ("experiment=avoid", "obstacles.curriculum=null"),
        ("terrain=rough", "obstacles=static", "rewards=paper", "perception=none"),
    ],
)
def test_stages_and_kernels_are_those_that_run(overrides, launched):
    run, runner = built(*overrides, "num_envs=13", "ppo.num_steps_per_env=4")
    plan, env = describe(run, runner), runner.env
    env.timer.drain()
    launched.clear()
    with torch.no_grad():
        for _ in range(env.sensing.period_steps if env.sensing else 1):
            env.step(runner.alg.actor(env.get_observations()))
    env._reset(torch.arange(env.num_envs))
    assert names(plan, "stages of a step") == set(env.timer.seconds)
    assert names(plan, "kernels") == set(launched)


def test_readers_and_reasons_are_named(quick_run, walk_run):
    quick, blind = describe(*quick_run), describe(*walk_run)
    stages = {entry.name: entry.reason for entry in quick["stages of a step"].has}
    assert stages["sectors"].startswith("read by rewards.velocity_tracking_with_avoidance, obs")
    assert left_out(blind, "stages of a step")["rays"] == "lidar=none"
    assert left_out(quick, "ray geometry")["head_upper"] == "named in its mount's exclude_geoms"
    others = left_out(quick, "optional packages")  # of other tests in this process some may be imported
    assert "mujoco_warp" in sys.modules or others["mujoco_warp"].startswith("physics on a GPU")
    assert not set(others) & set(sys.modules)


def test_memory_counts_every_byte_once_and_grows_with_the_environments():
    plans = [describe(*built("experiment=quickstart", f"num_envs={n}", "ppo.num_steps_per_env=4")) for n in (13, 29)]
    few, many = ({b.name: b.num_bytes / p.built_envs for b in p.buffers if b.per_env} for p in plans)
    assert few == pytest.approx(many)
    frames = next(b for b in plans[0].buffers if b.name.endswith("storage.frames"))
    assert frames.num_bytes == 13 * (5 - 1 + 2) * (64 + 36 * 6) * 3 * 4


def test_a_plan_tells_the_parts_of_the_run_not_of_what_was_built_to_describe_it():
    run, runner = built("experiment=quickstart", "num_envs=8", "ppo.num_steps_per_env=4", "lidar.num_rays=500")
    bytes_per_env = 500 * ray_bytes(runner.env.sensing.lidar.outputs)
    fitting = int(1e9 / bytes_per_env)
    for num_envs, exists in ((fitting, False), (fitting + 1, True)):
        plan = describe(replace(run, env=replace(run.env, num_envs=num_envs)), runner)
        parts = {entry.name: entry.detail for entry in plan["ray geometry"].has}.get("parts of a frame")
        assert parts == ("2" if exists else None)


def test_contact_pairs_are_those_that_the_engine_finds(make_env):
    model = make_env("obstacles=static", blind=True).world.model
    obstacles = sum(model.geom(k).name.startswith("obstacle") for k in range(model.ngeom))
    pairs = set(contact_pairs(model))
    assert len(pairs) == (model.ngeom - 1 - obstacles) * (1 + obstacles)
    rng, data, found = np.random.default_rng(0), mujoco.MjData(model), set()
    for _ in range(300):
        data.qpos[:7] = [0, 0, 0.1, *rng.normal(size=4)]
        data.mocap_pos[:] = rng.uniform(-0.4, 0.4, (model.nmocap, 3))
        mujoco.mj_forward(model, data)
        found |= {tuple(sorted(pair)) for pair in data.contact.geom.tolist()}
    assert found and found <= pairs


def test_the_plan_is_saved_and_summed_up_in_a_line(walk_run, tmp_path):
    plan = describe(*walk_run)
    plan.save(tmp_path)
    assert yaml.safe_load((tmp_path / PLAN_FILE).read_text()) == plan.as_dict()
    assert plan.summary().startswith("plan: 5 stages of a step, 0 kernels") and "\n" not in plan.summary()
    assert "lidar=none" in plan.text() and "joint_torques" in plan.text()


def test_the_script_prints_a_plan_and_refuses_a_wrong_override_in_one_line(capsys, monkeypatch):
    script = runpy.run_path(str(ROOT / "scripts" / "plan.py"))
    monkeypatch.setattr(sys, "argv", ["plan.py", *WALK])
    script["main"]()
    assert "stages of a step" in capsys.readouterr().out
    monkeypatch.setattr(sys, "argv", ["plan.py", "lidar=nothing"])
    with pytest.raises(SystemExit) as stop:
        script["main"]()
    assert stop.value.code == 2 and capsys.readouterr().err.count("\n") == 1
