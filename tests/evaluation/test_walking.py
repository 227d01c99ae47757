"""Figures of a gait, against robots whose motion is known, and against a second reckoning step by step."""

import itertools
import math
from dataclasses import replace

import pytest
import torch

from omniperception.env.mdp.commands import SETTLE_S
from omniperception.env.metrics import OUTCOMES
from omniperception.evaluation.report.gaits import Part, grounds, level_table, run_table, walking_table
from omniperception.evaluation.report.records import Record
from omniperception.evaluation.trials.episodes import run_episodes
from omniperception.evaluation.trials.outcomes import Episodes
from omniperception.evaluation.trials.walking import AT_STOP, COLUMNS

BLIND = ("lidar=none", "perception=none", "rewards=walk", "observations=walk", "num_envs=3")


def wave(observations):
    """Legs that swing: not a gait, but feet lift and land."""
    wave.step += 1
    phase = 0.25 * wave.step + math.pi * torch.tensor([0.0, 1.0, 1.0, 0.0]).repeat_interleave(3)
    return (2.0 * torch.sin(phase)).expand(len(observations["command"]), 12)


def swings(steps):
    """Highest rise of each swing of three control steps or more, and the force (N) in the step that ends it."""
    rises, impacts = [], []
    for foot in range(4):
        since = None
        for before, now in itertools.pairwise(range(len(steps))):
            if steps[before]["down"][foot] and not steps[now]["down"][foot]:
                since = now
            if steps[now]["down"][foot] and since is not None:
                if now - since >= 3:
                    heights = [float(step["height"][foot]) for step in steps[since:now]]
                    rises.append(max(heights) - heights[0])
                    impacts.append(float(steps[now]["force"][foot]))
                since = None
    return rises, impacts


@pytest.fixture
def walking_env(make_env):
    wave.step = 0

    def make(*overrides):
        return make_env(
            *BLIND,
            "scenario=walk",
            "terminations.episode_length_s=1.2",
            "terminations.min_base_height=0.01",
            "terminations.max_tilt_deg=179",
            *overrides,
            extra_requirements=("foot_force",),
        )

    return make


def test_figures_are_those_of_a_second_reckoning(walking_env):
    env = walking_env("commands.resample_s=[0.7,0.7]", "randomization=paper")
    limits = torch.tensor([env.robot.torque_limits[name] for name in env.robot.joints])
    steps = []

    def note():
        k, command = env.state.kinematics, env.command
        pos, lower, upper = k.joint_pos, env.state.joint_lower, env.state.joint_upper
        steps.append(
            {
                "trial": env.random.trial.clone(),
                "settled": torch.round(command.age / env.control_dt) >= round(SETTLE_S / env.control_dt),
                "error": (k.base_lin_vel_yaw - command.value[:, :2]).norm(dim=1),
                "yaw": (k.base_ang_vel_b[:, 2] - command.value[:, 2]).abs(),
                "limited": (env.state.joint_torque.abs() > 0.9985 * limits).any(1),
                "stop": ((pos - lower < AT_STOP) | (upper - pos < AT_STOP)).any(1),
                "speed": k.joint_vel.abs().amax(1),
                "down": env.state.foot_contact.clone(),
                "height": env.state.foot_pos_w[..., 2].clone(),
                "force": env.state.foot_force.norm(dim=-1),
                "change": 0.25 * (env.state.actions[0] - env.state.actions[1]).abs().mean(1),
            }
        )

    env.step_hooks.append(note)
    episodes = run_episodes(env, wave, 4)
    found = episodes.walking
    assert set(found) == set(COLUMNS)
    for trial in range(4):
        mine = [{n: v[e] for n, v in step.items()} for step in steps for e in range(3) if step["trial"][e] == trial]
        settled = [step for step in mine if step["settled"]]
        assert found["settled_s"][trial] == pytest.approx(0.02 * len(settled)) and settled

        def mean(name, of):
            return pytest.approx(float(torch.stack([step[name] for step in of]).double().mean()), rel=1e-5)

        assert found["settled_velocity_error"][trial] == mean("error", settled)
        assert found["settled_yaw_rate_error"][trial] == mean("yaw", settled)
        assert found["torque_limited"][trial] == mean("limited", mine)
        assert found["at_stop"][trial] == mean("stop", mine)
        assert found["target_change"][trial] == mean("change", mine)
        assert found["joint_speed"][trial] == pytest.approx(max(float(step["speed"]) for step in mine))
        rises, impacts = swings(mine)
        assert found["swing_height"][trial] == pytest.approx(sum(rises) / len(rises), rel=1e-4)
        weight = 9.81 * float(env.world.model.body_subtreemass[env.world.base_body])
        assert found["impact"][trial] == pytest.approx(sum(impacts) / len(impacts) / weight, rel=1e-3)
    again = Episodes.from_columns(episodes.columns())
    for name, values in found.items():
        torch.testing.assert_close(again.walking[name], values, rtol=1e-4, atol=1e-6, equal_nan=True)


