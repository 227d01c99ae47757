"""Training log: scalars under rsl_rl's names, and one console line per iteration."""

from __future__ import annotations

import datetime
import statistics
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from rsl_rl.utils.log_writer import LogWriter

from omniperception.learning.log_writers import LoggerConfig
from omniperception.learning.progress import ProgressLine, save_progress, say
from omnirobot.common.errors import naming

METRICS, ANOMALIES = "Metrics/", "Anomalies/"
"""Keys of ``extras["log"]`` that begin so are shown on the console; anomalies only if there are any."""

CONSOLE_METRICS = ("velocity_error", "yaw_rate_error", "collision_rate", "fall_rate", "obstacle_level")
"""Metrics on the console, in this order."""


class Logger:
    """Returns and lengths of episodes, scalars, and the console's line.

    Attributes:
        log_dir: run directory; None writes and prints nothing.
        total_steps: control steps of all environments and iterations.
        returns: of the last 100 episodes.
        lengths: of these, control steps.
    """

    def __init__(
        self,
        log_dir: Path | None,
        num_envs: int,
        device: str,
        config: LoggerConfig | None = None,
        settings: Mapping[str, Any] | None = None,
    ) -> None:
        """
        Args:
            log_dir: run directory; None writes and prints nothing.
            num_envs: number of environments.
            device: of what they return.
            config: where scalars go; None: nowhere.
            settings: the run's composed configuration.
        """
        self.log_dir, self.num_envs, self.config, self.settings = log_dir, num_envs, config, settings or {}
        self.total_steps = 0
        self.returns: deque[float] = deque(maxlen=100)
        self.lengths: deque[float] = deque(maxlen=100)
        self._return_so_far = torch.zeros(num_envs, device=device)
        self._length_so_far = torch.zeros(num_envs, device=device)
        self._infos: list[Mapping] = []
        self._ended: list[torch.Tensor] = []  # by step: whether episodes ended, their returns and lengths
        self._recent: deque[float] = deque(maxlen=20)  # s, of iterations
        self._line: ProgressLine | None = None  # between open and close
        self._writer: LogWriter | None = None

    def open(self, first_iteration: int) -> None:
        """Begin to log; TensorBoard drops scalars of iterations that will be repeated after a resume."""
        if self.log_dir is not None:
            self._line = ProgressLine()
            if self.config is not None:
                with naming(self.log_dir):
                    self._writer = self.config.open(self.log_dir, first_iteration, self.settings)

    def close(self) -> None:
        """End the log."""
        if self._line is not None:
            self._line.end()
            self._line = None
        if self._writer is not None and self.log_dir is not None:
            with naming(self.log_dir):
                self._writer.stop()
            self._writer = None

    def say(self, text: str) -> None:
        """Print a line of its own beside the console's line."""
        if self._line is not None:
            self._line.end()
        say(text)

    def save_video(self, path: Path, iteration: int) -> None:
        """Hand a video on to the service that logs."""
        if self._writer is not None:
            self._writer.save_video(path, iteration)

    def add_step(self, rewards: torch.Tensor, dones: torch.Tensor, extras: Mapping) -> None:
        """Note a control step; finished episodes are read out by :meth:`log`, so no step waits for a GPU."""
        if self._line is None:
            return
        if "log" in extras:
            self._infos.append(extras["log"])
        self._return_so_far += rewards
        self._length_so_far += 1
        done = dones > 0
        self._ended.append(torch.stack((done.float(), self._return_so_far, self._length_so_far)))
        self._return_so_far.masked_fill_(done, 0.0)
        self._length_so_far.masked_fill_(done, 0.0)

    def log(
        self,
        iteration: int,
        total: int,
        num_steps: int,
        collect_time: float,
        learn_time: float,
        losses: Mapping[str, float],
        scalars: Mapping[str, float],
        time_left: float | None,
    ) -> None:
        """Write an iteration's scalars and print its line.

        Args:
            iteration: its number, from 0.
            total: iterations at which training ends.
            num_steps: control steps of all environments in it.
            collect_time: s.
            learn_time: s.
            losses: by name.
            scalars: what else to write, by tag.
            time_left: s until the time budget is spent; None without one.
        """
        if self._line is None or self.log_dir is None:
            return
        self.total_steps += num_steps
        self._read_out_episodes()
        steps_per_s = int(num_steps / max(collect_time + learn_time, 1e-9))
        means = {key: _mean(self._infos, key) for key in dict.fromkeys(key for info in self._infos for key in info)}
        self._infos.clear()
        values = {key if "/" in key else f"Episode/{key}": value for key, value in means.items()}
        values |= {f"Loss/{name}": value for name, value in losses.items()} | dict(scalars)
        values |= {
            "Perf/total_fps": steps_per_s,
            "Perf/collection_time": collect_time,
            "Perf/learning_time": learn_time,
        }
        if self.returns:
            values["Train/mean_reward"] = statistics.mean(self.returns)
            values["Train/mean_episode_length"] = statistics.mean(self.lengths)
        if self._writer is not None:
            with naming(self.log_dir):
                for tag, value in values.items():
                    self._writer.add_scalar(tag, value, iteration)

        self._recent.append(collect_time + learn_time)
        remaining = statistics.mean(self._recent) * (total - iteration - 1)
        if time_left is not None:
            remaining = min(remaining, max(time_left, 0.0))
        parts = [
            f"{iteration + 1:>{len(str(total))}}/{total}",
            f"ETA {datetime.timedelta(seconds=round(remaining))}",
            f"{steps_per_s:,} steps/s",
            f"collect {collect_time:.2f} s, learn {learn_time:.2f} s",
        ]
        if self.returns:
            parts.append(f"reward {statistics.mean(self.returns):.3f}, length {statistics.mean(self.lengths):.0f}")
        shown = {name: loss for name, loss in losses.items() if name == "value" or name.endswith("_target")}
        rates = {name: means[METRICS + name] for name in CONSOLE_METRICS if METRICS + name in means}
        shown |= rates
        anomalies = {key.removeprefix(ANOMALIES): n for key, n in means.items() if key.startswith(ANOMALIES)}
        shown |= {name: count for name, count in anomalies.items() if count > 0}
        parts += [f"{name} {value:.3g}" for name, value in shown.items()]
        self._line.show(" | ".join(parts))
        reward = {"reward": statistics.mean(self.returns)} if self.returns else {}
        save_progress(self.log_dir, iteration + 1, total, reward | rates)

    def state_dict(self) -> dict:
        """Counters and running episode sums, to continue the same curves after a resume."""
        return {
            "total_steps": self.total_steps,
            "returns": list(self.returns),
            "lengths": list(self.lengths),
            "return_so_far": self._return_so_far,
            "length_so_far": self._length_so_far,
        }

    def load_state_dict(self, state: dict) -> None:
        """Restore what :meth:`state_dict` returned; sums of another number of environments are dropped."""
        self.total_steps = state["total_steps"]
        self.returns.extend(state["returns"])
        self.lengths.extend(state["lengths"])
        if len(state["return_so_far"]) == self.num_envs:
            self._return_so_far.copy_(state["return_so_far"])
            self._length_so_far.copy_(state["length_so_far"])

    def begin_episodes(self) -> None:
        """Forgets returns and lengths, as where the task has changed."""
        self.returns.clear()
        self.lengths.clear()
        self._return_so_far.zero_()
        self._length_so_far.zero_()

    def _read_out_episodes(self) -> None:
        """Returns and lengths of the episodes that ended in the iteration, in their order."""
        if self._ended:
            done, total, length = torch.stack(self._ended, 1).cpu()
            self.returns.extend(total[done > 0].tolist())
            self.lengths.extend(length[done > 0].tolist())
            self._ended.clear()


def _mean(infos: list[Mapping], key: str) -> float:
    """Mean of one entry over all log dictionaries that have it."""
    values = [torch.as_tensor(info[key], dtype=torch.float32).flatten().cpu() for info in infos if key in info]
    return torch.cat(values).mean().item()
