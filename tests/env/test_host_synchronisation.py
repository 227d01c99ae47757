"""A control step synchronises the host with the device only to count environments; shown on a CPU by operators."""

import traceback
from collections import Counter
from pathlib import Path

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

import omniperception

PACKAGE = Path(omniperception.__file__).parent
NEEDS_HOST = {"nonzero", "_local_scalar_dense", "is_nonzero", "equal", "bincount", "masked_select", "_unique2"}
"""Operators whose result has a size, or is a number, that the host has to know."""
BY_MASK = {"index", "index_put", "index_put_", "_index_put_impl_"}
WRITES = BY_MASK - {"index"}
ON_WARP = ("sim=mujoco_warp", "sim.device=cpu")


class Synchronisations(TorchDispatchMode):
    """Counts, by file of the package, the operators that synchronise the host with a GPU."""

    def __init__(self):
        super().__init__()
        self.files = Counter()

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = func.overloadpacket.__name__
        by_mask = name in BY_MASK and any(i is not None and i.dtype == torch.bool for i in args[1])
        of_a_number = name in WRITES and args[2].dim() == 0  # x[ids] = 0.0 copies the number to the device and waits
        if name in NEEDS_HOST or by_mask or of_a_number:
            last = [frame for frame in traceback.extract_stack() if Path(frame.filename).is_relative_to(PACKAGE)][-1]
            if 'self.device.type == "cpu" and' not in (last.line or ""):  # a GPU is not asked
                self.files[str(Path(last.filename).relative_to(PACKAGE))] += 1
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize(
    ("overrides", "times"),
    [
        (("experiment=walk", "randomization=paper"), 2),
        (("experiment=avoid", "terrain=mixed", "lidar.num_rays=100", "randomization=paper"), 3),
        (("experiment=avoid", "terrain=flat", "lidar.num_rays=100", "randomization=robot"), 3),
        (("experiment=avoid", "scenario=people", "lidar.num_rays=100"), 2),
    ],
)
def test_a_step_counts_environments_and_nothing_else(make_env, overrides, times):
    """Those that end, those whose command is drawn again, and those where an approaching obstacle has passed or a
    wandering one chooses again."""
    env = make_env(*overrides, *ON_WARP)
    if env.obstacles is not None:
        env.obstacles.level = 1.0
    env.step(torch.zeros(4, 12))
    ends = 0
    with Synchronisations() as found:
        for step in range(10):
            two = torch.tensor([step % 4, (step + 1) % 4])  # values of a single environment look like a number
            env.episode_length_buf.index_fill_(0, two, env.max_episode_length - 1)
            ends += int(env.step(torch.randn(4, 12))[2].numpy().sum())
    assert ends >= 20 and sum(found.files.values()) == 10 * times, found.files
