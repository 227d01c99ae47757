"""The whole task on a device: on the CPU in every run of the tests, on a GPU where there is one."""

import copy
import math
import warnings
from dataclasses import replace

import pytest
import torch
from stepping import random_actions, tensors

from omniperception import build, config
from omniperception.build import build_runner
from omniperception.env.env import OmniEnv

TASKS = {
    "paper": ("experiment=paper",),
    "avoid": ("experiment=avoid", "terrain=mixed", "randomization=paper", "lidar.cloud_mb=0.02"),
}
SIZES = ("num_envs=6", "lidar.num_rays=200", "ppo.num_steps_per_env=6", "ppo.num_mini_batches=2", "seed=3")
OTHERS = [0, 1, 3, 4, 5]


@pytest.fixture(
    params=[
        "cpu",
        pytest.param(
            "cuda:0",
            marks=(pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")),
        ),
    ]
)
def device(request):
    return request.param


@pytest.fixture(params=TASKS)
def run(request, device):
    overrides = ("sim=mujoco_warp", f"sim.device={device}", "sim.deterministic=true", *SIZES)
    run = build.assemble(config.compose([*TASKS[request.param], *overrides]))
    return replace(run, env=replace(run.env, skip_curricula=True))


def actions(env, steps):
    return random_actions(env, steps, seed=4, scale=0.3).to(env.device)


def seen(env, action):
    """What a step gives, all of it on the environment's device."""
    observations, rewards, dones, _ = env.step(action)
    given = {**tensors(observations), "r": rewards, "d": dones}
    assert {str(value.device) for value in given.values()} == {env.config.sim.device}
    return {name: value.cpu() for name, value in given.items()}


def test_a_step_that_resets_is_that_of_the_cpu(run):
    """Two control steps; afterwards, rounding makes robots in contact part."""
    env = OmniEnv(run.env)
    reference = OmniEnv(replace(run.env, sim=replace(run.env.sim, device="cpu")))
    for step, action in enumerate(actions(env, 2)):
        for each in (env, reference):
            each.episode_length_buf[step] = each.max_episode_length - 1
        found, expected = seen(env, action), seen(reference, action.cpu())
        for name, value in expected.items():
            if name == "frames":  # which point is the farthest can hang on the last bit
                near = (found[name] - value).abs().amax(-1) < 5e-3
                assert near.float().mean() > 0.9
                continue
            tolerance = {"rtol": 1e-3, "atol": 5e-3} if value.is_floating_point() else {"rtol": 0, "atol": 0}
            torch.testing.assert_close(found[name].cpu(), value, **tolerance)


def test_a_broken_environment_changes_nothing_in_the_others(run):
    quiet, disturbed = OmniEnv(run.env), OmniEnv(run.env)
    for step, action in enumerate(actions(quiet, 8)):
        if step == 3:
            disturbed.sim.qvel[2, 4] = math.nan
        expected, found = seen(quiet, action), seen(disturbed, action)
        for name, value in expected.items():
            assert torch.equal(value[OTHERS], found[name][OTHERS]), (step, name)
    assert disturbed.episode_length_buf.tolist()[2] == 4


def test_a_saved_state_goes_on_bit_for_bit(run):
    whole, resumed = OmniEnv(run.env), OmniEnv(run.env)
    given = actions(whole, 13)
    for action in given[:6]:
        whole.step(action)
    resumed.load_state_dict(copy.deepcopy(whole.state_dict()))
    for step, action in enumerate(given[6:]):
        expected, found = seen(whole, action), seen(resumed, action)
        for name, value in expected.items():
            assert torch.equal(value, found[name]), (step, name)


def test_it_learns(run, device, tmp_path):
    runner = build_runner(run, tmp_path)
    before = [p.detach().clone() for p in runner.alg._raw_actor.parameters()]
    runner.learn(2)
    after = list(runner.alg._raw_actor.parameters())
    assert all(torch.isfinite(p).all() for p in after) and {str(p.device) for p in after} == {device}
    assert any(not torch.equal(a, b) for a, b in zip(before, after, strict=True))


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("task", TASKS)
def test_a_step_synchronises_the_host_only_to_count_environments(task):
    """At most three times, as PyTorch sees it: see test_host_synchronisation.py, which asks the same on a CPU."""
    overrides = (*TASKS[task], "sim=mujoco_warp", "sim.device=cuda:0", *SIZES)
    env = OmniEnv(replace(build.assemble(config.compose(overrides)).env, log_interval=10**9))
    given = actions(env, 20)
    for action in given[:10]:
        env.step(action)
    torch.cuda.set_sync_debug_mode("warn")
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            for action in given[10:]:
                env.step(action)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert len([w for w in caught if "synchroniz" in str(w.message)]) <= 3 * 10
