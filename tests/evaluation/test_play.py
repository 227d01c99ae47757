"""The play command."""

import json

import imageio_ffmpeg
import pytest
import torch

from omniperception import build, config
from omniperception.build import build_runner
from omniperception.commands import main

SMALL = ("experiment=walk", "num_envs=4", "ppo.num_steps_per_env=4", "ppo.num_mini_batches=1")


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory):
    """A run of one iteration."""
    path = tmp_path_factory.mktemp("run")
    run = build.assemble(config.compose(SMALL))
    config.save(run.composed, path)
    build_runner(run, path).learn(1)
    return path


@pytest.mark.slow
def test_a_run_is_replayed(run_dir, capsys, monkeypatch):
    monkeypatch.setattr("omniperception.commands.play.INTERVAL_S", 0.0)
    overrides = ("num_envs=3", "terminations.episode_length_s=0.3")
    main(["play", f"run={run_dir}", "trials=6", "video_s=0.2", *overrides])
    printed = capsys.readouterr().out
    assert "success" in printed and "us" in printed
    assert "0 of 6 trials have ended after 0 s" in printed and "6 of 6 trials have ended" in printed
    report = json.loads((run_dir / "replay.json").read_text())
    assert report["trials"] == 6 and report["checkpoint"] == "model_1.pt" and report["num_envs"] == 3
    assert report["overrides"] == list(overrides)
    assert report["rates"]["success"]["count"] + report["rates"]["fall"]["count"] == 6
    assert imageio_ffmpeg.count_frames_and_secs(str(run_dir / "replay.mp4"))[0] == 5
    assert (run_dir / "replay.png").is_file()


def test_replaying_does_not_change_the_policy(run_dir):
    run = build.assemble(config.compose(SMALL))
    runner = build_runner(run, None)
    runner.load_policy(run_dir / "checkpoints" / "model_1.pt")
    policy = runner.policy
    before = {name: value.clone() for name, value in policy.state_dict().items()}
    with torch.no_grad():
        for _ in range(3):
            runner.env.step(policy(runner.env.get_observations()))
    assert all(torch.equal(before[name], value) for name, value in policy.state_dict().items())
    assert any(name.endswith("_mean") for name in before)  # the observation normaliser is part of it
