"""Sweeps and run directories: configurations are composed, saved and replayed."""

import os
from dataclasses import dataclass
from pathlib import Path

import pytest
import yaml

from omniperception import build, config, training
from omniperception.commands import main, train
from omniperception.common import provenance
from omniperception.common.checked import Positive, checked
from omniperception.config import ConfigError


def test_every_job_of_a_sweep_is_checked_before_the_first_starts(monkeypatch):
    monkeypatch.setattr(training, "train", lambda *_: pytest.fail("a job began"))
    with pytest.raises(ConfigError, match="num_envs=0"):
        train.start(["-m"], ["num_envs=2,0"])


@checked("walls")
class Walls:
    thickness: Positive


class TestSubclassesOfWhatIsChecked:
    @pytest.mark.parametrize("decorate", [lambda cls: cls, checked("walls")], ids=("undecorated", "checked"))
    def test_they_keep_the_bounds_of_their_base_and_have_their_own(self, decorate):
        @decorate
        class High(Walls):
            height: Positive = 2.0

        assert High(0.2) == High(thickness=0.2, height=2.0) != High(0.2, 1.0)
        for wrong, message in (((-1.0,), "walls.thickness=-1.0"), ((0.2, 0.0), "walls.height=0.0")):
            with pytest.raises(ValueError, match=f"^{message} must be positive$"):
                High(*wrong)

    def test_a_plain_dataclass_is_refused(self):
        with pytest.raises(TypeError):

            @dataclass(frozen=True)
            class High(Walls):
                height: float = 2.0


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
        (folder / "mine.yaml").write_text(f"{preset}spacing: 0.3\n")
        given = [f"hydra.searchpath=['file://{folder.parent}']", "experiment=quickstart"]
        run = build.assemble(config.compose([*given, "obstacles=mine"]))
        assert run.env.obstacles.spacing == 0.3
        config.save(run.composed, tmp_path)
        assert config.load(tmp_path, ["obstacles=mine"]).obstacles.spacing == 0.3
        with pytest.raises(ConfigError, match="obstacles=mine is unknown"):
            config.compose(["obstacles=mine"])

    @pytest.mark.parametrize(
        ("change", "named"),
        [
            (lambda saved: saved["robot"].update(shape_seed=3), r"robot\.shape_seed is unknown"),
            (lambda saved: saved["robot"].pop("footing"), r"robot lacks footing"),
            (lambda saved: saved["robot"].update(foot_geoms=4), r"robot\.foot_geoms=4 must be"),
            (
                lambda saved: saved["rewards"]["terms"].update(grace={"weight": 1.0}),
                r"rewards\.terms\.grace is unknown",
            ),
            (lambda saved: saved.update(sensors={}), r"sensors is unknown"),
            (lambda saved: saved.pop("terrain"), r"the configuration has no terrain"),
            (lambda saved: saved.pop("logger"), r"the configuration has no logger"),
        ],
    )
    def test_a_run_of_another_version_is_said_to_be_one(self, run_dir, change, named, capsys):
        path = run_dir / config.CONFIG_FILE
        saved = yaml.safe_load(path.read_text())
        change(saved)
        path.write_text(config.as_yaml(saved))
        with pytest.raises(ConfigError, match=rf"of another version.*{named}.*train again.* no commit is noted"):
            build.load_run(run_dir)
        provenance.write(run_dir, {"commit": "0123abc"})
        with pytest.raises(ConfigError, match=rf"of another version.*{named}.*train again.*: commit 0123abc$"):
            build.load_run(run_dir, ["num_envs=0"])
        with pytest.raises(SystemExit, match="2"):
            main(["play", f"run={run_dir}"])
        error = capsys.readouterr().err
        assert "of another version" in error and error.count("\n") == 1

    def test_faults_of_overrides_are_told_as_such(self, run_dir):
        for override in ("robot.shape_seed=3", "num_envs=0", "~robot.footing"):
            with pytest.raises(ConfigError) as error:
                build.load_run(run_dir, [override])
            assert "version" not in str(error.value)

    def test_a_file_without_a_key_that_has_a_default_takes_it(self, run_dir):
        path = run_dir / config.CONFIG_FILE
        saved = yaml.safe_load(path.read_text())
        del saved["stepping"]
        path.write_text(config.as_yaml(saved))
        assert build.load_run(run_dir).env.stepping is None
        assert build.load_run(run_dir, ["+stepping={lift: 1.2, rest_s: 1.0}"]).env.stepping.lift == 1.2

    def test_latest_is_the_newest(self, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        for age, name in ((50, "b"), (10, "a"), (90, "c"), (5, "failed")):
            config.save({"num_envs": 1}, tmp_path / "outputs" / name)
            (tmp_path / "outputs" / name / "checkpoints").mkdir()
            if name != "failed":
                (tmp_path / "outputs" / name / "checkpoints" / "model_1.pt").touch()
            path = tmp_path / "outputs" / name / config.CONFIG_FILE
            os.utime(path, (path.stat().st_atime, path.stat().st_mtime - age))
        assert config.find_run("latest") == Path("outputs/a")


def test_what_has_no_checkpoint_has_not_begun(tmp_path):
    config.save({"num_envs": 1}, tmp_path)
    assert not config.is_begun(tmp_path, {"num_envs": 2})
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "model_1.pt").touch()
    assert config.is_begun(tmp_path, {"num_envs": 1})
    with pytest.raises(ConfigError, match="holds a run of another configuration"):
        config.is_begun(tmp_path, {"num_envs": 2})


