"""Trains the PPO of Stable-Baselines3 to walk, in environments of `omniperception.make`.

pip install -e '.[train,gym]' stable-baselines3    # in a checkout
python examples/stable_baselines3_walk.py --steps 1500000 --num-envs 256

A test has it learn for a few steps. These 1.5 million take six minutes of one core (Intel Xeon; Stable-Baselines3
2.9.2): episodes of 977 of the 1000 steps and a return of 46, where the first 120,000 had 328 and 1.3.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv, VecMonitor, VecNormalize

import omniperception

STEPS = 24
"""Control steps of a roll-out."""


class Robots(VecEnv):
    """`omniperception.make` as Stable-Baselines3 asks for many environments: finished ones begin again by themselves,
    and the last observation of an episode is in its `info`."""

    def __init__(self, env: Any) -> None:
        """Args: env: of `omniperception.make`, in NumPy's arrays, whose observations are one array."""
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)
        self.env, self._actions = env, np.zeros(env.action_space.shape, np.float32)

    def reset(self) -> np.ndarray:
        """(num_envs, width); environment k has the seed that was given plus k, in both libraries."""
        observations, _ = self.env.reset(seed=self._seeds[0])
        self._reset_seeds()
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict]]:
        observations, rewards, terminated, truncated, infos = self.env.step(self._actions)
        dones, told = terminated | truncated, [{} for _ in range(self.num_envs)]
        for k in dones.nonzero()[0]:
            told[k] = {"terminal_observation": infos["final_obs"][k], "TimeLimit.truncated": bool(truncated[k])}
        return observations, rewards, dones, told

    def close(self) -> None:
        self.env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list:
        return [getattr(self.env, attr_name, None)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise NotImplementedError("all robots are one object; give overrides to omniperception.make")

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list:
        raise NotImplementedError("all robots are one object; call robots.env")

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False] * len(list(self._get_indices(indices)))


def learn(steps: int, num_envs: int, *overrides: str) -> PPO:
    """Trains for so many steps of all robots together; prints mean length and reward of the last 100 episodes."""
    robots = Robots(omniperception.make("experiment=walk", *overrides, num_envs=num_envs))
    ppo = PPO(
        "MlpPolicy",
        VecNormalize(VecMonitor(robots), norm_reward=False),
        n_steps=STEPS,
        batch_size=STEPS * num_envs // 4,
        n_epochs=4,
        learning_rate=1e-3,
        target_kl=0.03,
        policy_kwargs={"net_arch": [128, 128], "activation_fn": torch.nn.ELU},
        seed=1,
        verbose=1,
    )
    return ppo.learn(steps, log_interval=20)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=1_500_000)
    parser.add_argument("--num-envs", type=int, default=256)
    given = parser.parse_args()
    torch.set_num_threads(1)
    learn(given.steps, given.num_envs, "sim.num_threads=1").save("walk_by_stable_baselines3")
