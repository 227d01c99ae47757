"""How much of the bare physics rate is left for the environment, and for the whole PPO iteration.

    python scripts/benchmark_env.py [what=step|iteration] [repeats=7] [experiment=... overrides]
    python scripts/benchmark_env.py against=terrain=flat [what=step] [repeats=7] terrain=mixed obstacles=all

Both are timed in turn with bare `Batch.step` (same model, states, actions, decimation and threads, nothing bound), and
the median of the paired ratios is printed with the time of each stage. With `against`, overrides with commas between
them, the step is timed in turn with that of the task to which they lead; `clock=cpu` then counts the process's own
time, all threads together, which other programs on the machine disturb less.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import replace

import omniperception  # noqa: F401  before torch, whose threads it sets up

# isort: split
import torch
from mujoco.batch import Batch

from omniperception import build, config
from omniperception.build import build_runner, seed_everything
from omniperception.common.timing import StageTimer
from omniperception.env.env import OmniEnv
from omniperception.sim import SimConfig

BLOCK = 25
"""Control steps per timed block: a multiple of the LiDAR's period."""


def bare_physics(env: OmniEnv) -> Callable[[], float]:
    """Seconds that bare `Batch.step` needs for a block of control steps from the environment's current states."""
    batch = Batch(env.world.model, env.num_envs, env.config.sim.num_threads)
    ctrl = batch.bind("ctrl")

    def block() -> float:
        batch.state[:] = env.sim.batch.state
        targets = [env.default_joint_pos + 0.1 * torch.randn(env.num_envs, env.num_actions) for _ in range(BLOCK)]
        start = time.perf_counter()
        for target in targets:
            ctrl[:] = target.numpy()
            batch.step(nstep=env.config.sim.decimation)
        return time.perf_counter() - start

    return block


def environment_steps(env: OmniEnv, clock: Callable[[], float] = time.perf_counter) -> Callable[[], float]:
    """Seconds of a clock for a block of `env.step` with random actions."""

    def block() -> float:
        actions = [0.4 * torch.randn(env.num_envs, env.num_actions) for _ in range(BLOCK)]
        start = clock()
        with torch.inference_mode():
            for action in actions:
                env.step(action)
        return clock() - start

    return block


def report(name: str, num_envs: int, seconds: list[float], bare: list[float], steps: int) -> None:
    ratios = [steps / BLOCK * b / s for s, b in zip(seconds, bare, strict=True)]
    bare_rate, rate = (
        num_envs * BLOCK / statistics.median(bare),
        num_envs * steps / statistics.median(seconds),
    )
    print(f"bare Batch.step     {bare_rate:10,.0f} env steps/s")
    print(f"{name:<19} {rate:10,.0f} env steps/s")
    print(
        f"ratio               {statistics.median(ratios):10.2f} (median of {len(ratios)} pairs,"
        f" {min(ratios):.2f} to {max(ratios):.2f})"
    )


def benchmark_step(run: build.RunConfig, repeats: int) -> None:
    seed_everything(run.env.seed)
    # No report drains the stages' times meanwhile, and all obstacles are there, so that the LiDAR is awake.
    env = OmniEnv(replace(run.env, log_interval=10**9, initial_obstacle_level=1.0))
    bare, steps = bare_physics(env), environment_steps(env)
    bare(), steps()
    env.timer.drain()
    pairs = [(steps(), bare()) for _ in range(repeats)]
    report("env.step", env.num_envs, [p[0] for p in pairs], [p[1] for p in pairs], BLOCK)
    total = repeats * BLOCK * env.num_envs
    for stage, seconds in env.timer.drain().items():
        print(f"  {stage:<17} {1e6 * seconds / total:8.2f} us per env step")


def benchmark_against(runs: list[build.RunConfig], repeats: int, clock: Callable[[], float]) -> None:
    """Time by stage of two tasks, the second the baseline, in alternating blocks."""
    tasks = []
    for run in runs:
        seed_everything(run.env.seed)
        env = OmniEnv(replace(run.env, log_interval=10**9, initial_obstacle_level=1.0))
        env.timer = StageTimer(clock)
        tasks.append((env, environment_steps(env, clock)))
    for env, steps in tasks:
        steps()
        env.timer.drain()
    blocks: list[list[dict[str, float]]] = [[], []]
    for _ in range(repeats):
        for measured, (env, steps) in zip(blocks, tasks, strict=True):
            seconds = steps()
            measured.append({**env.timer.drain(), "env.step": seconds})
    units = [1e6 / (BLOCK * env.num_envs) for env, _ in tasks]
    print(f"{'us per env step':<19} {'task':>8} {'against':>8}")
    for stage in dict.fromkeys((*blocks[0][0], *blocks[1][0])):
        medians = (
            unit * statistics.median(b.get(stage, 0.0) for b in measured)
            for unit, measured in zip(units, blocks, strict=True)
        )
        print(f"  {stage:<17}" + "".join(f" {median:8.2f}" for median in medians))
    ratios = [a["env.step"] * units[0] / (b["env.step"] * units[1]) for a, b in zip(*blocks, strict=True)]
    spread = f"{min(ratios):.2f} to {max(ratios):.2f}"
    print(f"ratio {statistics.median(ratios):22.2f} (median of {repeats} pairs, {spread})")


def benchmark_iteration(run: build.RunConfig, repeats: int) -> None:
    runner = build_runner(run, None)
    env, rollout = runner.env, run.ppo.num_steps_per_env
    bare = bare_physics(env)
    runner.learn(2)
    seconds, bares = [], []
    for _ in range(repeats):
        before = runner.total_time
        runner.learn(1)
        seconds.append(runner.total_time - before)
        bares.append(bare())
    report("PPO iteration", env.num_envs, seconds, bares, rollout)


def main() -> None:
    with config.one_line_errors():
        defaults = {"what": "step", "repeats": "7", "against": "", "clock": "wall"}
        own, overrides = config.split_arguments(sys.argv[1:], defaults)
        overrides = overrides or ["experiment=quickstart"]
        run, repeats = build.assemble(config.compose(overrides)), int(own["repeats"])
        if own["what"] not in ("step", "iteration"):
            raise config.ConfigError(f"what={own['what']} must be step or iteration")
        if type(run.env.sim) is not SimConfig:
            raise config.ConfigError("Batch.step is that of sim=mujoco; another is timed by gpu_check.py only=env")
        clocks = {"wall": time.perf_counter, "cpu": time.process_time}
        if own["clock"] not in clocks:
            raise config.ConfigError(f"clock={own['clock']} must be wall or cpu")
        print(f"{run.env.num_envs} environments, {torch.get_num_threads()} torch threads, {' '.join(overrides)}")
        if own["against"]:
            baseline = build.assemble(config.compose([*overrides, *own["against"].split(",")]))
            benchmark_against([run, baseline], repeats, clocks[own["clock"]])
        else:
            {"step": benchmark_step, "iteration": benchmark_iteration}[own["what"]](run, repeats)


if __name__ == "__main__":
    main()
