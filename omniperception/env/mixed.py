"""Several families of worlds behind one environment: the same robot among other obstacles, led by other commands."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import torch
from tensordict import NonTensorData, TensorDict

from omniperception.env.config import EnvConfig
from omniperception.env.env import OmniEnv, TaskEnv, frame_number
from omniperception.env.mdp.terms import ActorInput, ObservationsConfig

OF_A_FAMILY = ("num_envs", "seed", "obstacles", "commands", "terminations")
"""Fields of EnvConfig in which families may differ."""
_SHOWN = ("goal_rate", "collision_rate", "fall_rate", "time_out_rate", "contact_share", "velocity_error")
"""Metrics that are logged for each family, too."""


class MixedEnv(TaskEnv):
    """Groups of environments, one for each family of worlds, as one behind rsl_rl's VecEnv contract.

    The environments of a family lie side by side, in the order of the families. All step at once and see LiDAR frames
    in the same steps. What happens in a family changes nothing in the others; each has curricula of its own.

    Attributes:
        envs: the families' environments, by name.
        parts: which environments are each family's, by name.
        config: of the first family, with the number of all environments.
        max_episode_length: (num_envs,) int64 control steps.
        state: takes estimates and velocities that a policy asks for, for all.
        step_hooks: called at the end of each step, before finished environments are reset.
    """

    def __init__(self, families: Mapping[str, EnvConfig]) -> None:
        """
        Args:
            families: the tasks by name; they differ in `OF_A_FAMILY` alone.

        Raises:
            ValueError: they differ in more, or in the widths of observations.
        """
        check_alike(families)
        first = next(iter(families.values()))
        self.num_envs = sum(config.num_envs for config in families.values())
        self.config = replace(first, num_envs=self.num_envs)
        self.device = first.sim.torch_device
        bounds = [0, *torch.tensor([config.num_envs for config in families.values()]).cumsum(0).tolist()]
        self.parts = {name: slice(*ends) for name, ends in zip(families, pairwise(bounds), strict=True)}
        self._episode_length = torch.zeros(self.num_envs, dtype=torch.int64, device=self.device)
        self.envs = {name: OmniEnv(families[name], self._episode_length[part]) for name, part in self.parts.items()}
        self._check_widths()
        self.device = next(self._each()).device
        self.robot, self.num_actions = first.robot, first.num_actions
        self.control_dt = first.sim.control_dt
        self.max_episode_length = torch.empty_like(self._episode_length)
        for name, part in self.parts.items():
            self.max_episode_length[part] = self.envs[name].max_episode_length
        self.state = _PolicySources(self)
        self.step_hooks: list[Callable[[], None]] = []
        self._frames: tuple[tuple[int, ...], torch.Tensor] | None = None
        self.observations = self._join([env.get_observations() for env in self._each()])

    # ---- rsl_rl's contract -------------------------------------------------------------------------------------------

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict]:
        """One control step with actions (num_envs, num_actions) of all families; see rsl_rl.env.VecEnv."""
        rewards = [env.advance(actions[self.parts[name]]) for name, env in self.envs.items()]
        for hook in self.step_hooks:
            hook()
        ends = [env.conclude(reward) for env, reward in zip(self._each(), rewards, strict=True)]
        observations, all_rewards, dones, extras = zip(*ends, strict=True)
        self.observations = self._join(observations)
        joined: dict = {"time_outs": torch.cat([extra["time_outs"] for extra in extras])}
        if "log" in extras[0]:
            joined["log"] = self._merge([extra["log"] for extra in extras])
        return self.observations, torch.cat(all_rewards), torch.cat(dones), joined

    def final_observations(self) -> TensorDict:
        """Observations at the end of a step before finished environments are reset; call it from a step hook."""
        return self._join([env.final_observations() for env in self._each()])

    def _each(self) -> Iterator[OmniEnv]:
        return iter(self.envs.values())

    def _join(self, observations: Sequence[TensorDict]) -> TensorDict:
        """Observations of all families, in their order."""
        groups: dict[str, torch.Tensor | NonTensorData] = {}
        for name in map(str, observations[0].keys()):
            own = [part[name] for part in observations]
            if name == "frame_tick":
                groups[name] = frame_number(own[0], self.num_envs, self.device)
            else:
                groups[name] = self._joined_frames(own) if name == "frames" else torch.cat(own)
        return TensorDict(groups, batch_size=[self.num_envs], device=self.device)

    def _joined_frames(self, own: Sequence[torch.Tensor]) -> torch.Tensor:
        """The families' frames, the same tensor until one of them has others."""
        histories = [env.sensing.history for env in self._each() if env.sensing is not None]
        versions = tuple(history.version for history in histories if history is not None)
        if self._frames is None or self._frames[0] != versions:
            self._frames = versions, torch.cat(list(own))
        return self._frames[1]

    def _merge(self, logs: Sequence[Mapping[str, float]]) -> dict[str, float]:
        """Logs of all families in one: counts of anomalies are added, of the rest means over the environments of the
        families that have it; what `_SHOWN` names, for each family besides."""
        merged: dict[str, float] = {}
        weights = [env.num_envs for env in self._each()]
        for key in dict.fromkeys(key for log in logs for key in log):
            there = [(log[key], weight) for log, weight in zip(logs, weights, strict=True) if key in log]
            total = sum(value * weight for value, weight in there)
            counts = key.startswith("Anomalies/")
            merged[key] = sum(v for v, _ in there) if counts else total / sum(weight for _, weight in there)
        for family, log in zip(self.envs, logs, strict=True):
            own = {name: log[f"Metrics/{name}"] for name in _SHOWN if f"Metrics/{name}" in log}
            merged |= {f"Families/{family}_{name}": value for name, value in own.items()}
        return merged

    # ---- for runners -------------------------------------------------------------------------------------------------

    @property
    def curriculum_levels(self) -> tuple[float, ...]:
        """How far the families' curricula are, family by family; see `OmniEnv.curriculum_levels`."""
        return tuple(level for env in self._each() for level in env.curriculum_levels)

    @curriculum_levels.setter
    def curriculum_levels(self, levels: Sequence[float]) -> None:
        left = list(levels)
        for env in self._each():
            own = len(env.curriculum_levels)
            env.curriculum_levels, left = left[:own], left[own:]

    def observation_widths(self, group: str) -> dict[str, int]:
        """Numbers of each term of an observation group, in order, per control step; the same in all families."""
        return next(self._each()).observation_widths(group)

    def actor_inputs(self, observations: ObservationsConfig) -> list[ActorInput]:
        """What the one-dimensional inputs of an actor with such observations are here; see `OmniEnv.actor_inputs`."""
        return next(self._each()).actor_inputs(observations)

    @property
    def observes_command(self) -> bool:
        """Whether a group holds the command of the present alone, so that another can be observed in its place."""
        return next(self._each()).observes_command

    def terms_not_finite(self, name: str, env_id: int) -> list[str]:
        """Terms of "rewards", or of an observation group, that are not finite for an environment."""
        family = next(family for family, part in self.parts.items() if env_id < part.stop)
        return self.envs[family].terms_not_finite(name, env_id - self.parts[family].start)

    def state_dict(self) -> dict:
        """State that an exact resume needs."""
        return {"families": {name: env.state_dict() for name, env in self.envs.items()}}

    def load_state_dict(self, state: dict) -> None:
        """Resumes from the `state_dict` of an environment with the same families."""
        for name, env in self.envs.items():
            env.load_state_dict(state["families"][name])
        self.observations = self._join([env.get_observations() for env in self._each()])

    def begin_at_levels_of(self, state: dict) -> None:
        """Begins new episodes at the levels that the curricula have in the `state_dict` of another task: those of the
        family of the same name, or where it has none, of its first."""
        for name, env in self.envs.items():
            env.begin_at_levels_of(state.get("families", {}).get(name, state))
        self.observations = self._join([env.get_observations() for env in self._each()])

    def _check_widths(self) -> None:
        """Refuses families whose observations have other widths."""
        (first, known), *others = (
            (name, {group: env.observation_widths(group) for group in env.config.observations.groups})
            for name, env in self.envs.items()
        )
        for name, widths in others:
            for group, terms in widths.items():
                for term, width in terms.items():
                    if width != known[group][term]:
                        raise ValueError(
                            f"families.{name}: observations.groups.{group}.terms.{term} has {width} numbers, and"
                            f" {known[group][term]} in {first}; give its family as many obstacles as it observes, or"
                            " leave the term out"
                        )


