"""Every preset composes and builds; the paper's numbers; run directories."""

from functools import partial
from pathlib import Path
from types import FunctionType

import pytest
import torch

from omniperception import build, config
from omniperception.build import build_runner
from omniperception.commands.train import check_jobs
from omniperception.config import ConfigError
from omniperception.env.env import OmniEnv
from omniperception.evaluation.ablation import VARIANTS, overrides_of

ROOT = Path(__file__).resolve().parents[1]
PRESETS = sorted(
    str(path.relative_to(config.CONFIG_DIR).with_suffix(""))
    for path in config.CONFIG_DIR.glob("**/*.yaml")
    if path.parent != config.CONFIG_DIR and not path.name.startswith("_")
)
BLIND = ["perception=none", "rewards=walk", "observations=walk"]
COMPANIONS = {
    "commands/corridor": ["obstacles=corridor"],
    "obstacles/corridor": ["commands=corridor"],
    "lidar/none": BLIND,
    "experiment/gait": ["init=unread"],
}
"""What a preset needs beside it."""
LEARNING = ("perception/", "ppo/", "experiment/", "observations/")


def test_no_preset_is_missed():
    assert len(PRESETS) == 80
    groups = {preset.split("/")[0] for preset in PRESETS}
    assert groups == {path.name for path in config.CONFIG_DIR.iterdir() if path.is_dir()}
    assert set(COMPANIONS) <= set(PRESETS)


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_composes_builds_and_steps(preset):
    group, name = preset.split("/")
    if preset == "sim/mujoco_warp":
        pytest.importorskip("mujoco_warp")
    run = build.assemble(config.compose([*COMPANIONS.get(preset, []), f"{group}={name}", "num_envs=2"]))
    if preset.startswith(LEARNING):
        runner = build_runner(run, None)
        env = runner.env
        with torch.inference_mode():
            actions = runner.policy(env.get_observations())
        assert actions.shape == (2, 12)
    else:
        env = OmniEnv(run.env)
        actions = torch.zeros(2, 12)
    for _ in range(5):
        observations, reward, _, _ = env.step(actions.clone())
    assert torch.isfinite(reward).all()
    assert all(torch.isfinite(observations[key].float()).all() for key in observations.keys())  # noqa: SIM118


def test_a_term_is_called_without_hydra(make_config):
    """Hydra's own partials validate their target in every call, which took a fifth of a step."""
    env = make_config("experiment=quickstart").env
    terms = [term.func for term in env.rewards.terms.values()]
    terms += [term for group in env.observations.groups.values() for term in group.terms.values()]
    assert {type(term) for term in terms} == {partial, FunctionType}


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


class TestRates:
    def test_defaults(self, make_config):
        env = make_config().env
        assert env.sim.timestep == 0.005 and env.sim.control_dt == pytest.approx(0.02)
        assert env.lidar.period_s == 0.1
        assert env.lidar.mount_pos == (0.28945, 0.0, -0.046825)


def test_every_job_of_a_sweep_is_checked_before_the_first_starts():
    check_jobs(["num_envs=2,4", "obstacles=static,moving"])
    with pytest.raises(ConfigError, match="num_envs=0"):
        check_jobs(["num_envs=2,0"])


