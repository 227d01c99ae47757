"""A small real environment for the evaluation tests."""

from collections.abc import Callable
from dataclasses import replace

import pytest

from omniperception.env.env import OmniEnv

MakeEnv = Callable[..., OmniEnv]


@pytest.fixture(scope="session")
def make_env(make_config) -> MakeEnv:
    """Builds an environment of trials from command-line overrides, with all obstacles."""

    def make(*overrides: str, trials: bool = True, extra_requirements: tuple[str, ...] = ()) -> OmniEnv:
        run = make_config("rewards=default", "perception=none", *overrides)
        return OmniEnv(replace(run.env, skip_curricula=True, trials=trials, extra_requirements=extra_requirements))

    return make
