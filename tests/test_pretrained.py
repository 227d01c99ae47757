"""The weights in the repository replay, are small, and say where they come from."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from omniperception import build, config, publish
from omniperception.build import build_runner, load_policy
from omniperception.common import provenance
from omniperception.evaluation.trials.baselines import prepared
from omniperception.evaluation.trials.episodes import run_episodes
from omniperception.learning import latest_checkpoint

sys.path.insert(0, str(Path(__file__).parent))
from own_robots import skip_if_not_there

RUNS = sorted((Path(__file__).resolve().parents[1] / "pretrained").iterdir())


@pytest.mark.parametrize("run_dir", RUNS, ids=lambda path: path.name)
def test_a_pretrained_policy_follows_its_command(run_dir):
    """2.4 s of walking on flat ground; the command's own size is what standing still would miss it by."""
    skip_if_not_there(config.read(run_dir).robot.file, run_dir.name)
    trained = load_policy(
        build.assemble(config.load(run_dir, ["num_envs=8", "terrain=flat", "obstacles=none"])), run_dir
    )
    env, missed, commanded = trained.env, 0.0, 0.0
    with torch.inference_mode():
        for step in range(120):
            env.step(trained.policy(env.get_observations()))
            if step >= 50:
                command = env.command.value[:, :2]
                missed += float((env.state.kinematics.base_lin_vel_yaw[:, :2] - command).norm(dim=1).mean())
                commanded += float(command.norm(dim=1).mean())
    assert missed < 0.6 * commanded


@pytest.mark.slow
def test_what_it_sees_keeps_the_published_policy_from_touching():
    """Of 12 trials among standing obstacles it touches in at least 6 fewer than when it is blind."""
    run_dir, touched = RUNS[-1].with_name("avoider"), []
    overrides = ["scenario=static", "num_envs=12", "terminations.episode_length_s=10.0"]
    run = build.assemble(config.load(run_dir, overrides))
    for name in ("run", "blind"):
        trained = load_policy(replace(run, env=prepared(name, run.env, run.env.lidar)), run_dir)
        episodes = run_episodes(trained.env, trained.policy, 12)
        touched.append(int((episodes.contacts > 0).sum()))
    seeing, unseeing = touched
    assert seeing <= unseeing - 6


@pytest.mark.parametrize("run_dir", RUNS, ids=lambda path: path.name)
def test_it_is_small_and_says_where_it_comes_from(run_dir):
    checkpoint = latest_checkpoint(run_dir)
    assert checkpoint.stat().st_size < 1.1 * publish.LIMIT
    assert set(torch.load(checkpoint, weights_only=True)) >= {"actor_state_dict", "iteration"}
    record = json.loads((run_dir / provenance.FILE).read_text())
    assert record["iterations"] > 0 and record["training_hours"] > 0 and record["versions"]["torch"]


@pytest.mark.slow
def test_a_walk_is_learned(make_config):
    """After 1.2 M steps the velocity error is below 0.3 m/s (0.2 when it was written); standing still gives 0.54."""
    runner = build_runner(make_config("experiment=walk", "num_envs=256", "seed=1"), None)
    step, logs = runner.env.step, []

    def noted(actions):
        result = step(actions)
        logs.append(result[3].get("log", {}))
        return result

    runner.env.step = noted
    runner.learn(200, init_at_random_ep_len=True)
    for name, bar in {"velocity_error": 0.3, "yaw_rate_error": 0.45}.items():
        values = [log[f"Metrics/{name}"] for log in logs if f"Metrics/{name}" in log]
        assert len(values) >= 200 and sum(values[-10:]) / 10 < bar < values[0], name