@pytest.mark.parametrize("text", ["a: [", "[1]", "a: b"])
def test_damaged_files_of_a_run_are_named(tmp_path, text):
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "model_1.pt").touch()
    (tmp_path / config.CONFIG_FILE).write_text("a: [")
    with pytest.raises(ConfigError, match=rf"{config.CONFIG_FILE} is not a configuration"):
        config.is_begun(tmp_path, {"num_envs": 1})
    (tmp_path / config.RECIPE_FILE).write_text(text)
    with pytest.raises(ConfigError, match=rf"{config.RECIPE_FILE} holds no overrides"):
        config.read_recipe(tmp_path)


def test_what_comes_with_the_package_is_found_from_any_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert (config.find_run("pretrained/gait") / config.CONFIG_FILE).is_file()
    with pytest.raises(ConfigError, match="run=pretrained/gate does not exist"):
        config.find_run("pretrained/gate")
    (tmp_path / "pretrained" / "gait").mkdir(parents=True)
    assert config.find_run("pretrained/gait") == Path("pretrained/gait")  # one's own comes first


def test_a_preset_that_lies_in_the_working_directory_says_how_it_is_found(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "conf" / "robot").mkdir(parents=True)
    (tmp_path / "conf" / "robot" / "mine.yaml").write_text("file: mine.xml\n")
    with pytest.raises(ConfigError, match=r"robot=mine is unknown; .*; .* with --config-dir conf$"):
        config.compose(["robot=mine"])
    with pytest.raises(ConfigError, match=r"robot=yours is unknown; known: [a-z0-9_, ]*$"):
        config.compose(["robot=yours"])


class TestOfARobotsVelocities:
    """Of a robot that shall walk at half the Go2's 2 m/s and turn at a third of its 1.5 rad/s."""

    def gait(self, *overrides):
        composed = build._resolved(config.compose(["experiment=gait", *overrides]))
        terms = composed["rewards"]["terms"]
        shown = {name: terms[name] for name in ("velocity_tracking", "yaw_rate_tracking")}
        weights = [terms[name]["weight"] for name in ("velocity_error", "yaw_rate_error")]
        levels = [composed[group]["curriculum"]["max_velocity_error"] for group in ("commands", "randomization")]
        return [term["beta"] for term in shown.values()], weights, levels

    def test_a_go2_has_the_numbers_that_are_written(self):
        assert self.gait() == ([4.0, 4.0], [-1.0, -0.5], [0.4, 0.4])

    def test_errors_count_as_shares_of_what_is_asked_for(self):
        """exp(-beta e^2) is the same for half an error, and so is weight times error."""
        slow = self.gait("robot.gait.lin_vel_x=[-1,0.5]", "robot.gait.ang_vel_z=[-0.5,0.5]")
        assert slow == ([pytest.approx(16.0), pytest.approx(36.0)], [-2.0, pytest.approx(-1.5)], [0.2, 0.2])

    def test_slower_worlds_stay_within_what_the_robot_is_for(self):
        commands = build._resolved(config.compose(["scenario=walk_slowly", "robot.gait.lin_vel_x=[-0.2,3]"]))[
            "commands"
        ]
        assert commands["lin_vel_x"] == [-0.2, 1.0] and commands["lin_vel_y"] == [-1.0, 1.0]

    def test_a_robot_that_shall_not_move_is_refused_in_one_line(self):
        with pytest.raises(
            ConfigError, match="lin_vel_x and ang_vel_z of the robot's gait must reach beyond 0"
        ) as error:
            self.gait("robot.gait.lin_vel_x=[0,0]")
        assert "\n" not in str(error.value)
        for wrong in ("1.0", "null", "[]", "[a,b]"):
            with pytest.raises(ConfigError, match=r"of the robot's gait must be \[least, most\], not "):
                self.gait(f"robot.gait.lin_vel_x={wrong}")
