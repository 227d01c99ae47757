"""The training loop: collect, update, log, save, and resume bit for bit."""

from __future__ import annotations

import contextlib
import io
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import torch
from rsl_rl.env import VecEnv
from rsl_rl.runners import OnPolicyRunner
from tensordict import TensorDict

from omniperception.learning import distributed
from omniperception.learning.checkpoint import (
    CheckpointError,
    checkpoint_path,
    latest_checkpoint,
    load_checkpoint,
    prune_checkpoints,
    rng_state,
    save_checkpoint,
    set_rng_state,
)
from omniperception.learning.logger import CompactLogger
from omniperception.learning.ppo import PerceptivePpo, TrainingDiverged
from omniperception.learning.warm_start import start_from

_EVERYTHING = {
    "actor": True,
    "critic": True,
    "optimizer": True,
    "rnd": True,
    "iteration": True,
    "rng": True,
    "env": True,
}


class Runner(OnPolicyRunner):
    """rsl_rl's runner with atomic checkpoints, exact resume, a wall-time budget and a compact log.

    Started by torchrun, every process trains in environments of its own and all have the same weights and curriculum.
    The first one logs and saves; a checkpoint goes on with any number of processes, exactly with the one that saved it.

    A resumed run continues exactly (on the CPU bit for bit) if the environment has ``state_dict`` and
    ``load_state_dict`` that cover everything a step depends on, and if ``get_observations`` repeats the
    current observations without drawing random numbers.

    Attributes:
        current_learning_iteration: completed iterations.
        total_time: seconds of training, all resumed runs together.
        stop_reason: why the last :meth:`learn` ended: "completed" or "time budget".
    """

    alg: PerceptivePpo
    logger: CompactLogger

    def __init__(self, env: VecEnv, train_cfg: dict, log_dir: str | None = None, device: str = "cpu") -> None:
        """Build models, algorithm and log.

        Args:
            env: the environments.
            train_cfg: rsl_rl's configuration (``num_steps_per_env``, ``save_interval``, ``obs_groups``,
                ``actor``, ``critic``, ``algorithm``) and, optional, ``steps_per_frame`` (1),
                ``keep_checkpoints`` (all), ``max_minutes`` (no limit), ``console_metrics`` (all),
                ``check_for_nan`` (True).
            log_dir: run directory; ``None`` writes nothing.
            device: of models and storage.
        """
        train_cfg = dict(train_cfg)
        keep = train_cfg.get("keep_checkpoints")
        if keep is not None and keep < 1:
            raise ValueError(f"keep_checkpoints must be at least 1, or null to keep all, got {keep}")
        with contextlib.redirect_stdout(io.StringIO()):  # rsl_rl prints its models
            super().__init__(env, train_cfg, log_dir, device)
        self.logger = CompactLogger(
            log_dir=log_dir,
            cfg=self.cfg,
            env_cfg=getattr(env, "cfg", {}),
            num_envs=env.num_envs,
            is_distributed=self.is_distributed,
            gpu_world_size=self.gpu_world_size,
            gpu_global_rank=self.gpu_global_rank,
            device=self.device,
        )
        self.total_time = 0.0
        self.stop_reason = ""
        self._interrupted = False

    def learn(self, num_learning_iterations: int, init_at_random_ep_len: bool = False) -> None:
        """Train for a number of iterations beyond the completed ones, or until the time budget is spent.

        A first Ctrl-C finishes the iteration, saves and raises ``KeyboardInterrupt``; a second one does not
        wait.

        Args:
            num_learning_iterations: iterations to add.
            init_at_random_ep_len: spread the environments over their episodes, at the very start of a run
                only.
        """
        self.alg.check_rollout()
        first = self.current_learning_iteration
        if init_at_random_ep_len and first == 0:
            lengths = self.env.episode_length_buf
            self.env.episode_length_buf = torch.randint_like(lengths, high=int(self.env.max_episode_length))
        obs = self.env.get_observations().to(self.device)
        self.alg.train_mode()
        if self.is_distributed:
            self.alg.broadcast_parameters()
        self.logger.init_logging_writer(first)
        self.logger.tot_time = self.total_time
        self.stop_reason = "completed"
        try:
            with self._interrupts_noted():
                for it in range(first, first + num_learning_iterations):
                    obs = self._iterate(it, first, first + num_learning_iterations, obs)
                    reason = "interrupted" if self._interrupted else "time budget" if self._out_of_time() else ""
                    if reason := distributed.of_first(reason):
                        self.stop_reason = reason
                        break
                    if self.current_learning_iteration % self.cfg["save_interval"] == 0:
                        self._save_checkpoint()
            self._save_checkpoint()
        finally:
            self.logger.stop_logging_writer()
        if self._interrupted:
            self._interrupted = False
            raise KeyboardInterrupt(f"interrupted after {self.current_learning_iteration} iterations, checkpoint saved")

    def save(self, path: str, infos: dict | None = None) -> None:
        """Write everything that a resumed run needs to ``path``, atomically."""
        state = self.alg.save()
        state |= {
            "learning_rate": self.alg.learning_rate,
            "num_updates": self.alg.num_updates,
            "iteration": self.current_learning_iteration,
            "total_time": self.total_time,
            "logger": self.logger.state_dict(),
            "rng": rng_state(),
            "env": self.env.state_dict() if hasattr(self.env, "state_dict") else None,
            "infos": infos,
        }
        save_checkpoint(path, state)

    def load(
        self, path: str, load_cfg: dict | None = None, strict: bool = True, map_location: str | None = None
    ) -> dict | None:
        """Load a checkpoint; returns its ``infos``.

        Args:
            path: file written by :meth:`save`.
            load_cfg: parts to load, e.g. ``{"actor": True}`` to replay a policy; everything by default. The
                parts are actor, critic, optimizer, rnd, iteration, rng and env.
            strict: whether names of parameters must match exactly.
            map_location: device to read tensors to; the runner's by default.
        """
        parts = _EVERYTHING if load_cfg is None else load_cfg
        unknown = sorted(set(parts) - set(_EVERYTHING))
        if unknown:
            raise ValueError(f"load_cfg: unknown parts {unknown}, choose from {sorted(_EVERYTHING)}")
        state = load_checkpoint(path, map_location or self.device)
        try:
            self.alg.load(state, parts, strict)
        except (RuntimeError, ValueError, KeyError) as error:
            reason = " ".join(str(error).split())
            raise CheckpointError(
                f"{path} does not fit this configuration ({reason[:200]}); use the configuration"
                " saved in its run directory"
            ) from error
        if parts.get("optimizer"):
            self.alg.learning_rate = state["learning_rate"]
            self.alg.num_updates = state["num_updates"]
        if parts.get("iteration"):
            self.current_learning_iteration = state["iteration"]
            self.total_time = state["total_time"]
            self.logger.load_state_dict(state["logger"])
            self._last_saved = Path(path)
        if parts.get("env") and state["env"] is not None and hasattr(self.env, "load_state_dict"):
            self.env.load_state_dict(state["env"])
        if parts.get("rng") and distributed.rank() == 0:  # the others keep exploring in ways of their own
            set_rng_state(state["rng"])
        return state["infos"]

    def start_from(self, run_dir: str | Path) -> None:
        """Begin with the newest weights of another run: the actor's, and the critic's where it observes the same."""
        state = load_checkpoint(latest_checkpoint(run_dir), self.device)
        start_from(self.alg._raw_actor, state["actor_state_dict"], str(run_dir))
        with contextlib.suppress(CheckpointError):
            start_from(self.alg._raw_critic, state["critic_state_dict"], str(run_dir))

    def _iterate(self, it: int, first: int, last: int, obs: TensorDict) -> TensorDict:
        """One iteration: rollout, returns, update, log; returns the observations to go on from."""
        start = time.perf_counter()
        with torch.inference_mode():
            for _ in range(self.cfg["num_steps_per_env"]):
                obs = self._step(obs)
            self._share_curriculum()
            collected = time.perf_counter()
            self.alg.compute_returns(obs)
        losses = self.alg.update()
        if self.is_distributed:
            self.alg.broadcast_parameters()  # running statistics of observations are the first process's
        end = time.perf_counter()
        self.total_time += end - start
        self.current_learning_iteration = it + 1
        self.logger.log(
            it=it,
            start_it=first,
            total_it=last,
            collect_time=collected - start,
            learn_time=end - collected,
            loss_dict=losses,
            learning_rate=self.alg.learning_rate,
            action_std=self.alg.get_policy().output_std,
            rnd_weight=self.alg.rnd.weight if self.alg.rnd else None,
        )
        return obs

    def _share_curriculum(self) -> None:
        """Obstacles come in all processes at once, so that all see LiDAR frames in the same steps."""
        if self.is_distributed and hasattr(self.env, "curriculum_level"):
            self.env.curriculum_level = distributed.mean(self.env.curriculum_level, self.device)

    def _configure_multi_gpu(self) -> None:
        """rsl_rl's, for CPUs, too."""
        distributed.connect(self.device)
        self.gpu_world_size, self.is_distributed = distributed.world_size(), distributed.world_size() > 1
        self.gpu_global_rank, self.gpu_local_rank = distributed.rank(), distributed.local_rank()
        ranks = {
            "global_rank": self.gpu_global_rank,
            "local_rank": self.gpu_local_rank,
            "world_size": self.gpu_world_size,
        }
        self.cfg["multi_gpu"] = ranks if self.is_distributed else None

    def _step(self, obs: TensorDict) -> TensorDict:
        """Act, step the environments, store the transition."""
        actions = self.alg.act(obs)
        obs, rewards, dones, extras = self.env.step(actions.to(self.env.device))
        if self.cfg.get("check_for_nan", True):
            self._check_step(obs, rewards)
        obs, rewards, dones = obs.to(self.device), rewards.to(self.device), dones.to(self.device)
        self.alg.process_env_step(obs, rewards, dones, extras)
        self.logger.process_env_step(rewards, dones, extras, self.alg.intrinsic_rewards if self.alg.rnd else None)
        return obs

    def _check_step(self, obs: TensorDict, rewards: torch.Tensor) -> None:
        """Stop on non-finite rewards or one-dimensional observations that a model reads."""
        checked = {"rewards": rewards, **{group: obs[group] for group in self.alg.storage.stored_groups}}
        finite = torch.stack([torch.isfinite(tensor).all() for tensor in checked.values()])
        for (name, tensor), good in zip(checked.items(), finite.tolist(), strict=True):  # a GPU is waited for once
            if not good:
                env = int((~torch.isfinite(tensor)).reshape(len(tensor), -1).any(1).nonzero()[0])
                terms = self.env.terms_not_finite(name, env) if hasattr(self.env, "terms_not_finite") else []
                blamed = f" ({', '.join(terms)})" if terms else ""
                raise TrainingDiverged(
                    f"iteration {self.current_learning_iteration}: the environment returned"
                    f" non-finite {name}{blamed}, first in environment {env}"
                )

    def _out_of_time(self) -> bool:
        limit = self.cfg.get("max_minutes")
        return limit is not None and self.total_time >= 60.0 * limit

    def _save_checkpoint(self) -> None:
        """Save to the run directory unless this state is there already."""
        if self.logger.log_dir is None or self.logger.disable_logs:
            return
        path = checkpoint_path(self.logger.log_dir, self.current_learning_iteration)
        if self._last_saved == path:
            return
        self.save(str(path))
        self._last_saved = path
        if self.cfg.get("keep_checkpoints") is not None:
            prune_checkpoints(self.logger.log_dir, self.cfg["keep_checkpoints"])

    _last_saved: Path | None = None

    @contextlib.contextmanager
    def _interrupts_noted(self) -> Iterator[None]:
        """Turn the first Ctrl-C into a flag; the second acts as always. Outside the main thread nothing
        changes."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return

        def note(signum, frame) -> None:
            self._interrupted = True
            signal.signal(signal.SIGINT, previous)
            print("interrupted: finishing this iteration, then saving (Ctrl-C again stops at once)", flush=True)

        previous = signal.signal(signal.SIGINT, note)
        try:
            yield
        finally:
            signal.signal(signal.SIGINT, previous)
