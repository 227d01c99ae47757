"""The conditions: their frozen values, how they are chosen, and what a run records."""

from dataclasses import asdict

import pytest

from omniperception import build, config
from omniperception.config import ConfigError
from omniperception.env.mdp.randomization import Condition, RandomizationConfig

NOTHING = {
    "lidar_device": False,
    "lidar_measured": False,
    "lidar_mask": None,
    "lidar_distance": None,
    "lidar_gaussian": None,
    "lidar_jitter": None,
    "lidar_dropout": None,
    "lidar_mixed": None,
    "added_mass": None,
    "payload_mass": None,
    "com_x": None,
    "com_y": None,
    "com_z": None,
    "ground_friction": None,
    "ground_restitution": None,
    "motor_strength": None,
    "joint_offset": None,
    "gravity_offset": None,
    "latency_s": None,
    "payload_position": (0.0, 0.0, 0.1),
    "velocity_scale": None,
    "velocity_drift": None,
    "gyro_bias": None,
    "gyro_noise": None,
    "attitude_bias_deg": None,
    "attitude_noise_deg": None,
    "joint_pos_noise": None,
    "joint_vel_noise": None,
    "frames_lost": None,
    "frames_late_s": None,
    "partial_frames": None,
    "pushes": None,
    "curriculum": None,
}
PAPER = NOTHING | {
    "lidar_mask": {"ratio": 0.1, "low": 0.0, "high": 0.3},
    "lidar_distance": {"ratio": 0.1},
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
ROBOT = PAPER | {
    "lidar_device": True,
    "velocity_scale": (0.95, 1.05),
    "velocity_drift": {"sd": 0.05, "time_s": 10.0},
    "gyro_bias": (-0.02, 0.02),
    "gyro_noise": (-0.2, 0.2),
    "attitude_bias_deg": (-1.0, 1.0),
    "attitude_noise_deg": (-0.5, 0.5),
    "joint_pos_noise": (-0.01, 0.01),
    "joint_vel_noise": (-1.5, 1.5),
    "frames_lost": 0.05,
    "frames_late_s": (0.0, 0.1),
    "pushes": {"every_s": (5.0, 10.0), "speed": 0.5},
}
FAULTS = ROBOT | {
    "partial_frames": {
        "every_s": (2.0, 6.0),
        "lasts_s": (0.2, 2.0),
        "kinds": ("sector", "thin", "slice", "wedge"),
        "width_deg": (40.0, 180.0),
        "keep": 0.1,
    }
}
FROZEN = {"ideal": (1, NOTHING), "paper": (2, PAPER), "robot": (2, ROBOT), "faults": (1, FAULTS)}
"""Version and values of each condition. Results under one name and version are compared with each other."""


def values(randomization: RandomizationConfig) -> dict:
    return asdict(randomization)


def test_every_condition_is_frozen():
    assert set(config.presets("condition")) == set(FROZEN)


@pytest.mark.parametrize("name", FROZEN)
def test_its_values_are_those_of_its_version(make_config, name):
    version, expected = FROZEN[name]
    run = make_config(f"condition={name}")
    assert run.condition is not None and run.condition.name == name
    found = (run.condition.version, values(run.env.randomization))
    assert found == (version, expected), (
        f"conf/condition/{name}.yaml is frozen: its values changed -> raise its version, here too;"
        " results under the old version are no longer comparable with new ones"
    )


@pytest.mark.parametrize("recipe", ["quickstart", "paper"])
@pytest.mark.parametrize("scenario", ["corridor", "rod"])
def test_it_wins_over_recipe_and_scenario(make_config, recipe, scenario):
    run = make_config(f"experiment={recipe}", "init=unread", f"scenario={scenario}", "condition=robot")
    assert values(run.env.randomization) == ROBOT
    alone = make_config(f"experiment={recipe}", "init=unread")
    without = make_config(f"experiment={recipe}", "init=unread", f"scenario={scenario}")
    assert without.condition is None and without.env.randomization == alone.env.randomization


def test_it_wins_over_the_curriculum_of_a_recipe(make_config):
    assert make_config("experiment=gait").env.randomization.curriculum is not None
    assert values(make_config("experiment=gait", "condition=robot").env.randomization) == ROBOT


def test_it_wins_over_the_body_of_a_recipe_of_ones_own(make_config, tmp_path):
    (tmp_path / "experiment").mkdir()
    body = "# @package _global_\nrandomization: {added_mass: [0.0, 0.5], latency_s: null, curriculum: null}\n"
    (tmp_path / "experiment" / "mine.yaml").write_text(body)
    run = make_config(f"hydra.searchpath=['file://{tmp_path}']", "experiment=mine", "condition=robot")
    assert run.condition == Condition("robot", 2) and values(run.env.randomization) == ROBOT


def test_no_scenario_chooses_the_randomization(make_config):
    ideal = make_config().env.randomization
    assert all(make_config(f"scenario={name}").env.randomization == ideal for name in config.presets("scenario"))


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (
            ["condition=robot", "randomization=none"],
            "condition=robot fixes the randomization; use ~condition",
        ),
        (["condition=ideal", "randomization.frames_lost=0.1"], "condition=ideal fixes the randomization"),
        (["condition=robot", "condition.version=2"], "condition.version=2: a condition is chosen as a whole"),
        (["condition=rob"], "condition=rob is unknown; did you mean robot?"),
    ],
)
def test_a_condition_cannot_be_changed(overrides, message, tmp_path):
    config.save(build.assemble(config.compose(["experiment=walk"])).composed, tmp_path)
    for choose in (config.compose, lambda given: config.load(tmp_path, given)):
        with pytest.raises(ConfigError) as caught:
            choose(overrides)
        assert message in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("field", "message"), [({"version": 0}, "version=0"), ({"name": ""}, "text that is not empty")]
)
def test_a_condition_has_a_name_and_a_version(field, message):
    with pytest.raises(ValueError, match=message):
        Condition(**({"name": "robot", "version": 1} | field))


