"""train.py: the configuration is saved first, and a resumed run is the uninterrupted one."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from omniperception import config
from omniperception.learning import load_checkpoint

ROOT = Path(__file__).resolve().parents[1]
SMALL = (
    "num_envs=16",
    "seed=3",
    "ppo.num_steps_per_env=12",
    "ppo.num_learning_epochs=2",
    "ppo.num_mini_batches=2",
    "ppo.hidden_dims=[32,16]",
)
SMALL_CLOUD = ("perception.sampler.num_proximal=8", "perception.history=4")


def train(folder, *arguments):
    command = [sys.executable, str(ROOT / "train.py"), *arguments]
    one_thread = {**os.environ, "OMP_NUM_THREADS": "1"}  # faster for so little
    result = subprocess.run(command, cwd=folder, env=one_thread, capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, result.stderr
    return result.stdout


def checkpoint(folder, run, iteration):
    return load_checkpoint(folder / run / "checkpoints" / f"model_{iteration}.pt")


def test_the_configuration_is_saved_before_anything_uses_it(tmp_path):
    """This run ends while its world is compiled: what it was is on the disk."""
    arguments = ["num_envs=5", "lidar.exclude_geoms=[nose]", "hydra.run.dir=here"]
    command = [sys.executable, str(ROOT / "train.py"), *arguments]
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert result.returncode == 2 and "lidar.exclude_geoms names ['nose']" in result.stderr
    assert "Traceback" not in result.stderr
    saved = config.load(tmp_path / "here")
    assert saved.num_envs == 5 and list(saved.lidar.exclude_geoms) == ["nose"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "recipe",
    [
        ["experiment=walk"],
        ["experiment=quickstart", "randomization=paper", *SMALL_CLOUD],
    ],
    ids=["walk", "quickstart"],
)
def test_a_resumed_run_is_the_uninterrupted_one(tmp_path, recipe):
    train(tmp_path, *recipe, *SMALL, "ppo.max_iterations=4", "hydra.run.dir=whole")
    train(tmp_path, *recipe, *SMALL, "ppo.max_iterations=2", "hydra.run.dir=parts")
    halfway = checkpoint(tmp_path, "parts", 2)
    output = train(tmp_path, "run=parts", "ppo.max_iterations=4")
    assert "after 2 iterations" in output
    whole, parts = checkpoint(tmp_path, "whole", 4), checkpoint(tmp_path, "parts", 4)
    assert whole["iteration"] == parts["iteration"] == 4
    for part in ("actor_state_dict", "critic_state_dict"):
        assert whole[part].keys() == parts[part].keys()
        for name, value in whole[part].items():
            assert torch.equal(value, parts[part][name]), name
    before = halfway["actor_state_dict"]
    assert any(not torch.equal(value, before[name]) for name, value in whole["actor_state_dict"].items())