class _PolicySources:
    """Hands what a policy computes for all environments to the states of the families."""

    def __init__(self, env: MixedEnv) -> None:
        self._env = env

    def measure_velocity_by(self, source: Callable[[], torch.Tensor | None]) -> None:
        """See `EnvState.measure_velocity_by`."""
        for name, env in self._env.envs.items():
            env.state.measure_velocity_by(_part_of(source, self._env.parts[name]))

    def ask_by(self, source: Callable[[], torch.Tensor | None]) -> None:
        """See `EnvState.ask_by`."""
        for name, env in self._env.envs.items():
            env.state.ask_by(_part_of(source, self._env.parts[name]))


def _part_of(source: Callable[[], torch.Tensor | None], part: slice) -> Callable[[], torch.Tensor | None]:
    """A source of some of the environments."""

    def of_part() -> torch.Tensor | None:
        values = source()
        return None if values is None else values[part]

    return of_part


def families_of(env: OmniEnv | MixedEnv) -> Mapping[str, OmniEnv]:
    """The families' environments by name; one without a name where there are no families."""
    return env.envs if isinstance(env, MixedEnv) else {"": env}


def shares_of(shares: Mapping[str, float], num_envs: int) -> dict[str, int]:
    """How many of `num_envs` environments each family has: by its share (Sainte-Lague), and at least one.

    Raises:
        ValueError: there are fewer environments than families.
    """
    if num_envs < len(shares):
        raise ValueError(f"num_envs={num_envs} gives {len(shares)} families fewer than one environment each; raise it")
    given = dict.fromkeys(shares, 1)
    for _ in range(num_envs - len(shares)):
        given[max(shares, key=lambda name: shares[name] / (2 * given[name] + 1))] += 1
    return given


def check_alike(families: Mapping[str, EnvConfig]) -> None:
    """Refuses families that differ in what all must have in common.

    Raises:
        ValueError: one line that says what differs.
    """
    (first, common), *others = families.items()
    for name, config in others:
        here = {field: getattr(config, field) for field in OF_A_FAMILY}
        if replace(common, **here) != config:
            raise ValueError(f"families.{name} differs from {first} in more than {', '.join(OF_A_FAMILY)}")
    for name, config in families.items():
        if config.obstacles.curriculum is not None:
            raise ValueError(
                f"families.{name}.obstacles.curriculum: all families see LiDAR frames in the same steps, so obstacles"
                f" are there from the first one on; give families.{name}.obstacles.curriculum=null"
            )
