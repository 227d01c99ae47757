"""Runs with random weights, and what scripts/export.py makes of them."""

import functools
from pathlib import Path

import pytest
import torch

from omniperception import config
from omniperception.assembly import build_runner
from omniperception.export import Export, export
from omniperception.learning.checkpoint import checkpoint_path

SMALL = ("num_envs=2", "ppo.hidden_dims=[32,16]", "seed=3")
RECIPES = {
    "none": ("experiment=walk",),
    "fps_mlp": ("perception=fps_mlp", "perception.sampler.num_points=64", "observations=paper"),
    "fps_gru": ("perception=fps_gru", "perception.sampler.num_points=64"),
    "direct_mlp": ("perception=direct_mlp", "perception.history=3"),
    "pd_risknet": ("perception=pd_risknet", "obstacles=static"),
    "pd_risknet_small": ("perception=pd_risknet_small", "randomization=paper"),
}


@pytest.fixture(autouse=True, scope="module")
def one_thread():
    """Tiny tensors: one thread is faster."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def stir(actor):
    """Weights and statistics as after training: nothing is zero, what is seen matters, actions stay small."""
    torch.manual_seed(0)
    with torch.no_grad():
        for name, parameter in actor.named_parameters():
            if "std" not in name:
                parameter.add_(torch.randn_like(parameter) * (0.3 * parameter.std() if parameter.std() > 0 else 0.05))
        actor.mlp[0].weight[:, actor.obs_dim :] = 0.2 * torch.randn_like(actor.mlp[0].weight[:, actor.obs_dim :])
        actor.obs_normalizer._mean.add_(0.1 * torch.randn_like(actor.obs_normalizer._mean))
        actor.obs_normalizer._std.copy_(0.5 + torch.rand_like(actor.obs_normalizer._std))


@pytest.fixture(scope="session")
def exported_run(tmp_path_factory):
    """Run directory of a recipe, with a checkpoint and the exported policy in it."""

    @functools.cache
    def make(recipe: str) -> Path:
        run_dir = tmp_path_factory.mktemp(recipe)
        run = config.assemble(config.compose([*RECIPES[recipe], *SMALL]))
        config.save(run.composed, run_dir)
        runner = build_runner(run, run_dir)
        stir(runner.alg.actor)
        runner.save(str(checkpoint_path(run_dir, 7)))
        export(Export(run_dir))
        return run_dir

    return make