class TestRunDirectories:
    @pytest.fixture
    def run_dir(self, tmp_path):
        config.save(build.assemble(config.compose(["experiment=quickstart", "condition=robot"])).composed, tmp_path)
        return tmp_path

    def test_a_run_records_its_condition(self, run_dir):
        run = build.assemble(config.load(run_dir))
        assert run.condition == Condition("robot", 2) and values(run.env.randomization) == ROBOT

    def test_another_condition_replaces_it(self, run_dir):
        run = build.assemble(config.load(run_dir, ["scenario=rod", "condition=paper"]))
        assert run.condition == Condition("paper", 2) and values(run.env.randomization) == PAPER

    @pytest.mark.parametrize("change", ["randomization=lidar", "randomization.frames_lost=0.2"])
    def test_another_randomization_is_no_condition(self, run_dir, change):
        run = build.assemble(config.load(run_dir, [change]))
        assert run.condition is None and values(run.env.randomization) != ROBOT

    def test_none_keeps_the_randomization(self, run_dir):
        run = build.assemble(config.load(run_dir, ["~condition"]))
        assert run.condition is None and values(run.env.randomization) == ROBOT
        run = build.assemble(config.load(run_dir, ["~condition", "randomization=none"]))
        assert run.condition is None and values(run.env.randomization) == NOTHING


def test_a_trial_is_the_same_scene_in_every_condition(make_env):
    """The same starts, goals and obstacles, in the first episode and in a later one, whatever is drawn beside them."""
    scenes = []
    for name in FROZEN:
        env = make_env("scenario=moving", f"condition={name}", "lidar.num_rays=100", "perception=none", num_envs=3)
        seen = []
        for _ in range(2):
            field = env.obstacles
            seen += [env.sim.qpos[:, :7].clone(), env.command.goal_w.clone(), field.pos_w.clone(), field.size.clone()]
            for _ in range(3):
                env.step(0.1 * env.observations["privileged"].new_ones(3, 12))
            env.episode_length_buf[:] = env.max_episode_length
            env.step(0.1 * env.observations["privileged"].new_ones(3, 12))
        scenes.append(seen)
    for other in scenes[1:]:
        assert all((a == b).all() for a, b in zip(scenes[0], other, strict=True))
    assert not (scenes[0][0] == scenes[0][4]).all()