class TestRunDirectories:
    @pytest.fixture
    def run_dir(self, tmp_path):
        overrides = ["experiment=walk", "num_envs=7", "rewards.terms.tilt_squared.weight=-3"]
        run = build.assemble(config.compose(overrides))
        config.save(run.composed, tmp_path)
        return tmp_path

    def test_a_saved_configuration_is_the_run(self, run_dir):
        run = build.assemble(config.load(run_dir))
        assert run.env.num_envs == 7 and run.env.lidar is None and run.perception is None
        assert run.env.rewards.terms["tilt_squared"].weight == -3

    def test_interpolations_are_saved_as_values(self, run_dir):
        run = build.assemble(config.compose(["lidar.max_range=9.0"]))
        config.save(run.composed, run_dir)
        assert "${" not in (run_dir / config.CONFIG_FILE).read_text()
        assert config.load(run_dir).perception.sampler.max_range == 9.0

    def test_overrides_of_values_and_of_groups(self, run_dir):
        loaded = config.load(run_dir, ["num_envs=3", "obstacles=static", "ppo.max_iterations=5"])
        run = build.assemble(loaded)
        assert run.env.num_envs == 3 and run.ppo.max_iterations == 5
        assert run.env.obstacles.num_obstacles == 8
        assert run.env.rewards.terms["tilt_squared"].weight == -3  # what is not overridden stays the run's

    def test_wrong_overrides_are_named(self, run_dir):
        for override, named in (
            ("ppo.foo=1", "max_iterations"),
            ("foo=1", "num_envs"),
            ("experiment=paper", "keeps its experiment"),
            ("num_envs", "key=value"),
        ):
            with pytest.raises(ConfigError, match=named):
                build.assemble(config.load(run_dir, [override]))

    def test_values_are_replayed_in_hydras_grammar(self, run_dir):
        given = [
            "randomization.latency_s=[0.02,0.02]",
            "rewards.terms.tilt_squared.weight=1e-9",
            "~rewards.terms.yaw_rate_tracking",
        ]
        run = build.assemble(config.load(run_dir, given))
        assert run.env.randomization.latency_s == (0.02, 0.02)
        assert run.env.rewards.terms["tilt_squared"].weight == 1e-9 and "yaw_rate_tracking" not in run.env.rewards.terms

    def test_presets_of_ones_own_are_found_again(self, tmp_path):
        folder = tmp_path / "conf" / "obstacles"
        folder.mkdir(parents=True)
        preset = (config.CONFIG_DIR / "obstacles" / "static.yaml").read_text()
        (folder / "mine.yaml").write_text(f"{preset}shape_seed: 3\n")
        given = [f"hydra.searchpath=['file://{folder.parent}']", "experiment=quickstart"]
        run = build.assemble(config.compose([*given, "obstacles=mine"]))
        assert run.env.obstacles.shape_seed == 3
        config.save(run.composed, tmp_path)
        assert config.load(tmp_path, ["obstacles=mine"]).obstacles.shape_seed == 3
        with pytest.raises(ConfigError, match="obstacles=mine is unknown"):
            config.compose(["obstacles=mine"])

    def test_missing_runs(self, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        with pytest.raises(ConfigError, match=r"train one first"):
            config.find_run("latest")
        with pytest.raises(ConfigError, match="run=latest"):
            config.find_run("nowhere")
        with pytest.raises(ConfigError, match="not a run directory"):
            config.load(tmp_path)

    def test_latest_is_the_newest(self, tmp_path, monkeypatch):
        import os

        monkeypatch.chdir(tmp_path)
        for age, name in ((50, "b"), (10, "a"), (90, "c")):
            config.save({"num_envs": 1}, tmp_path / "outputs" / name)
            path = tmp_path / "outputs" / name / config.CONFIG_FILE
            os.utime(path, (path.stat().st_atime, path.stat().st_mtime - age))
        assert config.find_run("latest") == Path("outputs/a")


@pytest.mark.parametrize("variant", sorted({*config.presets("perception"), *VARIANTS} - {"none", "direct_mlp"}))
def test_every_variant_of_perception_learns_to_avoid(variant):
    """As scripts/ablation.py trains them: the same targets, and the base's motion whichever paths there are."""
    overrides = ("experiment=avoid", *overrides_of(variant), "init=unread", "num_envs=2")
    runner = build_runner(build.assemble(config.compose(overrides)), None)
    with torch.inference_mode():
        actions = runner.policy(runner.env.get_observations())
    assert actions.shape == (2, 12) and torch.isfinite(actions).all()
