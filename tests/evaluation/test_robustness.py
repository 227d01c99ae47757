"""Ranges are stretched as they should be, and kicks hit whom, when and where they should."""

from pathlib import Path

import pytest
import torch
import yaml

from omniperception import config
from omniperception.commands.gait import kicks_table
from omniperception.config import ConfigError
from omniperception.evaluation.gait.kicks import AFTER_S, KickResults, Kicks
from omniperception.evaluation.gait.robustness import measure, rows_of_the_robot, stretched, stretches
from omniperception.evaluation.suite import Evaluation, World
from omniperception.scene.build import FOOT_FORCE


@pytest.mark.parametrize(
    ("row", "value", "factor", "expected"),
    [
        ("latency_s", [0.005, 0.045], 3.0, [0.015, 0.135]),
        ("motor_strength", [0.8, 1.2], 2.0, [0.6, 1.4]),
        ("ground_friction", [0.4, 1.0], 0.5, [0.6, 0.9]),
        ("ground_friction", [0.4, 1.0], 3.0, [0.05, 1.4]),  # friction cannot be negative
        ("ground_restitution", [0.0, 1.0], 2.0, [0.0, 1.0]),
        ("pushes", {"every_s": [5.0, 10.0], "speed": 0.5}, 2.0, {"every_s": [5.0, 10.0], "speed": 1.0}),
        ("velocity_drift", {"sd": 0.05, "time_s": 10.0}, 3.0, {"sd": 0.15, "time_s": 10.0}),
        ("velocity_scale", [0.95, 1.05], 25.0, [0.0, 2.25]),  # nor a factor on what is measured
        ("frames_lost", 0.05, 25.0, 0.99),
    ],
)
def test_a_range_is_stretched_about_what_is_normal(row, value, factor, expected):
    key, _, text = stretched(row, value, factor).partition("=")
    assert key == f"randomization.{row}"
    found = yaml.safe_load(text.replace(":", ": ").replace(",", ", "))
    if isinstance(expected, dict):
        assert found.keys() == expected.keys() and all(found[k] == pytest.approx(v) for k, v in expected.items())
    else:
        assert found == pytest.approx(expected)
    config.compose([stretched(row, value, factor)])  # Hydra takes it


def test_a_range_that_ends_where_it_did_is_not_measured_again():
    evaluation = Evaluation(runs=[config.find_run("pretrained/gait")], worlds=[World("walk")])
    found = stretches(evaluation, "robot", ("ground_restitution", "ground_friction"), (3.0, 1.0, 2.0, 1.0))
    rows = [(one.row, one.factor) for one in found]
    assert rows == [
        ("", 0.0),
        ("ground_restitution", 1.0),
        *(("ground_friction", factor) for factor in (1.0, 2.0, 3.0)),
    ]
    with pytest.raises(ConfigError, match="factors=-1,2 must not be negative"):
        stretches(evaluation, "robot", ("ground_friction",), (-1.0, 2.0))


def test_what_cannot_be_stretched_so_far_is_refused_before_anything_is_measured():
    evaluation = Evaluation(runs=[config.find_run("pretrained/gait")], worlds=[World("walk")], trials=2)
    with pytest.raises(ConfigError, match="must keep a positive mass"):
        measure(stretches(evaluation, "robot", ("ground_friction", "added_mass"), (1.0, 20.0)))


def test_ranges_may_be_those_of_a_preset_of_ones_own(tmp_path):
    (tmp_path / "randomization").mkdir()
    text = "defaults: [none, _self_]\nadded_mass: [-2.0, 2.0]\n"
    (tmp_path / "randomization" / "mine.yaml").write_text(text)
    assert rows_of_the_robot("mine", [tmp_path]) == ("added_mass",)
    rows = rows_of_the_robot("robot")
    assert {"latency_s", "joint_offset", "motor_strength", "pushes", "gyro_bias"} <= set(rows)
    assert not [row for row in rows if "lidar" in row or "frames" in row] and not rows_of_the_robot("none")
    overrides = tuple(config.as_override([tmp_path]))
    evaluation = Evaluation([Path("pretrained/gait")], [World("walk")], overrides=overrides)
    (_, stretch) = stretches(evaluation, "mine", ["added_mass"], [0.5])
    assert list(stretch.task.composed["randomization"]["added_mass"]) == [-1.0, 1.0]
    with pytest.raises(ConfigError, match="randomization=mine is unknown"):
        rows_of_the_robot("mine")


def test_a_kick_changes_one_velocity_once(make_env):
    blind = ("lidar=none", "perception=none", "rewards=walk", "observations=walk", "num_envs=3")
    env = make_env(*blind, "scenario=walk", "terminations.episode_length_s=8", extra_requirements=(FOOT_FORCE,))
    kicks = Kicks(env, torch.tensor([[1.0, 0.0], [0.0, 0.5]]))  # the third trial has none
    env.pushes = kicks
    due = round(AFTER_S / env.control_dt)
    for step in (due - 1, due, due + 1):
        env.episode_length_buf[:] = step
        before, yaw = env.sim.qvel[:, :2].clone(), env.state.kinematics.yaw.double()
        kicks.advance()
        change = env.sim.qvel[:, :2] - before
        if step != due:
            assert not change.any()
            continue
        cos, sin = yaw.cos(), yaw.sin()
        expected = torch.stack(
            (torch.stack((cos[0], sin[0])), 0.5 * torch.stack((-sin[1], cos[1])), torch.zeros(2).double())
        )
        torch.testing.assert_close(change.double(), expected, atol=1e-6, rtol=0)


def test_shares_are_of_those_that_still_walked():
    speed = torch.ones(4)
    kicked, survived = torch.tensor([True, True, False, True]), torch.tensor([True, False, False, True])
    results = KickResults(speed, kicked, survived)
    assert results.rate(1.0)["rate"] == pytest.approx(2 / 3)
    assert results.shares([1.0], 2).tolist() == [[1.0, 0.5]]
    assert results.rate(2.0) is None and "| 2         | –" in kicks_table(results, (1.0, 2.0))
