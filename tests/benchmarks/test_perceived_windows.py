"""What a perception network reads over the windows that it has learned from: counted, and on frames of legs."""

import pytest

from benchmarks.perceived_windows import command
from omniperception.__main__ import main


@pytest.mark.slow
def test_every_checkpoint_has_a_row_for_each_world(tmp_path, capsys):
    words = ["experiment=perceive", "family=[hold,crowd]", "num_envs=6", "sim.num_threads=1", "ppo.num_mini_batches=2"]
    words += ["ppo.num_steps_per_env=8", "lidar.num_rays=200", "ppo.max_iterations=2", "ppo.save_interval=1"]
    main(["train", *words, f"hydra.run.dir={tmp_path / 'perceives'}"])
    capsys.readouterr()
    small = ["num_envs=2", "frames=20", "scenarios=moving", "sim.num_threads=1", "lidar.num_rays=200"]
    command([f"runs={tmp_path / 'perceives'}", f"folder={tmp_path / 'out'}", *small])
    rows = [line.split("|")[1:-1] for line in capsys.readouterr().out.splitlines() if " moving " in line]
    assert [int(row[1]) for row in rows] == [6 * 2, 6 * 2 * 2]  # of 8 steps of 25 ms each fourth has a frame
    assert all(float(row[3]) < 1 and float(row[4]) < 1 for row in rows)
    assert (tmp_path / "out" / "perceived_windows.png").is_file()
