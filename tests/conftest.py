"""Fixtures shared by all tests."""

from pathlib import Path

import pytest
import torch

from omniperception import build, config
from omniperception.env.env import OmniEnv

BLIND = ("perception=none", "lidar=none", "rewards=walk", "observations=walk")
"""Overrides of a run without LiDAR."""


@pytest.fixture(scope="session")
def make_env():
    """Builds a real environment from overrides on the command line; `blind=True` leaves the LiDAR out."""

    def make(*overrides: str, num_envs: int = 4, blind: bool = False) -> OmniEnv:
        given = (*(BLIND if blind else ()), *overrides, f"num_envs={num_envs}")
        return OmniEnv(build.assemble(config.compose(given)).env)

    return make


@pytest.fixture(scope="session")
def make_config():
    """Assembles a configuration from overrides on the command line."""
    return lambda *overrides: build.assemble(config.compose(overrides))


@pytest.fixture(autouse=True, scope="module")
def one_thread(request):
    """Tiny tensors: one thread is faster, and its sums are those of the process that resumes."""
    if not {"learning", "deploy", "evaluation"} & set(Path(request.path).parts):
        yield
        return
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
