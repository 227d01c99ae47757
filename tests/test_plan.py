"""What a configuration does not need does not exist in it, and the plan tells what does."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import warp as wp

from omnilidar import Lidar, LidarConfig, RayScene, Shape, ShapeKind, grid
from omnilidar.launch import SplitLaunch
from omniperception.commands.plan import build_parts, command
from omniperception.plan import summary

ROOT = Path(__file__).resolve().parents[1]
TRAIN = """
import json, sys
from omniperception.commands.train import command
command({overrides})
import torch
print("FOUND", json.dumps([sorted(sys.modules), torch.cuda.is_initialized()]))
"""


def test_walking_has_no_lidar_no_contact_sensor_and_no_field_of_its_own():
    parts = build_parts(["experiment=walk", "num_envs=2"])
    built, left_out = (line.partition(": ")[2].split(", ") for line in summary(parts).splitlines())
    assert built == ["physics", "rewards", "observations"] and set(left_out) == parts.keys() - set(built)
    assert {"rays", "contact sensors", "randomized fields", "obstacles", "sectors", "perception"} <= set(left_out)


def test_parts_of_families_are_said_once():
    parts = {"hold rays": [], "hold sectors": [], "crowd rays": ["9"], "crowd sectors": [], "perception": ["learned"]}
    assert summary(parts, ("hold", "crowd")) == "built: rays, perception\nleft out: sectors"


def test_a_lidar_brings_its_rays_and_shapes():
    parts = build_parts(["experiment=quickstart", "num_envs=2"])
    assert {"1000 every 5 steps", "cylinder", "plane", "distance"} <= set(parts["rays"])
    assert parts["contact sensors"] == ["obstacle_contact"] and parts["perception"] and not parts["uneven ground"]


@pytest.mark.parametrize(
    ("term", "sensor", "quantity"),
    [("foot_stumble", "foot_force", "foot_force"), ("joint_torque_squared", None, "joint_torque")],
)
def test_a_term_brings_what_it_reads_and_weight_0_removes_it(term, sensor, quantity, make_env):
    base = ("rewards=paper", "perception=none", "lidar.num_rays=50")
    for weight, there in ((-1.0, True), (0.0, False)):
        env = make_env(*base, "obstacles=none", f"rewards.terms.{term}.weight={weight}", num_envs=2)
        env.step(torch.zeros(2, env.num_actions))
        assert (term in env.config.rewards.terms) == there == env.state.has_computed(quantity)
        assert sensor is None or (sensor in env.world.sensors) == there


def test_only_what_is_randomized_is_a_field_of_its_own():
    parts = build_parts(["experiment=walk", "randomization.motor_strength=[0.9,1.1]", "num_envs=2"])
    assert parts["randomized fields"] == ["actuator_biasprm", "actuator_gainprm"]


def test_a_lidar_that_is_not_read_is_not_built(make_env):
    env = make_env("perception=none", "rewards=walk", "observations=walk", "obstacles=none")
    assert env.config.lidar is not None and env.sensing is None


@pytest.mark.slow
@pytest.mark.parametrize(("experiment", "sees"), [("walk", False), ("quickstart", True)])
def test_training_says_what_is_built_and_imports_no_extras(experiment, sees, tmp_path):
    sizes = ["num_envs=8", "ppo.max_iterations=1", "ppo.num_mini_batches=2", "hydra.run.dir=run"]
    code = TRAIN.format(overrides=[f"experiment={experiment}", *sizes])
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    found = next(line for line in done.stdout.splitlines() if line.startswith("FOUND "))
    modules, cuda = json.loads(found.removeprefix("FOUND "))
    extras = {"matplotlib", "trimesh", "viser", "onnx", "onnxruntime", "imageio_ffmpeg", "mujoco_lidar", "mujoco_warp"}
    assert not cuda and not extras & set(modules)
    unneeded = {"omnilidar.kernels", "omnilidar.sensor", "omniperception.env.sensing"}
    assert (unneeded <= set(modules)) == sees == bool(unneeded & set(modules))
    (line,) = (line for line in done.stdout.splitlines() if line.startswith("built: "))
    assert ("rays" in line.split(", ")) == sees


def test_the_command_prints_what_is_built_and_what_another_recipe_has(capsys):
    command(["experiment=walk", "beside=quickstart", "num_envs=2"])
    out = capsys.readouterr().out
    assert "+ rewards: velocity_tracking 2, " in out and "- rays: 1000 every 5 steps, " in out
    command(["experiment=walk", "beside=null", "num_envs=2"])
    assert "- rays\n" in capsys.readouterr().out


# --- what is computed and compiled ------------------------------------------------------------------------------------


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
        assert launched.count("place_shapes") == expected
        assert launched.count("cast_scan") == 3 and frames[0].isfinite().any()
    assert torch.equal(frames[0], frames[2])


def test_shapes_that_can_be_hidden_are_placed_in_each_frame(launched):
    scene = RayScene([Shape(ShapeKind.SPHERE, (0.5,), pos=(2.0, 0.0, 0.0))], 1, 0, num_threads=1)
    ray = torch.zeros(1, 1, 3), torch.tensor([[[1.0, 0.0, 0.0]]])
    assert [scene.cast(*ray).ranges.item() for _ in range(2)] == [1.5, 1.5]
    assert launched.count("place_shapes") == 1
    scene.visible[0, 0] = False
    assert scene.cast(*ray).ranges.item() == float("inf")
    scene.visible[0, 0] = True
    assert scene.cast(*ray).ranges.item() == 1.5


def test_poses_of_base_and_obstacles_are_read_off_the_state(make_env, monkeypatch):
    env = make_env("lidar=depth_camera", "perception=none", "lidar.num_rays=50")
    legs = [body for body in env.sensing._bodies if body not in env.sim._roots]
    assert len(legs) == 12
    calls = []
    monkeypatch.setattr(type(env.sim.batch), "forward", lambda *_, **__: calls.append(1))
    roots = tuple(sorted(env.sim._roots))
    found = env.sim.body_poses(roots)
    assert not calls
    monkeypatch.undo()
    env.sim.body_poses((*roots, *legs))
    for mine, theirs in zip(found, env.sim._poses, strict=True):
        np.testing.assert_allclose(mine.numpy(), theirs[:, list(roots)], atol=1e-6)


def test_only_noise_that_is_configured_is_compiled(make_env):
    rays = ("perception=none", "lidar.num_rays=50")
    assert "rand" not in code_of_scan(make_env(*rays)).replace("operand", "")
    noisy = make_env(*rays, "randomization=lidar")
    assert {"mask", "distance"} <= noisy.sensing.lidar.features and "randf" in code_of_scan(noisy)


@pytest.mark.parametrize(("overrides", "read"), [((), False), (("observations=paper",), True)])
def test_heights_are_looked_up_for_critic_or_supervision_only(overrides, read, make_env, launched):
    env = make_env("terrain=rough", "perception=none", "lidar.num_rays=50", *overrides)
    launched.clear()
    env.step(torch.zeros(env.num_envs, env.num_actions))
    assert "base_heights" in launched and ("heights_around" in launched) == read
