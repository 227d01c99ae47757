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
    seen = {**dict(observations.items()), "reward": reward, "done": done, "time_outs": extras["time_outs"]}
    return {name: value[env_ids].clone() for name, value in {**seen, "qpos": env.sim.qpos}.items()}, extras


def assert_equal(a, b):
    assert a.keys() == b.keys()
    for name in a:
        assert torch.equal(a[name], b[name]), name
