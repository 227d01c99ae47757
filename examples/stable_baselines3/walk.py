"""Stable-Baselines3's PPO learns to walk in `omniperception.make(...)`; prints the velocity error before and after."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv, VecNormalize
from torch import nn

import omniperception

RECIPE = ("experiment=walk", "commands.lin_vel_x=[0.3,0.8]", "commands.lin_vel_y=[0,0]", "commands.standing=0.0")


class Adapter(VecEnv):
    """A vector of Gymnasium's as Stable-Baselines3 wants it: one done, and infos by environment."""

    def __init__(self, env: Any) -> None:
        """Args: env: from `omniperception.make`."""
        self.env, self.render_mode = env, None
        self._actions = np.zeros(env.action_space.shape, np.float32)
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> np.ndarray:
        observations, _ = self.env.reset(seed=self._seeds[0])
        self._reset_seeds()
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict]]:
        observations, rewards, terminated, truncated, infos = self.env.step(self._actions)
        by_env: list[dict] = [{} for _ in range(self.num_envs)]
        for k in np.flatnonzero(terminated | truncated):
            by_env[k] = {"terminal_observation": infos["final_obs"][k], "TimeLimit.truncated": bool(truncated[k])}
        return observations, rewards, terminated | truncated, by_env

    def close(self) -> None:
        self.env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list:
        return [getattr(self, attr_name)] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        setattr(self, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list:
        raise NotImplementedError("environments of one vector have no methods of their own")

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        return [False] * self.num_envs


def velocity_error(model: PPO | None, env: VecNormalize, steps: int = 250) -> float:
    """Mean |velocity - command| (m/s) over some seconds of a policy without exploration; None stands still."""
    task, errors, observations = env.venv.env.env, [], env.reset()
    for _ in range(steps):
        still = np.zeros((env.num_envs, *env.action_space.shape), np.float32)
        actions = still if model is None else model.predict(observations, deterministic=True)[0]
        observations, *_ = env.step(actions)
        errors.append(float(task.velocity_error.mean()))
    return float(np.mean(errors))


def learn(num_envs: int, total_steps: int, seed: int, overrides: Sequence[str] = ()) -> tuple[float, float]:
    """Learns, and gives the velocity error (m/s) of standing still and of what was learned."""
    env = VecNormalize(Adapter(omniperception.make(*RECIPE, *overrides, num_envs=num_envs)), norm_reward=False)
    before = velocity_error(None, env)
    model = PPO(
        "MlpPolicy",
        env,
        learning_rate=1e-3,
        n_steps=24,
        batch_size=6 * num_envs,
        n_epochs=5,
        gamma=0.99,
        gae_lambda=0.95,
        ent_coef=0.002,
        target_kl=0.02,
        policy_kwargs={"net_arch": [128, 64], "activation_fn": nn.ELU},
        seed=seed,
        device="cpu",
    )
    model.learn(total_steps)
    env.training = False
    return before, velocity_error(model, env)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--num-envs", type=int, default=256)
    parser.add_argument("--total-steps", type=int, default=3_000_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("overrides", nargs="*", help="such as robot=mine")
    given = parser.parse_args()
    before, after = learn(given.num_envs, given.total_steps, given.seed, given.overrides)
    print(f"velocity error: {before:.3f} m/s when standing still, {after:.3f} m/s with what was learned")
