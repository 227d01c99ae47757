"""Every preset composes, builds and steps; the paper's numbers; sensors are their devices."""

import sys
from pathlib import Path

import pytest
import torch

from omnilidar import DEVICES
from omniperception import build, config
from omniperception.build import build_runner
from omniperception.env.env import OmniEnv
from omniperception.evaluation.ablation import VARIANTS, overrides_of
from omniperception.scene.tiled_terrain import TiledTerrainConfig

sys.path.insert(0, str(Path(__file__).parent))
from own_robots import skip_if_not_fetched

NO_PRESETS = {config.SUITES, config.STUDIES}
PRESETS = sorted(
    str(path.relative_to(config.CONFIG_DIR).with_suffix(""))
    for path in config.CONFIG_DIR.glob("**/*.yaml")
    if path.parent != config.CONFIG_DIR and path.parent.name not in NO_PRESETS and not path.name.startswith("_")
)
BLIND = ["perception=none", "rewards=walk", "observations=walk"]
COMPANIONS = {
    "commands/corridor": ["obstacles=corridor"],
    "obstacles/corridor": ["commands=corridor"],
    "lidar/none": BLIND,
    "observations/navigate": ["experiment=navigate"],
    "observations/perceive": ["experiment=perceive"],
    "rewards/navigate": ["experiment=navigate"],
    "sim/planar": ["experiment=navigate"],
}
"""What a preset needs beside it."""
QUICK = ["perception=none", "lidar.selection=every_kth"]
"""Choosing rays evenly takes seconds."""
LEARNING = ("perception/", "ppo/", "experiment/", "observations/")


def test_no_preset_is_missed():
    assert len(PRESETS) == 163
    groups = {preset.split("/")[0] for preset in PRESETS}
    assert groups == {path.name for path in config.CONFIG_DIR.iterdir() if path.is_dir()} - NO_PRESETS
    assert set(COMPANIONS) <= set(PRESETS)


def test_every_preset_says_what_it_is():
    for path in config.CONFIG_DIR.glob("**/*.yaml"):
        said = path.read_text().removeprefix("# @package _global_\n")
        assert said.startswith("# "), path


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_composes_builds_and_steps(preset, make_config):
    group, name = preset.split("/")
    if group == "robot":
        skip_if_not_fetched(name)
    beside = [*COMPANIONS.get(preset, []), *(QUICK if group == "lidar" and name != "none" else [])]
    run = make_config(*beside, f"{group}={name}", "num_envs=2")
    if preset.startswith(LEARNING):
        runner = build_runner(run, None)
        env = runner.env
        with torch.inference_mode():
            actions = runner.policy(env.get_observations())
        assert actions.shape == (2, env.num_actions)
    else:
        env = OmniEnv(run.env)
        actions = torch.zeros(2, env.num_actions)
    for _ in range(5):
        observations, reward, _, _ = env.step(actions.clone())
    assert torch.isfinite(reward).all()
    numbers = [value.float() for value in observations.values() if isinstance(value, torch.Tensor)]
    assert all(torch.isfinite(value).all() for value in numbers)