def test_a_robot_that_stands(walking_env):
    env = walking_env("commands.standing=1.0")
    found = run_episodes(env, lambda obs: torch.zeros(3, 12), 3).walking
    assert (found["standing_s"] == found["settled_s"]).all() and (found["standing_s"] > 0.6).all()
    assert (found["standing_speed"] < 0.08).all() and (found["standing_joint_speed"] < 0.2).all()
    assert (found["target_change"] == 0).all() and found["swing_height"].isnan().all()
    assert (found["settled_velocity_error"] == found["standing_speed"]).all()


def test_trials_on_tiles_are_told_apart(walking_env):
    env = walking_env("terrain=mixed", "terminations.episode_length_s=0.1")
    seen = []
    env.step_hooks.append(
        lambda: seen.append((env.random.trial.clone(), env.ground.level.clone(), env.ground.column.clone()))
    )
    episodes = run_episodes(env, wave, 9)
    for trial, level, column in seen:
        for t, row, col in zip(trial.tolist(), level.tolist(), column.tolist(), strict=True):
            if t < 9:
                assert (episodes.walking["level"][t], episodes.walking["tile"][t]) == (row, col)
    facts = {"tile_kinds": list(env.ground.kinds), "overrides": []}
    record = Record("run", "walk", "mixed", "ideal", 1, "dev", "run", "w", 1, facts, episodes)
    parts = grounds(record)
    easy, hard = parts["levels 0 to 4"], parts["levels 5 and above"]
    assert (easy ^ hard).all()
    of_kinds = [there for name, there in parts.items() if "," in name]
    assert sum(int(there.sum()) for there in of_kinds) == 9
    assert sum(len(Part(record, there).fell) for there in of_kinds) == 9
    assert "stairs_up" in walking_table([record]) and "stairs_up" not in level_table([record])
    assert level_table([record]).count("| levels ") == 2 and "| condition" not in level_table([record])
    fell = torch.where(easy, OUTCOMES.index("fall"), OUTCOMES.index("time_out"))
    first = replace(record, episodes=replace(episodes, outcome=fell))
    turned = {name: values.flip(0) for name, values in episodes.walking.items()}  # another seed, with other tiles
    second = replace(first, run="b", episodes=replace(episodes, outcome=fell.flip(0), walking=turned))
    by_run = run_table([first, second])
    apart = [line.split("|") for line in by_run.splitlines() if line.startswith("|")]
    alone = [line.split("|")[2:] for line in level_table([first]).splitlines() if line.startswith("| walk")]
    assert [cells[1].strip() for cells in apart[2:]] == ["run", "run", "b", "b"] and "runs)" not in by_run
    assert [cells[2:] for cells in apart[2:4]] == alone
    lines = [line.split("|") for line in walking_table([first, second]).splitlines() if line.startswith("|")]
    at = [cell.strip() for cell in lines[0]].index("falls, %")
    rows = {cells[2].strip(): cells[at].strip() for cells in lines}
    assert rows["levels 0 to 4"].startswith("100.0") and rows["levels 5 and above"].startswith("0.0")
    none = {**episodes.walking, "standing_s": torch.zeros(9)}  # a seed whose robots never stood still
    still = {**episodes.walking, "standing_s": torch.ones(9), "standing_speed": torch.full((9,), 0.5)}
    for stood, cell in (((none, still), "0.500"), ((none, none), "–")):
        told = [replace(a, episodes=replace(episodes, walking=b)) for a, b in zip((first, second), stood, strict=True)]
        assert walking_table(told).splitlines()[-1].split("|")[-2].strip() == cell
