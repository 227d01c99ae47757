"""Two processes that learn one policy over gloo: equal weights, own environments, one log, any number resumes."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from toy_env import ToyEnv, config

from omniperception.learning import Runner, latest_checkpoint, list_checkpoints

HERE = Path(__file__).parent


def torchrun(script, *arguments, processes=2):
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(HERE), *filter(None, sys.path)]),
        "OMP_NUM_THREADS": "1",
    }
    command = [
        sys.executable,
        "-m",
        "torch.distributed.run",
        "--standalone",
        f"--nproc-per-node={processes}",
        str(script),
    ]
    done = subprocess.run([*command, *map(str, arguments)], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


def ended(folder):
    return [torch.load(folder / f"{rank}.pt", weights_only=True) for rank in (0, 1)]


def assert_same(first, second):
    for model in first:
        assert first[model].keys() == second[model].keys()
        for name in first[model]:
            assert torch.equal(first[model][name], second[model][name]), name


@pytest.mark.slow
def test_two_processes_learn_one_policy(tmp_path):
    """All that they exchange after the first step is gradients and the sums behind the statistics of observations."""
    torchrun(HERE / "rank_process.py", tmp_path / "run", 3, tmp_path)
    first, second = ended(tmp_path)
    assert_same(first["parameters"], second["parameters"])
    assert_same(first["buffers"], second["buffers"])
    assert not torch.equal(first["position"], second["position"])
    assert first["level"] == second["level"] == 0.5
    assert len(list((tmp_path / "run").glob("events.*"))) == 1
    assert [path.name for path in list_checkpoints(tmp_path / "run")] == ["model_3.pt"]

    alone = Runner(ToyEnv(seed=5), config(supervised=True), str(tmp_path / "run"))
    alone.load(str(latest_checkpoint(tmp_path / "run")))
    assert_same({"actor": dict(alone.alg.actor.named_parameters())}, {"actor": first["parameters"]["actor"]})
    alone.learn(1)
    assert latest_checkpoint(tmp_path / "run").name == "model_4.pt"

    torchrun(HERE / "rank_process.py", tmp_path / "run", 2, tmp_path)
    first, second = ended(tmp_path)
    assert first["iteration"] == second["iteration"] == 6
    assert_same(first["parameters"], second["parameters"])
    assert_same(first["buffers"], second["buffers"])
    assert not torch.equal(first["position"], second["position"])
