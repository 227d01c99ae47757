"""How launches are divided among CPU threads."""

import os
import subprocess
import sys
import time

import pytest
import torch
import warp as wp

from omnilidar import launch
from omnilidar.launch import MIN_CHUNK_WORK, SplitLaunch, default_num_threads, split


@pytest.mark.parametrize(("num_envs", "work", "threads"), [(1, 1, 2), (7, MIN_CHUNK_WORK, 2), (1000, 500, 3)])
def test_every_environment_is_in_one_chunk(num_envs, work, threads):
    chunks = split(num_envs, work, threads)
    assert [env for first, count in chunks for env in range(first, first + count)] == list(range(num_envs))
    assert all(count > 0 for _, count in chunks)


@pytest.mark.parametrize(("processes", "expected"), [(None, 4), ("1", 4), ("2", 2), ("3", 1), ("16", 1)])
def test_processes_of_one_machine_share_its_cores(monkeypatch, processes, expected):
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {0, 1, 2, 5}, raising=False)
    if processes is None:
        monkeypatch.delenv("LOCAL_WORLD_SIZE", raising=False)
    else:
        monkeypatch.setenv("LOCAL_WORLD_SIZE", processes)
    assert default_num_threads() == expected


@wp.kernel(module="unique", enable_backward=False)
def count_up(env_offset: int, values: wp.array(dtype=int)):
    values[env_offset + wp.tid()] = env_offset + wp.tid()


def test_compiling_is_said_once(monkeypatch, tmp_path, capfd):
    """A kernel that no cache has takes longer than a hundredth of a second."""
    monkeypatch.setattr(launch, "SAY_AFTER_S", 0.01)
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    values = wp.zeros(3, dtype=int, device="cpu")
    assert count_up.module not in launch._launched
    for _ in range(2):
        SplitLaunch(count_up, 3, (), (values,), torch.device("cpu"), 1)()
        time.sleep(0.05)
    assert values.numpy().tolist() == [0, 1, 2]
    assert capfd.readouterr().err.count("compiling count_up for 0.01 s and more, once on this machine") == 1


FORKED = """
import os
import numpy as np
from omnilidar import RayScene, Shape, ShapeKind
scene = RayScene([Shape(ShapeKind.PLANE)], 64, 0, num_threads=2)
origins, down = np.full((64, 2000, 3), [0.0, 0.0, 2.0]), np.full((64, 2000, 3), [0.0, 0.0, -1.0])
scene.cast(origins, down)
child = os.fork()
if not child:
    os._exit(int(scene.cast(origins, down).ranges[0, 0]))
print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
def test_a_forked_process_casts_after_its_parent_did():
    """A child has none of its parent's threads: loaders of data and vector environments fork."""
    done = subprocess.run([sys.executable, "-c", FORKED], capture_output=True, text=True, timeout=120)
    assert done.stdout.split()[-1:] == ["2"], done.stderr
