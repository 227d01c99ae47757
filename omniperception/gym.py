"""The task as Gymnasium's environments: a vector of many, and a single one; made by `omniperception.make`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cache
from numbers import Integral
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from tensordict import TensorDict

from omniperception import build, config
from omniperception.common.random import MOST_SEEDS
from omniperception.env.env import MAX_ACTION, OmniEnv
from omnirobot.common.errors import ConfigError

if TYPE_CHECKING:
    import gymnasium

Arrays = Literal["numpy", "torch"]
Observation = Any
"""An array (num_envs, width), or a dict of arrays (num_envs, ...)."""

FRAMES = ("frames", "frame_count")
"""What a perception network is shown, under the names of an exported policy's inputs."""


class OmniVectorEnv:
    """`num_envs` robots; `make` gives one that is a `gymnasium.vector.VectorEnv`.

    Observations are the groups of `observations.actor`, concatenated: (num_envs, width). With perception or with the
    critic's groups they are a dict: "observations", "frames" (num_envs, history, points, 3) and "frame_count"
    (num_envs, 1), as an exported policy's inputs, and "critic" (num_envs, width of `observations.critic`).

    An action moves joint targets by `robot.action_scale` times itself from `EnvState.pose`: the default pose, or with
    `stepping` that of the motion. Beyond the action space a target that counts from the default pose lies outside of
    its joint's range; a joint without limits may be moved by pi.

    Finished environments are reset in the same step. `infos` then has "final_obs", like observations, of the moment
    before the reset, valid where "_final_obs" (num_envs,) is true. In every step `infos` has (num_envs,) bools, whether
    an episode ended and why ("fall", "goal", "diverged", "collision_end", "time_out"), and "touched": whether the
    robot touched an obstacle. An episode that ends by "time_out" is truncated, by any other reason terminated.

    Attributes:
        env: the environments behind it.
    """

    single_observation_space: gymnasium.Space
    observation_space: gymnasium.Space
    single_action_space: gymnasium.Space
    action_space: gymnasium.Space

    def __init__(self, env: OmniEnv, arrays: Arrays = "numpy", critic: bool = False) -> None:
        """
        Args:
            env: the environments.
            arrays: "numpy", or "torch" for tensors on the environments' own device, without copies.
            critic: whether observations have what the critic sees.
        """
        if arrays not in ("numpy", "torch"):
            raise ConfigError(f"arrays={arrays} must be numpy or torch")
        from gymnasium.vector.utils import batch_space

        self.env, self.num_envs, self._arrays, self._with_critic = env, env.num_envs, arrays, critic
        self._final: TensorDict | None = None
        self._is_fresh = True
        env.step_hooks.append(self._keep_final)
        self.single_observation_space = self._space(env.get_observations())
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.single_action_space = action_space(env)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """New episodes; see `VectorEnv.reset`.

        Args:
            seed: of all that is drawn from now on; environment k has `seed` + k, or the k-th of several. None: the
                random numbers go on, and no episode repeats another's.
            options: "reset_mask" (num_envs,) bool: which environments; None: all.
        """
        options = options or {}
        if unknown := sorted(options.keys() - {"reset_mask"}):
            raise ConfigError(f"options={unknown} is unknown; known: reset_mask")
        env_ids = self._chosen(options.get("reset_mask"))
        if seed is not None:
            seeds, given = self._seeds(seed, env_ids)
            if len(seeds):
                self.env.reset(env_ids[given], seeds)
            env_ids = env_ids[~given]
        if len(env_ids) and not self._is_fresh:
            self.env.reset(env_ids)
        self._is_fresh = False
        return self._of(self.env.get_observations()), {}

    def step(self, actions: Any) -> tuple[Observation, Any, Any, Any, dict[str, Any]]:
        """One control step with actions (num_envs, num_actions); see `VectorEnv.step`."""
        self._is_fresh = False
        given = torch.as_tensor(actions, dtype=torch.float32, device=self.env.device)
        if given.shape != self.action_space.shape:
            raise ConfigError(f"actions: shape {self.action_space.shape} was expected, {tuple(given.shape)} given")
        observations, rewards, dones, _ = self.env.step(given)
        truncated = self.env.outcomes["time_out"]
        infos = {name: self._array(happened) for name, happened in self.env.outcomes.items()}
        infos["touched"] = self._array(self.env.contacts)
        if self._final is not None:
            infos |= {"final_obs": self._of(self._final), "_final_obs": self._array(dones.bool())}
            self._final = None
        ends = self._array(dones.bool() & ~truncated), self._array(truncated)
        return self._of(observations), self._array(rewards), *ends, infos

    def close_extras(self, **kwargs: Any) -> None:
        """Leaves the environments to whoever else has them."""
        if self._keep_final in self.env.step_hooks:
            self.env.step_hooks.remove(self._keep_final)

    def _keep_final(self) -> None:
        if bool(self.env.done.any()):
            self._final = self.env.final_observations()

    def _chosen(self, mask: Any) -> torch.Tensor:
        """Environments (n,) of a mask (num_envs,), or all."""
        if mask is None:
            return torch.arange(self.num_envs, device=self.env.device)
        chosen = torch.as_tensor(mask, device=self.env.device)
        if chosen.dtype != torch.bool or chosen.shape != (self.num_envs,) or not chosen.any():
            raise ConfigError(f"options: reset_mask must be ({self.num_envs},) bool with at least one true")
        return chosen.nonzero().flatten()

    def _seeds(self, seed: int | Sequence[int | None], env_ids: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Seeds (m,) of those of environments (n,) that get one, and which do (n,) bool."""
        if isinstance(seed, Integral):
            many: list = [int(seed) + k for k in range(self.num_envs)]
        else:
            many = list(seed) if isinstance(seed, Iterable) else []
        if len(many) != self.num_envs or not all(one is None or _is_seed(one) for one in many):
            raise ConfigError(
                f"seed={seed} must be a whole number from 0 to {MOST_SEEDS - 1}, or {self.num_envs} of them or None"
            )
        chosen = [many[k] for k in env_ids.tolist()]
        given = torch.tensor([one is not None for one in chosen], device=env_ids.device)
        seeds = [int(one) for one in chosen if one is not None]
        return torch.tensor(seeds, dtype=torch.int64, device=env_ids.device), given

    def _space(self, observations: TensorDict) -> gymnasium.Space:
        """Space of one environment's observation."""
        from gymnasium.spaces import Dict

        made = self._arranged(observations)
        if isinstance(made, torch.Tensor):
            return _box(made)
        return Dict({name: _box(value, self._most_frames(name)) for name, value in made.items()})

    def _most_frames(self, name: str) -> int | None:
        return self.env.config.frame_history if name == "frame_count" else None

    def _arranged(self, observations: TensorDict) -> torch.Tensor | dict[str, torch.Tensor]:
        """Groups as actor and critic see them."""
        groups = self.env.config.observations
        actor = torch.cat([observations[name] for name in groups.actor], 1)
        made = {"observations": actor} | {name: observations[name] for name in FRAMES if name in observations}
        if self._with_critic:
            made["critic"] = torch.cat([observations[name] for name in groups.critic], 1)
        return made if len(made) > 1 else actor

    def _of(self, observations: TensorDict) -> Observation:
        made = self._arranged(observations)
        if isinstance(made, torch.Tensor):
            return self._array(made)
        return {name: self._array(value.clone()) for name, value in made.items()}  # frames go on to change

    def _array(self, values: torch.Tensor) -> Any:
        return values if self._arrays == "torch" else values.cpu().numpy()


class OmniSingleEnv:
    """One robot; `make_single` gives one that is a `gymnasium.Env`. Observations, actions and info are those of
    `OmniVectorEnv` without the first axis. For checks and small experiments: a vector of many costs little more.

    Attributes:
        vector: the vector of one behind it.
    """

    observation_space: gymnasium.Space
    action_space: gymnasium.Space

    def __init__(self, vector: OmniVectorEnv) -> None:
        """Args: vector: of one environment, in NumPy's arrays."""
        self.vector = vector
        self.observation_space, self.action_space = vector.single_observation_space, vector.single_action_space
        self._next: Observation | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, dict]:
        """A new episode; see `Env.reset`. Without a seed the random numbers go on."""
        if options:
            raise ConfigError(f"options={sorted(options)} is unknown; one robot takes none")
        super().reset(seed=seed)  # type: ignore[misc]  # gymnasium's own generator
        if seed is None and self._next is not None:
            observation, self._next = self._next, None  # it has begun already
            return observation, {}
        self._next = None
        return _first(self.vector.reset(seed=seed)[0]), {}

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict]:
        """One control step with an action (num_actions,); see `Env.step`."""
        observations, rewards, terminated, truncated, infos = self.vector.step(np.asarray(action)[None])
        self._next = None
        if "final_obs" in infos:
            self._next, observations = _first(observations), infos["final_obs"]
        info = {name: bool(value[0]) for name, value in infos.items() if not name.endswith("final_obs")}
        return _first(observations), float(rewards[0]), bool(terminated[0]), bool(truncated[0]), info

    def close(self) -> None:
        self.vector.close_extras()


