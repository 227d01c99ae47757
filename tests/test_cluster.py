"""Many processes: torchrun trains one policy with train.py, and a sweep is sent to submitit's local executor."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from omniperception import config

ROOT = Path(__file__).resolve().parents[1]
TINY = ("experiment=walk", "num_envs=4", "ppo.num_steps_per_env=4", "ppo.num_mini_batches=1", "ppo.hidden_dims=[16]")


def run(folder, *command):
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, *command], cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


@pytest.mark.slow
def test_torchrun_trains_one_run_and_one_process_or_two_resume_it(tmp_path):
    torchrun = ("-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2", str(ROOT / "train.py"))
    output = run(tmp_path, *torchrun, *TINY, "ppo.max_iterations=1")
    assert output.count("run directory") == output.count("completed: 1 iterations") == 1
    (saved,) = tmp_path.glob(f"outputs/*/*/{config.CONFIG_FILE}")
    folder = saved.parent
    assert len(list(folder.glob("events.*"))) == 1 and (folder / "checkpoints" / "model_1.pt").is_file()
    output = run(tmp_path, str(ROOT / "train.py"), f"run={folder.relative_to(tmp_path)}", "ppo.max_iterations=2")
    assert "after 1 iterations" in output and (folder / "checkpoints" / "model_2.pt").is_file()
    output = run(tmp_path, *torchrun, f"run={folder.relative_to(tmp_path)}", "ppo.max_iterations=3")
    assert "after 2 iterations" in output and (folder / "checkpoints" / "model_3.pt").is_file()


@pytest.mark.slow
def test_a_sweep_goes_to_submitits_local_executor(tmp_path):
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    sweep = ("seed=1,2", "hydra/launcher=submitit_local", "hydra.sweep.dir=sweep", "ppo.max_iterations=1")
    run(tmp_path, str(ROOT / "train.py"), "-m", *TINY, *sweep)
    jobs = sorted(saved.parent for saved in (tmp_path / "sweep").glob(f"*/{config.CONFIG_FILE}"))
    assert [config.load(job).seed for job in jobs] == [1, 2]
    assert all((job / "checkpoints" / "model_1.pt").is_file() for job in jobs)
