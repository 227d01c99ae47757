"""Training log: rsl_rl's TensorBoard scalars and one console line per iteration."""

from __future__ import annotations

import contextlib
import datetime
import io
import statistics
from collections import deque
from collections.abc import Mapping, Sequence

import torch
from rsl_rl.utils.logger import Logger

METRICS, ANOMALIES = "Metrics/", "Anomalies/"
"""Keys of ``extras["log"]`` that begin so are shown on the console; anomalies only if there are any."""


class CompactLogger(Logger):
    """rsl_rl's logger with TensorBoard only and a single line per iteration.

    ``cfg["console_metrics"]`` (names without the prefix "Metrics/") selects and orders what the line shows;
    all by default. Anomalies that happened are always shown.
    """

    def init_logging_writer(self, first_iteration: int = 0) -> None:
        """Open the TensorBoard file; scalars of iterations that will be repeated after a resume are
        dropped."""
        self._recent = deque(maxlen=20)
        self._ended: list[torch.Tensor] = []  # by step: whether episodes ended, their returns and lengths
        if self.log_dir is None or self.disable_logs:
            return
        from torch.utils.tensorboard import SummaryWriter

        purge = first_iteration if first_iteration > 0 else None
        self.writer = SummaryWriter(log_dir=self.log_dir, flush_secs=10, purge_step=purge)  # type: ignore

    def process_env_step(
        self,
        rewards: torch.Tensor,
        dones: torch.Tensor,
        extras: dict,
        intrinsic_rewards: torch.Tensor | None = None,
    ) -> None:
        """As rsl_rl's, but that finished episodes are read out by `log`: a step does not wait for a GPU."""
        if self.writer is None or intrinsic_rewards is not None:
            super().process_env_step(rewards, dones, extras, intrinsic_rewards)
            return
        if "log" in extras:
            self.ep_extras.append(extras["log"])
        self.cur_reward_sum += rewards
        self.cur_episode_length += 1
        done = dones > 0
        self._ended.append(torch.stack((done.float(), self.cur_reward_sum, self.cur_episode_length)))
        self.cur_reward_sum.masked_fill_(done, 0.0)
        self.cur_episode_length.masked_fill_(done, 0.0)

    def log(self, it: int, start_it: int, total_it: int, collect_time: float, learn_time: float, **values) -> None:
        """Write the scalars and print the line; ``values`` are rsl_rl's other arguments."""
        if self.writer is None:
            return
        self._read_out_episodes()
        metrics = self._mean_metrics()
        with contextlib.redirect_stdout(io.StringIO()):
            super().log(it, start_it, total_it, collect_time, learn_time, **values)
        self._recent.append(collect_time + learn_time)
        print(self._line(it + 1, total_it, collect_time, learn_time, values["loss_dict"], metrics), flush=True)

    def stop_logging_writer(self) -> None:
        """Close the TensorBoard file."""
        if self.writer is not None:
            self.writer.close()  # type: ignore[attr-defined]
            self.writer = None

    def state_dict(self) -> dict:
        """Counters and running episode sums, to continue the same curves after a resume."""
        return {
            "total_steps": self.tot_timesteps,
            "reward_buffer": list(self.rewbuffer),
            "length_buffer": list(self.lenbuffer),
            "reward_sum": self.cur_reward_sum,
            "episode_length": self.cur_episode_length,
        }

    def load_state_dict(self, state: dict) -> None:
        """Restore what :meth:`state_dict` returned; sums of another number of environments are dropped."""
        self.tot_timesteps = state["total_steps"]
        self.rewbuffer.extend(state["reward_buffer"])
        self.lenbuffer.extend(state["length_buffer"])
        if len(state["reward_sum"]) == self.num_envs:
            self.cur_reward_sum.copy_(state["reward_sum"])
            self.cur_episode_length.copy_(state["episode_length"])

    def _read_out_episodes(self) -> None:
        """Returns and lengths of the episodes that ended in the iteration, in their order."""
        if self._ended:
            done, total, length = torch.stack(self._ended, 1).cpu()
            self.rewbuffer.extend(total[done > 0].tolist())
            self.lenbuffer.extend(length[done > 0].tolist())
            self._ended.clear()

    def _mean_metrics(self) -> dict[str, float]:
        """Means over the iteration of the entries under "Metrics/" that the console shows."""
        names = list(dict.fromkeys(key for info in self.ep_extras for key in info if key.startswith(METRICS)))
        chosen: Sequence[str] | None = self.cfg.get("console_metrics")
        if chosen is not None:
            names = [METRICS + name for name in chosen if METRICS + name in names]
        means = {name.removeprefix(METRICS): _mean(self.ep_extras, name) for name in names}
        keys = dict.fromkeys(key for info in self.ep_extras for key in info if key.startswith(ANOMALIES))
        anomalies = {key.removeprefix(ANOMALIES): _mean(self.ep_extras, key) for key in keys}
        return means | {name: count for name, count in anomalies.items() if count > 0}

    def _line(self, done: int, total: int, collect: float, learn: float, losses: dict, metrics: dict) -> str:
        steps = self.cfg["num_steps_per_env"] * self.num_envs * self.gpu_world_size
        parts = [
            f"{done:>{len(str(total))}}/{total}",
            f"{steps / max(collect + learn, 1e-9):,.0f} steps/s",
            f"collect {collect:.2f} s, learn {learn:.2f} s",
        ]
        if self.rewbuffer:
            parts.append(f"reward {statistics.mean(self.rewbuffer):.3f}, length {statistics.mean(self.lenbuffer):.0f}")
        if "value" in losses:
            parts.append(f"value {losses['value']:.3g}")
        parts += [f"{name} {value:.3g}" for name, value in losses.items() if name.endswith("_target")]
        parts += [f"{name} {value:.3g}" for name, value in metrics.items()]
        remaining = datetime.timedelta(seconds=round(statistics.mean(self._recent) * (total - done)))
        return " | ".join([*parts, f"ETA {remaining}"])


def _mean(infos: list[Mapping], name: str) -> float:
    """Mean of one entry over all log dictionaries that have it."""
    values = [torch.as_tensor(info[name], dtype=torch.float32).flatten().cpu() for info in infos if name in info]
    return torch.cat(values).mean().item()
