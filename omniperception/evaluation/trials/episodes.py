"""Runs a policy for a number of whole trials and measures what happens in them."""

from __future__ import annotations

from collections.abc import Callable

import torch

from omniperception.env.env import OmniEnv, Policy
from omniperception.evaluation.trials.outcomes import Episodes
from omniperception.evaluation.trials.tally import Tally
from omniperception.evaluation.trials.tracks import TrackRecorder


def run_episodes(
    env: OmniEnv,
    policy: Policy,
    num_trials: int,
    on_step: Callable[[], None] | None = None,
    keep_tracks: bool = False,
    on_left: Callable[[int], None] | None = None,
) -> Episodes:
    """Runs trials 0 to num_trials - 1: an environment whose trial has ended takes the next one.

    The scene of a trial depends on its number alone (`TrialRandom`), and every trial that has begun is run to its end.
    So which scenes are measured depends neither on the number of environments nor on the length of other trials. The
    outcomes of a policy that sees do depend on both: frames are cast at the same control steps for all environments,
    wherever their trials are, and each environment draws its own LiDAR noise. An environment that finds no trial left
    goes on unobserved until the last one has ended.

    Args:
        env: freshly built with `EnvConfig.trials`: every environment at the start of its first trial.
        policy: from observations to actions.
        num_trials: number of trials.
        on_step: called after every control step, in which environments that ended have already been reset.
        keep_tracks: whether to keep the robots' ways.
        on_left: called after every control step with the number of trials that have not ended.
    """
    if bool(env.episode_length_buf.any()) or env.step_count:
        raise ValueError("run_episodes needs a freshly built environment; this one has already been stepped")
    tally, clock = Tally(env, num_trials), _StageClock(env)
    tracks = TrackRecorder(env, num_trials) if keep_tracks else None
    recorders = (tally,) if tracks is None else (tally, tracks)
    before = list(env.step_hooks)
    env.step_hooks.extend(recorder.record for recorder in recorders)
    try:
        with torch.no_grad():
            observations = env.get_observations()
            while tally.left:
                fresh = (env.episode_length_buf == 0).nonzero().flatten()
                for recorder in recorders:
                    recorder.begin(fresh)
                with env.timer.stage("policy"):
                    actions = policy(observations)
                observations, _, _, extras = env.step(actions)
                clock.record(extras)
                if on_step is not None:
                    on_step()
                if on_left is not None:
                    on_left(tally.left)
    finally:
        env.step_hooks[:] = before
    return tally.episodes(clock.us_per_env_step(), None if tracks is None else tracks.tracks())


class _StageClock:
    """Sums the environment's stage times; a step with a log has moved its own into the log."""

    def __init__(self, env: OmniEnv) -> None:
        self._env, self._steps = env, 0
        self._us: dict[str, float] = {}
        env.timer.drain()

    def record(self, extras: dict) -> None:
        self._steps += 1
        for stage, seconds in self._env.timer.drain().items():
            self._add(stage, 1e6 * seconds / self._env.num_envs)
        for key, us in extras.get("log", {}).items():
            if key.startswith(_TIME) and key.endswith(_UNIT):
                self._add(key[len(_TIME) : -len(_UNIT)], us * self._env.config.log_interval)

    def us_per_env_step(self) -> dict[str, float]:
        return {stage: us / self._steps for stage, us in self._us.items()}

    def _add(self, stage: str, us: float) -> None:
        self._us[stage] = self._us.get(stage, 0.0) + us


_TIME, _UNIT = "Time/", "_us_per_env_step"