class TestPaper:
    @pytest.fixture
    def run(self, make_config):
        return make_config("experiment=paper")

    def test_hyperparameters(self, run):
        """Table 'PPO Hyperparameters' and the hidden layers of section 'Actor Network Architecture'."""
        ppo = run.ppo
        assert (ppo.clip_param, ppo.lam, ppo.gamma) == (0.2, 0.95, 0.99)
        assert (ppo.learning_rate, ppo.schedule, ppo.desired_kl) == (1e-3, "adaptive", 0.01)
        assert (ppo.value_loss_coef, ppo.use_clipped_value_loss) == (1.0, True)
        assert (ppo.entropy_coef, ppo.max_grad_norm) == (0.01, 1.0)
        assert run.env.num_envs == 4096
        assert (ppo.num_steps_per_env, ppo.num_learning_epochs, ppo.num_mini_batches) == (24, 5, 4)
        assert (list(ppo.hidden_dims), ppo.activation) == ([1024, 512, 256, 128], "elu")

    def test_perception(self, run):
        network = run.perception.build_network()
        assert run.perception.history == run.env.frame_history == 10
        assert run.env.targets == ("height_target",)
        widths = {name: part.hidden_size for name, part in network.named_children()}
        assert widths == {"proximal": 187, "distal": 64}

    def test_recipe(self, run):
        assert len(run.env.rewards.terms) == 11 and run.env.rewards.avoidance.num_sectors == 36
        assert run.env.rewards.avoidance.threshold == 1.0
        assert run.env.randomization.gravity_offset == (-1.0, 1.0)
        assert run.env.randomization.noise and run.env.observations.actor == ("proprioception", "command")
        assert isinstance(run.env.terrain, TiledTerrainConfig)  # on a plane the supervision is one number


def test_default_rates(make_config):
    env = make_config().env
    assert (env.sim.timestep, env.sim.control_dt, env.lidar.period_s) == (0.005, pytest.approx(0.02), 0.1)


class TestSensors:
    @pytest.mark.parametrize("name", DEVICES)
    def test_a_preset_is_its_device(self, name, make_config):
        lidar, device = make_config(f"lidar={name}").env.lidar, DEVICES[name]
        assert lidar.device == name and lidar.pattern is device.pattern
        assert (lidar.period_s, lidar.min_range) == (0.1, device.min_range)
        assert lidar.max_range == (6.0 if name.startswith("mid360") else device.max_range)  # avoidance needs no more

    def test_where_they_are_mounted(self, make_config):
        def mount(*overrides):
            lidar = make_config(*overrides).env.lidar
            return lidar.mount_pos, lidar.mount_rpy, tuple(lidar.exclude_geoms)

        head = ((0.28945, 0.0, -0.046825), (0.0, -2.8782, 3.14), ("head_upper", "head_lower"))
        assert mount() == mount("lidar=vlp16", "lidar.mount=head") == head
        assert mount("lidar=vlp16") == ((0.0, 0.0, 0.12), (0.0, 0.0, 0.0), ())
        assert mount("lidar=avia") == ((0.25, 0.0, 0.12), (0.0, 0.0, 0.0), ())
        assert mount("robot.mounts.head.pos=[0.3,0,0]")[0] == (0.3, 0.0, 0.0)
        assert mount("lidar.mount={pos: [0, 0, 1], exclude_geoms: [trunk]}") == ((0, 0, 1), (0, 0, 0), ("trunk",))

    def test_parameters_that_differ_from_the_devices(self, make_config):
        run = make_config("lidar=os0_32", "lidar.max_range=9.0", "lidar.pattern={type: os0, channels: 64}")
        assert run.env.lidar.max_range == 9.0 and run.env.lidar.pattern().num_lasers == 64
        assert run.perception.sampler().max_range == 9.0


@pytest.mark.parametrize("variant", sorted({*config.presets("perception"), *VARIANTS} - {"none", "direct_mlp"}))
def test_every_variant_of_perception_learns_to_avoid(variant):
    """As scripts/ablation.py trains them: the same targets, and the base's motion whichever paths there are."""
    overrides = ("experiment=avoid", *overrides_of(variant), "init=unread", "num_envs=2")
    runner = build_runner(build.assemble(config.compose(overrides)), None)
    with torch.inference_mode():
        actions = runner.policy(runner.env.get_observations())
    assert actions.shape == (2, 12) and torch.isfinite(actions).all()


def test_every_device_is_a_preset_and_other_presets_are_known():
    presets = {path.stem for path in (config.CONFIG_DIR / "lidar").glob("[!_]*.yaml")}
    assert presets - set(DEVICES) == {"none", "custom", "depth_camera", "height_scanner"}
    assert set(DEVICES) <= presets
