"""Fixtures shared by all tests."""

import logging
from pathlib import Path

import pytest
import torch

from omniperception import build, config
from omniperception.env.env import OmniEnv

BLIND = ("perception=none", "lidar=none", "rewards=walk", "observations=walk")
"""Overrides of a run without LiDAR."""


def pytest_configure(config):
    config.option.randomly_reset_seed = False  # the order is drawn, numbers are the same in any: see below


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    build.seed_everything(0)
    logging.root.setLevel(logging.WARNING)  # a sweep of another test may have let Hydra silence all
    for logger in list(logging.Logger.manager.loggerDict.values()):
        if isinstance(logger, logging.Logger):
            logger.disabled = False


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_call(item):
    build.seed_everything(0)


def pytest_terminal_summary(terminalreporter, config):
    seed = getattr(config.option, "randomly_seed", None)  # of pytest-randomly
    if seed is not None:
        terminalreporter.line(f'the order was drawn; the same again: make test ARGS="--randomly-seed={seed}"')


@pytest.fixture(scope="session")
def make_env():
    """Builds a real environment from overrides on the command line; `blind=True` leaves the LiDAR out."""

    def make(*overrides: str, num_envs: int = 4, blind: bool = False) -> OmniEnv:
        given = (*(BLIND if blind else ()), *overrides, f"num_envs={num_envs}")
        return OmniEnv(assembled(*given).env)

    return make


@pytest.fixture(scope="session")
def make_config():
    """Assembles a configuration from overrides on the command line."""
    return assembled


def assembled(*overrides: str) -> build.RunConfig:
    """A configuration of presets, without a recipe where none is given."""
    plain = () if any(override.startswith("experiment=") for override in overrides) else ("~experiment",)
    return build.assemble(config.compose((*plain, *overrides)))


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


INTEGRATION = (
    *("benchmarks", "evaluation", "learning/test_runner.py", "test_*.py"),
    *(f"env/test_{name}.py" for name in ("devices", "frame_delivery", "isolation", "joint_order", "sensing")),
)
"""Tests of whole runs and commands, which `make test-fast` leaves out; of the top folder all but UNITS."""
UNITS = ("test_cli.py", "test_conditions.py", "test_config.py")


def pytest_collection_modifyitems(items):
    here = Path(__file__).parent
    whole = {path for pattern in INTEGRATION for path in here.glob(pattern)} - {here / name for name in UNITS}
    for item in items:
        if whole & {item.path, *item.path.parents}:
            item.add_marker("integration")
