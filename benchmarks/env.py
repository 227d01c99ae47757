"""Rates of the environment, a PPO iteration and its update, beside bare physics, and the cost of each stage.

    python scripts/benchmark_env.py what=step experiment=walk
    python scripts/benchmark_env.py what=step against=terrain=flat terrain=mixed obstacles=all
    python scripts/benchmark_env.py what=inference run=latest

step       a control step, beside bare `Batch.step` (same model, states, decimation and threads), and its stages
iteration  a whole PPO iteration, beside the bare physics of its rollout
update     the update of a PPO iteration alone, on the same rollout again and again
inference  an exported policy on one core, from sensor readings to joint targets, preprocessing included: the points
           that training kept, the device's whole frame thinned to them, and the whole frame

Everything is timed in turn, wall time and CPU time of all threads; ratios are those of the same round. `against`,
overrides with commas between them, times the task in turn with the one to which they lead, instead of bare physics.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from mujoco.batch import Batch

from benchmarks.harness.table import Table, about, report
from benchmarks.harness.timing import Timing, paired_ratio, paired_timings
from omniperception import build, config
from omniperception.build import RunConfig, build_runner, seed_everything
from omniperception.config import ConfigError
from omniperception.deploy.export import FOLDER
from omniperception.env.env import OmniEnv
from omniperception.evaluation.trials.exported import record
from omniperception.sim import SimConfig
from omnirobot.common.cli import Command, argument
from omnirobot.runtime import ExportedPolicy
from omnirobot.runtime.latency import measure

BLOCK = 25
"""Control steps that are timed at once: a multiple of the LiDAR's period."""
RECORDED = 250
"""Control steps whose readings an exported policy is timed with."""


@dataclass(frozen=True)
class Timed:
    """Something to time.

    Attributes:
        call: one block of it.
        steps: control steps of a block, of all environments together.
        env: whose stages are reported, or none.
    """

    call: Callable[[int], object]
    steps: int
    env: OmniEnv | None = None


def step_of(run: RunConfig) -> Timed:
    """A block of `env.step` with random actions, with all obstacles, so that the LiDAR is awake."""
    seed_everything(run.env.seed)
    env = OmniEnv(replace(run.env, log_interval=10**9, skip_curricula=True))  # no report drains its stages
    actions = 0.4 * torch.randn(BLOCK, env.num_envs, env.num_actions, device=env.device)

    def block(_: int) -> None:
        with torch.inference_mode():
            for action in actions:
                env.step(action)

    return Timed(block, BLOCK * env.num_envs, env)


def iteration_of(run: RunConfig) -> Timed:
    """A PPO iteration."""
    runner = build_runner(run, None)
    runner.learn(1)
    return Timed(lambda _: runner.learn(1), run.env.num_envs * run.ppo.num_steps_per_env, runner.env)


def update_of(run: RunConfig) -> Timed:
    """The update of a PPO iteration, on one rollout."""
    runner = build_runner(run, None)
    runner.alg.storage.clear = lambda: None  # the rollout is used again
    runner.learn(1)
    return Timed(lambda _: runner.alg.update(), run.env.num_envs * run.ppo.num_steps_per_env)


def physics_of(env: OmniEnv, num_steps: int) -> Timed:
    """Bare `Batch.step` from the environment's current states, nothing bound but the controls."""
    batch = Batch(env.world.model, env.num_envs, env.config.sim.num_threads)
    ctrl = batch.bind("ctrl")
    targets = (env.state.default_joint_pos + 0.1 * torch.randn(num_steps, env.num_envs, env.num_actions)).numpy()

    def block(_: int) -> None:
        batch.state[:] = env.sim.batch.state
        for target in targets:
            ctrl[:] = target
            batch.step(nstep=env.config.sim.decimation)

    return Timed(block, num_steps * env.num_envs)


TIMED = {"step": step_of, "iteration": iteration_of, "update": update_of}


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """The command line."""

    what: str = argument("step", "what is timed", choices=(*TIMED, "inference"))
    repeats: int = argument(7, "rounds in which both are timed", least=1)
    against: tuple[str, ...] = argument((), "overrides of a task that takes the place of bare physics")
    run: str = argument("latest", "inference: run directory with an exported policy")
    steps: int = argument(5000, "inference: control steps that are timed", least=1)
    out: Path = argument(Path("outputs/benchmark_env"), "folder of the results")


