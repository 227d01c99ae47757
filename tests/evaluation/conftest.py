"""A small real environment for the evaluation tests."""

from collections.abc import Callable
from dataclasses import replace

import pytest

from omniperception import build, config
from omniperception.env.env import OmniEnv

MakeEnv = Callable[..., OmniEnv]


@pytest.fixture(scope="session")
def make_env() -> MakeEnv:
    """Builds an environment of trials from command-line overrides, with all obstacles."""

    def make(*overrides: str, trials: bool = True, extra_requirements: tuple[str, ...] = ()) -> OmniEnv:
        plain = [] if any(override.startswith("experiment=") for override in overrides) else ["~experiment"]
        run = build.assemble(config.compose([*plain, "rewards=default", "perception=none", *overrides]))
        return OmniEnv(replace(run.env, skip_curricula=True, trials=trials, extra_requirements=extra_requirements))

    return make