def make(*overrides: str, num_envs: int | None = None, arrays: Arrays = "numpy", critic: bool = False) -> OmniVectorEnv:
    """A vector of environments; see `OmniVectorEnv`.

    Args:
        overrides: presets and values as on the command line: "experiment=walk", "robot=mine", "sim.num_threads=2".
        num_envs: number of environments; None: the configuration's.
        arrays, critic: see `OmniVectorEnv`.

    Raises:
        ConfigError: one line that says what to change.
    """
    if num_envs is not None and any(text.partition("=")[0].lstrip("+") == "num_envs" for text in overrides):
        raise ConfigError(f"num_envs is given twice, as an override and as num_envs={num_envs}; leave the override out")
    given = (*overrides, *(() if num_envs is None else (f"num_envs={num_envs}",)))
    vector, _ = gymnasium_classes()
    run = build.assemble(config.compose(given))
    build.check_split(run, "training")
    try:
        return vector(OmniEnv(run.env), arrays, critic)
    except (ValueError, ImportError) as error:
        raise ConfigError(str(error)) from error


def make_single(*overrides: str) -> OmniSingleEnv:
    """A single environment with overrides as in `make`; see `OmniSingleEnv`."""
    _, single = gymnasium_classes()
    return single(make(*overrides, num_envs=1))


