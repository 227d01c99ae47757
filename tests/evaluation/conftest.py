"""A small real environment for the evaluation tests."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from omniperception import build, config
from omniperception.env.env import OmniEnv

MakeEnv = Callable[..., OmniEnv]


@pytest.fixture(autouse=True, scope="module")
def one_thread():
    """Tiny tensors: one thread is faster."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="session")
def make_env() -> MakeEnv:
    """Builds an environment from command-line overrides, with all obstacles."""

    def make(*overrides: str) -> OmniEnv:
        run = build.assemble(config.compose(["rewards=default", "perception=none", *overrides]))
        return OmniEnv(replace(run.env, initial_obstacle_level=1.0))

    return make