def compare(what: str, run: RunConfig, repeats: int, against: RunConfig | None = None) -> list[Table]:
    """A run's steps, iterations or updates in turn with those of another, or with bare physics."""
    if against is None and type(run.env.sim) is not SimConfig:
        raise ConfigError("Batch.step is that of sim=mujoco; with another give against=... or use gpu_check.py")
    subjects = {what: TIMED[what](run)}
    if against is not None:
        subjects["against"] = TIMED[what](against)
    elif subjects[what].env is not None:
        subjects["bare Batch.step"] = physics_of(subjects[what].env, subjects[what].steps // run.env.num_envs)
    for subject in subjects.values():
        subject.call(0)
        if subject.env is not None:
            subject.env.timer.drain()
    timings = paired_timings({n: s.call for n, s in subjects.items()}, repeats, calls_per_block=1)
    return [_rates(what, subjects, timings), *_stages(what, subjects, repeats)]


def _rates(what: str, subjects: dict[str, Timed], timings: dict[str, Timing]) -> Table:
    ratios = ("time to the first", "CPU time to it")
    columns = ("timed", "env steps/s", "us per env step", "CPU us per env step", *ratios)
    table = Table(f"env_{what}", f"{what}: rates, and times to that of {what} (median, smallest, largest)", columns)
    per_step = {name: timing.per(subjects[name].steps) for name, timing in timings.items()}
    first = per_step[what]
    for name, timing in per_step.items():
        ratios = (str(paired_ratio(timing, first, clock)) for clock in ("wall", "cpu"))
        table.rows.append((name, 1.0 / timing.median_s, 1e6 * timing.median_s, 1e6 * timing.median_cpu_s, *ratios))
    return table


def _stages(what: str, subjects: dict[str, Timed], repeats: int) -> list[Table]:
    """Wall time of each stage of the environments' steps."""
    timed = {name: subject for name, subject in subjects.items() if subject.env is not None}
    if not timed:
        return []
    blocks = repeats + 1  # paired_timings calls each once more
    stages = {n: {k: 1e6 * v / (blocks * s.steps) for k, v in s.env.timer.drain().items()} for n, s in timed.items()}
    names = dict.fromkeys(name for times in stages.values() for name in times)
    rows = [{"stage": name} | {n: times.get(name, 0.0) for n, times in stages.items()} for name in names]
    return [Table.of(f"env_{what}_stages", "stages of env.step, us per environment and step", rows)]


# ---- exported policies -----------------------------------------------------------------------------------------------


class Thinning:
    """A policy that keeps of every frame what training kept; that is timed, too."""

    def __init__(self, policy: ExportedPolicy) -> None:
        self._policy, self.reset = policy, policy.reset

    def step(self, state, command, points) -> None:
        self._policy.step(state, command, None if points is None else self._policy.subsample(points))


def latency(run_dir: Path, steps: int) -> Table:
    """Percentiles of a control step of an exported policy, with and without a frame, ms."""
    policy = ExportedPolicy.load(run_dir / FOLDER, safety=None)
    run = build.assemble(config.load(run_dir, ["num_envs=1"]))

    def readings(whole_frames: bool):
        return record(OmniEnv(replace(run.env, skip_curricula=True)), policy, RECORDED, whole_frames)

    cases = {"as trained": (policy, readings(False))}
    if policy.description.perception is not None:
        whole = readings(True)
        cases["thinned"] = (Thinning(policy), whole)
        if policy.description.perception.sampler["kind"] != "raw":
            cases["whole frame"] = (policy, whole)
    where, rows = use_one_core(), []
    for case, (timed, recorded) in cases.items():
        points = max((len(r.points) for r in recorded if r.points is not None), default=0)
        for kind, parameters in measure(timed, recorded, steps).items():
            rows.append({"case": case, "points": points, "step": kind, **parameters})
    return Table.of("latency", f"{policy.description.provenance.get('checkpoint')}, {where}, milliseconds", rows)


def use_one_core() -> str:
    """Keeps this process to one core where the system can; says so."""
    torch.set_num_threads(1)
    if not hasattr(os, "sched_setaffinity"):
        return "one thread"
    core = max(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {core})
    return f"core {core} alone"


def main(given: Arguments, overrides: list[str]) -> None:
    """Times, prints and writes."""
    if given.what == "inference":
        if overrides:
            raise ConfigError(f"{overrides[0]}: what=inference takes a run as it was trained; leave overrides out")
        run_dir = config.find_run(given.run)
        report([latency(run_dir, given.steps)], about(1), given.out)
        return
    overrides = overrides or ["experiment=quickstart"]
    run = build.assemble(config.compose(overrides))
    against = build.assemble(config.compose([*overrides, *given.against])) if given.against else None
    report(compare(given.what, run, given.repeats, against), about(torch.get_num_threads()), given.out)


command = Command(main, Arguments, __doc__, "of the task")

if __name__ == "__main__":
    command()
