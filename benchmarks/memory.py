"""Memory that a run needs, by component, predicted from two small builds, and memory that it uses.

    python scripts/memory.py experiment=paper sim=mujoco_warp num_envs=4096
    python scripts/memory.py measure=true num_envs=256

Physics, rays, environment, rollout and networks are counted from two builds with a few environments, so that the
run itself need not fit into memory; the update's mini-batch is computed. Not counted: scratch memory of the engines
during a call. `measure=true` also trains the run at its real size for two iterations and prints what it used.
"""

from __future__ import annotations

import gc
from dataclasses import dataclass, replace
from pathlib import Path

import torch
import warp as wp

from benchmarks.harness.memory import buffer_bytes, resident_bytes
from benchmarks.harness.table import Table, about, report
from omniperception import build, config
from omniperception.build import RunConfig, build_runner, steps_per_frame
from omniperception.cli import Command, argument
from omniperception.env.env import OmniEnv
from omniperception.learning import Runner
from omniperception.learning.memory import FLOAT, device_bytes, footprint

SMALL = (4, 8)
"""Environments of the two builds; all buffers grow evenly with their number."""


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """The command line."""

    measure: bool = argument(False, "also train at the real size for two iterations")
    out: Path = argument(Path("outputs/memory"), "folder of the results")


@dataclass(frozen=True)
class Part:
    """One part's memory: bytes that do not depend on the number of environments, and that every environment adds."""

    name: str
    shared: float
    per_env: float

    def total(self, num_envs: int) -> float:
        return self.shared + self.per_env * num_envs


def predict(run: RunConfig) -> list[Part]:
    """Memory by part, whatever the run's number of environments; nothing of that size is allocated."""
    low, high = SMALL
    build = _build(run, low)
    few, clouds = held_bytes(build), 0.0
    at_once = _clouds_at_once(build.env, run.env.num_envs)
    if at_once < run.env.num_envs:  # both builds get one environment's cloud, and the others are shared
        whole, run = few, replace(run, env=replace(run.env, lidar=replace(run.env.lidar, cloud_mb=1e-6)))
        few = held_bytes(_build(run, low))
        clouds = (at_once - 1) * (whole["rays"] - few["rays"]) / (low - 1)
    more, parts = held_bytes(_build(run, high)), []
    for name, size in few.items():
        per_env = (more[name] - size) / (high - low)
        parts.append(Part(name, size - low * per_env + (clouds if name == "rays" else 0.0), per_env))
    return [*parts, Part("mini-batch", 0.0, _update_bytes(run) / run.env.num_envs)]


def held_bytes(runner: Runner) -> dict[str, int]:
    """Bytes of the buffers that a runner and its environment hold, by part; what two parts share counts for the first.

    Gradients and Adam's moments are counted as if they existed already.
    """
    env = runner.env
    physics = buffer_bytes(env.sim)
    rays = buffer_bytes(env.sim, env.sensing) - buffer_bytes(env.sim)
    rest = buffer_bytes(env) - buffer_bytes(env.sim, env.sensing)
    models = (runner.alg.actor, runner.alg.critic)
    weights = sum(p.numel() * p.element_size() for model in models for p in model.parameters())
    return {
        "physics": physics,
        "rays": rays,
        "environment": rest,
        "rollout": buffer_bytes(runner.alg.storage),
        "networks": 4 * weights,
    }


def prediction(parts: list[Part], num_envs: int) -> Table:
    """The parts and their sum."""
    rows = [(p.name, p.shared / 1e6, p.per_env / 1e3, p.total(num_envs) / 1e6) for p in parts]
    rows.append(("sum", *(sum(row[k] for row in rows) for k in (1, 2, 3))))
    columns = ("part", "MB shared", "kB per environment", "MB")
    return Table("memory", f"memory by part, predicted for {num_envs} environments", columns, rows)


def measure(run: RunConfig) -> tuple[int, int, str]:
    """Builds the run at its real size and trains it for two iterations.

    Returns:
        Bytes held between two iterations, bytes at most, and what was asked.
    """
    before, device = resident_bytes(), run.env.sim.torch_device
    on_gpu = device.type == "cuda"
    if on_gpu:
        torch.cuda.reset_peak_memory_stats(device)
    runner = build_runner(run, None)
    runner.learn(2)
    gc.collect()
    if on_gpu:
        torch.cuda.synchronize(device)
        engine = wp.get_device(str(device))
        held = torch.cuda.memory_allocated(device) + wp.get_mempool_used_mem_current(engine)
        peak = torch.cuda.max_memory_allocated(device) + wp.get_mempool_used_mem_high(engine)
        return held, peak, "PyTorch's and Warp's allocators"
    return resident_bytes() - before, resident_bytes(peak=True) - before, "growth of the process's resident memory"


def _clouds_at_once(env: OmniEnv, num_envs: int) -> int:
    """Environments of a run of `num_envs` whose clouds exist at the same time."""
    parts = [slice(0, num_envs)] if env.sensing is None else env.sensing.slices_of(num_envs)
    return max(part.stop - part.start for part in parts)


def _build(run: RunConfig, num_envs: int) -> Runner:
    return build_runner(replace(run, env=replace(run.env, num_envs=num_envs, full_level=True)), None)


def _update_bytes(run: RunConfig) -> int:
    """What one mini-batch of the update holds: the perception network's part and two copies of the hidden layers."""
    steps = run.env.num_envs * run.ppo.num_steps_per_env // run.ppo.num_mini_batches
    layers = 2 * 2 * FLOAT * sum(run.ppo.hidden_dims) * steps
    if run.perception is None:
        return layers
    return layers + footprint(run.perception, run.ppo, run.env.num_envs, steps_per_frame(run)).mini_batch


def main(given: Arguments, overrides: list[str]) -> None:
    """Predicts, measures if asked, prints and writes."""
    run = build.assemble(config.compose(overrides or ["experiment=paper"]))
    table, device = prediction(predict(run), run.env.num_envs), run.env.sim.torch_device
    total = table.rows[-1][-1]
    if everything := device_bytes(device):
        table.notes.append(f"{total / 1e3:.2f} GB of {everything / 1e9:.1f} GB on {device}")
    if given.measure:
        held, peak, source = measure(run)
        ratio = peak / 1e6 / total
        table.notes.append(f"used: {held / 1e6:.0f} MB held, {peak / 1e6:.0f} MB at most ({source}): {ratio:.2f} times")
    report([table], about(torch.get_num_threads(), str(device)), given.out)


command = Command(main, Arguments, __doc__, "of the run (experiment=paper if none is given)")

if __name__ == "__main__":
    command()
