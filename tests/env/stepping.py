"""Steps of environments that tests compare."""

import torch

OTHERS = [0, 2, 3]
"""Those of four environments that nothing is done to; a test disturbs environment 1."""
FULL = (
    "obstacles=moving",
    "randomization=paper",
    "perception=pd_risknet",
    "rewards=paper",
    "lidar.num_rays=200",
    "lidar.period_s=0.04",
)
SIMS = {"mujoco": ("sim=mujoco",), "mujoco_warp": ("sim=mujoco_warp", "sim.device=cpu")}


def random_actions(env, steps, seed=0, scale=1.0):
    generator = torch.Generator().manual_seed(seed)
    return scale * torch.randn(steps, env.num_envs, env.num_actions, generator=generator)


def still(env):
    return torch.zeros(env.num_envs, env.num_actions)


def outcome(env, action, env_ids=slice(None)):
    """What a step gives to the named environments."""
    observations, reward, done, extras = env.step(action)
    seen = {**tensors(observations), "reward": reward, "done": done, "time_outs": extras["time_outs"]}
    return {name: value[env_ids].clone() for name, value in {**seen, "qpos": env.sim.qpos}.items()}, extras


def tensors(observations):
    """Observations by name, without the number of the newest frame, which no two environments have in common."""
    return {name: value for name, value in observations.items() if isinstance(value, torch.Tensor)}


def assert_equal(a, b):
    assert a.keys() == b.keys()
    for name in a:
        assert torch.equal(a[name], b[name]), name


def assert_same(a, b, path=""):
    if isinstance(a, torch.Tensor):
        assert torch.equal(a, b), path
    elif isinstance(a, dict | list | tuple):
        pairs = a.items() if isinstance(a, dict) else enumerate(a)
        for key, value in pairs:
            assert_same(value, b[key], f"{path}/{key}")
    else:
        assert a == b, path
