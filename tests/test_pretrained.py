"""The weights in the repository replay, are small, and say where they come from."""

import json
from pathlib import Path

import pytest
import torch

from omniperception import build, config
from omniperception.build import load_policy
from omniperception.deploy import publish
from omniperception.learning import latest_checkpoint

RUNS = sorted((Path(__file__).resolve().parents[1] / "pretrained").iterdir())


@pytest.mark.parametrize("run_dir", RUNS, ids=lambda path: path.name)
def test_a_pretrained_policy_walks_on(run_dir):
    trained = load_policy(build.assemble(config.load(run_dir, ["num_envs=4", "terrain=flat"])), run_dir)
    env = trained.env
    with torch.inference_mode():
        for _ in range(100):  # 2 s
            env.step(trained.policy(env.get_observations()))
    assert float(env.base_height.median()) > 0.2 and not env.sim.failed.any()


@pytest.mark.parametrize("run_dir", RUNS, ids=lambda path: path.name)
def test_it_is_small_and_says_where_it_comes_from(run_dir):
    checkpoint = latest_checkpoint(run_dir)
    assert checkpoint.stat().st_size < 1.1 * publish.LIMIT
    assert set(torch.load(checkpoint, weights_only=True)) >= {"actor_state_dict", "iteration"}
    record = json.loads((run_dir / publish.PROVENANCE).read_text())
    assert record["iterations"] > 0 and record["training_hours"] > 0 and record["versions"]["torch"]