@cache
def gymnasium_classes() -> tuple[type[OmniVectorEnv], type[OmniSingleEnv]]:
    """Both environments as subclasses of Gymnasium's, which nothing but them needs."""
    try:
        import gymnasium
        from gymnasium.vector import AutoresetMode, VectorEnv
    except ImportError:
        raise ConfigError("omniperception.make needs gymnasium: pip install 'omniperception[gym]'") from None

    class Vector(OmniVectorEnv, VectorEnv):
        __doc__ = OmniVectorEnv.__doc__
        metadata: dict[str, Any] = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}

    class Single(OmniSingleEnv, gymnasium.Env):
        __doc__ = OmniSingleEnv.__doc__
        metadata: dict[str, Any] = {"render_modes": []}

    return Vector, Single


def action_space(env: OmniEnv) -> gymnasium.spaces.Box:
    """Box of one robot's actions; see `OmniVectorEnv`."""
    from gymnasium.spaces import Box

    state = env.state
    down, up = (limit - state.default_joint_pos for limit in (state.joint_lower, state.joint_upper))
    reach = torch.maximum(down.abs(), up.abs())
    most = (torch.where(reach.isfinite(), reach, torch.pi) / state.action_scale).clamp(max=MAX_ACTION).cpu().numpy()
    return Box(-most, most, dtype=np.float32)


def _box(values: torch.Tensor, most: int | None = None) -> gymnasium.spaces.Box:
    """Box of rows of values (num_envs, ...): from 0 to `most`, or of any number."""
    from gymnasium.spaces import Box

    low, high = (-np.inf, np.inf) if most is None else (0, most)
    dtype = np.dtype(str(values.dtype).removeprefix("torch."))
    return Box(low, high, tuple(values.shape[1:]), dtype.type)


def _is_seed(value: object) -> bool:
    return isinstance(value, Integral) and 0 <= int(value) < MOST_SEEDS


def _first(observations: Observation) -> Observation:
    """Observation of the first environment, apart from those of others."""
    if isinstance(observations, dict):
        return {name: value[0].copy() for name, value in observations.items()}
    return observations[0].copy()
