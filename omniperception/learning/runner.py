"""The training loop: collect, update, log, save, and resume bit for bit."""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import torch
from rsl_rl.models import MLPModel
from tensordict import TensorDict

from omniperception.env.env import OmniEnv
from omniperception.env.mdp.terms import ActorInput, ObservationsConfig, first_difference
from omniperception.env.mixed import MixedEnv
from omniperception.env.state import UndeclaredQuantity
from omniperception.learning import distributed
from omniperception.learning.checkpoint import (
    CheckpointError,
    checkpoint_path,
    difference,
    latest_checkpoint,
    load_checkpoint,
    prune_checkpoints,
    rng_state,
    save_checkpoint,
    set_rng_state,
)
from omniperception.learning.config import LearningConfig
from omniperception.learning.divergence import TrainingDiverged
from omniperception.learning.estimator import estimates_velocity
from omniperception.learning.logger import Logger
from omniperception.learning.ppo import PerceptivePpo
from omniperception.learning.warm_start import estimating, start_from, take_parts
from omnirobot.common.errors import one_line


class Runner:
    """Trains a policy: rsl_rl's runner with atomic checkpoints, exact resume, a wall-time budget and a compact log.

    Started by torchrun, every process trains in environments of its own and all have the same weights and curriculum.
    The first one logs and saves; a checkpoint goes on with any number of processes, exactly with the one that saved it.

    A resumed run continues exactly (on the CPU bit for bit) if the environment has ``state_dict`` and
    ``load_state_dict`` that cover everything a step depends on, and if ``get_observations`` repeats the
    current observations without drawing random numbers.

    Attributes:
        env: the environments.
        alg: the algorithm with its models and storage.
        current_learning_iteration: completed iterations.
        total_time: seconds of training, all resumed runs together.
        step_hooks: called after each control step.
        end_hooks: called when learning ends, before the log is closed.
        stop_reason: why the last :meth:`learn` ended: "completed" or "time budget".
    """

    def __init__(
        self, env: OmniEnv | MixedEnv, config: LearningConfig, log_dir: Path | None = None, device: str = "cpu"
    ) -> None:
        """Build models, algorithm and log.

        Args:
            env: the environments.
            config: what learns, and how.
            log_dir: run directory; None writes nothing.
            device: of models and storage.
        """
        distributed.connect(device)
        self.env, self.config, self.device = env, config, device
        self.alg = PerceptivePpo(env, config, device, distributed.multi_gpu())
        actor = self.alg.actor
        if config.estimator is not None and estimates_velocity(env.config.observations):
            env.state.measure_velocity_by(lambda: actor.estimate)
        if config.max_change is not None:
            env.state.ask_by(lambda: actor.asked)
        log_dir = Path(log_dir) if log_dir is not None and distributed.rank() == 0 else None
        self.logger = Logger(log_dir, env.num_envs, device, config.logger, config.settings)
        self.step_hooks: list[Callable[[], None]] = []
        self.end_hooks: list[Callable[[], None]] = []
        self.current_learning_iteration = 0
        self.total_time = 0.0
        self.stop_reason = ""
        self._interrupted = False
        self._last_saved: Path | None = None

    def learn(self, num_learning_iterations: int, init_at_random_ep_len: bool = False) -> None:
        """Train for a number of iterations beyond the completed ones, or until the time budget is spent.

        A first Ctrl-C, SIGTERM or SIGHUP finishes the iteration, saves and raises ``KeyboardInterrupt``; a second
        Ctrl-C does not wait.

        Args:
            num_learning_iterations: iterations to add.
            init_at_random_ep_len: spread the environments over their episodes, at the very start of a run only.
        """
        self.alg.check_rollout()
        first = self.current_learning_iteration
        last = first + num_learning_iterations
        if init_at_random_ep_len and first == 0:
            lengths = self.env.episode_length_buf
            longest = torch.as_tensor(self.env.max_episode_length, device=lengths.device)  # of each, or of all
            lengths.copy_(torch.randint_like(lengths, high=int(longest.max())) % longest)
        obs = self.env.get_observations().to(self.device)
        self.alg.train_mode()
        if self.alg.is_multi_gpu:
            self.alg.broadcast_parameters()
        self.stop_reason = "completed"
        try:
            self.logger.open(first)
            with self._interrupts_noted():
                for _ in range(first, last):
                    if reason := distributed.of_first(self._stop_reason()):
                        self.stop_reason = reason
                        break
                    obs = self._iterate(obs, last)
                    if self.current_learning_iteration % self.config.ppo.save_interval == 0:
                        self._save_checkpoint()
                self._save_checkpoint()
        except BaseException:
            with contextlib.suppress(OSError):  # a log that a full disk does not take would hide what has failed
                self._end()
            raise
        self._end()
        if self._interrupted:
            self._interrupted = False
            raise KeyboardInterrupt(f"interrupted after {self.current_learning_iteration} iterations, checkpoint saved")

    def _end(self) -> None:
        """Completes videos and closes the log."""
        for hook in self.end_hooks:
            hook()
        self.logger.close()

    def step(self, obs: TensorDict) -> TensorDict:
        """Act, step the environments, store the transition; returns the next observations."""
        actions = self.alg.act(obs)
        obs, rewards, dones, extras = self.env.step(actions.to(self.env.device))
        self._check_step(obs, rewards)
        obs, rewards, dones = obs.to(self.device), rewards.to(self.device), dones.to(self.device)
        self.alg.process_env_step(obs, rewards, dones, extras)
        self.logger.add_step(rewards, dones, extras)
        for hook in self.step_hooks:
            hook()
        return obs

    @property
    def policy(self) -> MLPModel:
        """The actor without exploration noise, ready to act in an environment."""
        self.alg.eval_mode()
        self.alg.actor.reset()
        return self.alg.actor

    def save(self, path: str | Path) -> None:
        """Write everything that a resumed run needs to ``path``, atomically."""
        state = self.alg.save() | {
            "iteration": self.current_learning_iteration,
            "total_time": self.total_time,
            "logger": self.logger.state_dict(),
            "rng": rng_state(),
            "env": self.env.state_dict(),
            "task": self.config.task,
        }
        save_checkpoint(path, state)

    def load(self, path: str | Path) -> bool:
        """Go on where :meth:`save` wrote a checkpoint.

        Returns:
            Whether the environments are configured as there; otherwise new episodes begin, at the levels of the
            curricula.
        """
        state = self._load(path)
        same_task = state.get("task") == self.config.task
        self.current_learning_iteration, self.total_time = state["iteration"], state["total_time"]
        self.logger.load_state_dict(state["logger"])
        if not same_task:
            self.logger.begin_episodes()
            self.env.begin_at_levels_of(state["env"])
        elif distributed.rank() == 0:
            self.env.load_state_dict(state["env"])
            set_rng_state(state["rng"])
        else:  # the others go on in ways of their own
            self.env.load_state_dict(_without_streams(state["env"]))
        self._last_saved = Path(path)
        return same_task

    def load_policy(self, path: str | Path) -> None:
        """Load the actor's weights alone, to replay it."""
        self._load(path, {"actor": True})

    def start_from(self, *run_dirs: Path, observations: ObservationsConfig | None = None) -> list[Path]:
        """Begin with the newest weights of other runs.

        The last one moves the legs, where there are any: it gives the actor's, and the critic's where it observes the
        same. One before it gives what it perceives or navigates with; without one the last one does where that fits.

        Args:
            run_dirs: of these runs.
            observations: of the last one, which may observe what this one estimates; None: the same as here.

        Returns:
            The runs whose perception goes on here.

        Raises:
            CheckpointError: they do not fit: what they observe, perceive, estimate or move differs.
        """
        others, seeing = run_dirs[:-1] if self.config.moves_joints else run_dirs, []
        for other in others:
            state = self._weights(other)
            if take_parts(self.alg.actor, state["actor_state_dict"], str(other)):
                seeing.append(other)
            if self.config.navigation is not None:
                with contextlib.suppress(CheckpointError):  # it values something else
                    start_from(self.alg.critic, state.get("critic_state_dict", {}), str(other))
        if self.config.moves_joints:
            seeing = self._walk_as(run_dirs[-1], seeing, observations or self.env.config.observations)
        self.alg.is_new = False
        self.alg.actor.reset()
        return seeing

    def _walk_as(self, run_dir: Path, seeing: list[Path], theirs: ObservationsConfig) -> list[Path]:
        """Moves as another run does, whose observations are given; returns the runs whose perception goes on."""
        state, actor, own = self._weights(run_dir), self.alg.actor, self.env.config.observations
        weights, inputs, given = (
            state["actor_state_dict"],
            self.env.actor_inputs(own),
            self._inputs(theirs, theirs.actor),
        )
        if given is None:
            raise CheckpointError(
                f"init={run_dir} does not fit: that run's policy observes what this task does not have; give both the"
                " same observations"
            )
        if reason := first_difference(inputs, given):
            if self.config.estimator is not None and theirs.estimated is None:
                truth = self.env.actor_inputs(replace(own, actor=[self.config.estimator.group]))
                weights = estimating(actor, weights, inputs, given, truth)
            if weights is state["actor_state_dict"]:  # nothing has rearranged them
                raise CheckpointError(f"init={run_dir} does not fit: {reason}; give both the same observations")
        if start_from(actor, weights, str(run_dir), with_perception=not seeing):
            seeing = [run_dir]
        if self.config.ppo.start_std is not None:
            with torch.no_grad():
                actor.distribution.std_param.fill_(self.config.ppo.start_std)
        valued, given = self.env.actor_inputs(replace(own, actor=own.critic)), self._inputs(theirs, theirs.critic)
        if given is not None and first_difference(valued, given) is None:
            with contextlib.suppress(CheckpointError):  # other hidden layers
                start_from(self.alg.critic, state["critic_state_dict"], str(run_dir))
        return seeing

    def _inputs(self, observations: ObservationsConfig, groups: Sequence[str]) -> list[ActorInput] | None:
        """What these groups are here; None: they are of quantities that this task does not have."""
        try:
            return self.env.actor_inputs(replace(observations, actor=groups))
        except UndeclaredQuantity:
            return None

    def _weights(self, run_dir: str | Path) -> dict:
        return load_checkpoint(latest_checkpoint(run_dir), self.device)

    def _iterate(self, obs: TensorDict, last: int) -> TensorDict:
        """One iteration: rollout, returns, update, log; returns the observations to go on from."""
        start = time.perf_counter()
        with torch.inference_mode():
            for _ in range(self.config.ppo.num_steps_per_env):
                obs = self.step(obs)
            self._share_curriculum()
            collected = time.perf_counter()
            self.alg.compute_returns(obs)
        losses = self.alg.update()
        end = time.perf_counter()
        self.total_time += end - start
        self.current_learning_iteration += 1
        self.logger.log(
            self.current_learning_iteration - 1,
            last,
            self.config.ppo.num_steps_per_env * self.env.num_envs * distributed.world_size(),
            collected - start,
            end - collected,
            losses,
            {"Loss/learning_rate": self.alg.learning_rate, "Policy/mean_std": self.alg.actor.output_std.mean().item()},
            self._time_left(),
        )
        return obs

    def _share_curriculum(self) -> None:
        """Curricula rise in all processes at once, so that all see LiDAR frames in the same steps."""
        if self.alg.is_multi_gpu:
            levels = self.env.curriculum_levels
            self.env.curriculum_levels = [distributed.mean(level, self.device) for level in levels]

    def _check_step(self, obs: TensorDict, rewards: torch.Tensor) -> None:
        """Stop on non-finite rewards or one-dimensional observations that a model reads."""
        checked = {"rewards": rewards, **{group: obs[group] for group in self.alg.storage.stored_groups}}
        finite = torch.stack([torch.isfinite(tensor).all() for tensor in checked.values()])
        for (name, tensor), good in zip(checked.items(), finite.tolist(), strict=True):  # one host synchronisation
            if not good:
                env = int((~torch.isfinite(tensor)).reshape(len(tensor), -1).any(1).nonzero()[0])
                terms = self.env.terms_not_finite(name, env)
                blamed = f" ({', '.join(terms)})" if terms else ""
                raise TrainingDiverged(
                    f"iteration {self.current_learning_iteration}: the environment returned"
                    f" non-finite {name}{blamed}, first in environment {env}"
                )

    def _time_left(self) -> float | None:
        """Seconds of the time budget that are left; None without one."""
        limit = self.config.ppo.max_minutes
        return None if limit is None else 60.0 * limit - self.total_time

    def _stop_reason(self) -> str:
        """Why training ends now; empty to go on."""
        left = self._time_left()
        return "interrupted" if self._interrupted else "time budget" if left is not None and left <= 0 else ""

    def _load(self, path: str | Path, parts: dict | None = None) -> dict:
        state = load_checkpoint(path, self.device)
        if parts is None and "env" not in state:
            raise CheckpointError(
                f"{path} holds weights alone, as published runs do: no training goes on from it; begin one with"
                f" init={Path(path).parent.parent}"
            )
        reason = difference(self.alg.actor.state_dict(), state.get("actor_state_dict", {}))
        try:
            if reason is None:
                self.alg.load(state, parts)
        except (RuntimeError, ValueError, KeyError) as error:
            reason = one_line(error)[:200]
        if reason is not None:
            raise CheckpointError(
                f"{path} does not fit this configuration: {reason}; give weights of a run like this one, or leave out"
                " the overrides that make it another"
            )
        return state

    def _save_checkpoint(self) -> None:
        """Save to the run directory unless this state is saved already."""
        if self.logger.log_dir is None:
            return
        path = checkpoint_path(self.logger.log_dir, self.current_learning_iteration)
        if self._last_saved != path:
            self.save(path)
            self._last_saved = path
            prune_checkpoints(self.logger.log_dir, self.config.ppo.keep_checkpoints)

    @contextlib.contextmanager
    def _interrupts_noted(self) -> Iterator[None]:
        """Turn the first Ctrl-C, SIGTERM or SIGHUP into a flag; only a second Ctrl-C acts as always.

        Outside the main thread nothing changes, nor do SIGTERM and SIGHUP where others handle or ignore them.
        """
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
        noted = [number for number, handler in before.items() if number == signal.SIGINT or handler is signal.SIG_DFL]

        def note(number: int, _: object) -> None:
            if number == signal.SIGINT:
                signal.signal(number, before[signal.SIGINT])
            if not self._interrupted:
                self._interrupted = True
                with contextlib.suppress(RuntimeError):  # it was printing
                    self.logger.say("interrupted: finishing this iteration, then saving (Ctrl-C again stops at once)")

        for number in noted:
            signal.signal(number, note)
        try:
            yield
        finally:
            for number in noted:
                signal.signal(number, before[number])


def _without_streams(state: dict) -> dict:
    """An environment's state without what its random numbers and its LiDAR's noise follow from."""
    streams = ("key", "seeded")
    return {
        name: _without_streams(part) if isinstance(part, dict) else part
        for name, part in state.items()
        if name not in streams
    }
