"""Checks for a GPU, in under nine minutes: correctness, then measurements, then a short training.

    python scripts/gpu_check.py
    python scripts/gpu_check.py device=cpu size=small        # without a GPU: all but tests and syncs, at tiny sizes

tests      the tests marked gpu
lidar      ranges against mj_ray
steps      one physics step against mj_step; graph replay against the CPU
syncs      host synchronisations in a control step
rays       the paper's rendering-time table, also beside the paper's scheme and mujoco_warp.rays
env        environment steps per second at 4096 environments, by stage
training   whole PPO iterations of experiment=paper, and the memory that they used

Every part writes its tables to `out` as CSV, JSON and Markdown as soon as it has them; `summary.md` tells what ran. No
part begins after `minutes`. Exit status 0: all good; 1: something failed or was wrong.
"""

from __future__ import annotations

import subprocess
import sys
import time
import traceback
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch
import warp as wp

from benchmarks import env as env_benchmark
from benchmarks.harness.table import Table, about, machine_line, write
from benchmarks.harness.timing import device_barrier
from benchmarks.lidar.baselines import ONE_MESH
from benchmarks.lidar.compare import Options
from benchmarks.lidar.paper import measure_table
from benchmarks.lidar_accuracy import accuracy
from benchmarks.step_errors import step_errors
from omniperception import build, config
from omniperception.build import build_runner
from omniperception.common.timing import StageTimer
from omniperception.config import ConfigError
from omniperception.scene import build_world
from omniperception.scene.build import FOOT_FORCE, OBSTACLE_CONTACT
from omniperception.sim.mujoco_warp import MujocoWarpSimulator
from omnirobot.common.cli import Command, argument

ROOT = Path(__file__).resolve().parents[1]
RAYS_TREE = "mujoco_warp rays"
STEPS_PER_SECOND = 60_000.0
"""Environment steps per second that whole iterations are to reach at the paper's setting."""
LARGEST_CELL_MS = 100.0
"""What 4096 environments with 32,000 rays each may take, ms."""
ENGINE_ERROR = 5e-3
"""Largest difference (m/s or rad/s) from `mj_step` after one step that passes."""
SYNCS_PER_STEP = 3
"""Host synchronisations allowed in a control step, each to count environments: those that end, those whose command is
drawn again, and those with an approaching obstacle that has passed."""
PERCEPTION_STAGES = ("rays", "sampling", "sectors")
NEEDS_GPU = "left out: it needs a GPU"


def check_tests(given: Arguments) -> list[Table]:
    """The tests marked `gpu`, in a process of their own; none without a GPU."""
    if not given.on_gpu:
        return []
    command = [sys.executable, "-m", "pytest", "-q", "-m", "gpu", str(ROOT / "tests")]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    lines = done.stdout.strip().splitlines() or [done.stderr.strip()[-200:]]
    return [
        _judged(Table("tests", "Tests marked gpu", ("result",), [(lines[-1],)], lines[-12:-1]), not done.returncode)
    ]


def check_lidar(given: Arguments) -> list[Table]:
    """Ranges on the device against `mj_ray` in float64, for each kind of shape and a crowd of all."""
    num_rays, only = (300, "crowd") if given.small else (100_000, "")
    return [_judged(*accuracy(num_rays, 0, only, given.device))]


def check_steps(given: Arguments) -> list[Table]:
    """One physics step against `mj_step`, and a graph's replay against the same steps on the CPU."""
    sim = _simulator(given, given.device, 16 if given.small else 512)
    found = step_errors(sim)
    table = Table(
        "step_errors",
        f"One step of mujoco_warp on {given.device} against mj_step in float64, {sim.num_envs} states,"
        f" {int((found.contacts > 0).sum())} of them in contact",
        ("difference", "median", "99 %", "largest"),
        found.table(),
    )
    tables = [_judged(table, bool(found.velocity.max() < ENGINE_ERROR))]
    return [*tables, _compare_replay(given)] if given.on_gpu else tables


def _compare_replay(given: Arguments) -> Table:
    """Control steps 1 (as it is), 2 (captured) and 3 (replayed) on the GPU beside the CPU's."""
    sims = [_simulator(given, device, 8) for device in (given.device, "cpu")]
    table = Table("graph_replay", "Control steps on the GPU against the CPU", ("control step", "largest difference"))
    joints = torch.tensor(list(sims[0].world.robot.default_joint_pos.values()))
    qpos = torch.cat((torch.tensor([0.0, 0.0, 0.32, 1.0, 0.0, 0.0, 0.0]), joints)).repeat(8, 1)
    for sim in sims:
        sim.mocap_pos[..., 2] = -100.0
        sim.reset(torch.arange(8, device=sim.device), qpos.to(sim.device), torch.zeros(8, 18, device=sim.device))
    for step in range(4):
        target = joints + 0.1 * torch.sin(torch.arange(8.0)[:, None] + step)
        for sim in sims:
            sim.step(target.to(sim.device), 4, sim.mocap_pos[:, None].expand(-1, 4, -1, -1).clone())
        table.rows.append((step + 1, float((sims[0].qvel.cpu() - sims[1].qvel).abs().max())))
    return _judged(table, table.rows[-1][1] < 0.05)


def check_syncs(given: Arguments) -> list[Table]:
    """Host synchronisations in control steps in which an episode ends, as PyTorch reports them; none without a GPU."""
    if not given.on_gpu:
        return []
    table = Table("syncs", "Host synchronisations of a control step", ("place", "times in a step"))
    timed, steps = env_benchmark.step_of(given.run("num_envs=256")), env_benchmark.BLOCK
    timed.call(0)  # kernels are compiled, graphs captured
    timed.env.episode_length_buf[:steps] = timed.env.max_episode_length - torch.arange(steps, device=given.device)
    torch.cuda.set_sync_debug_mode("warn")
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            timed.call(0)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    places = [f"{Path(w.filename).name}:{w.lineno}" for w in caught if "synchroniz" in str(w.message)]
    table.rows = [(place, places.count(place) / steps) for place in sorted(set(places))]
    table.notes = ["synchronisations by Warp and the physics, of which there should be none, are not seen by this"]
    return [_judged(table, len(places) <= SYNCS_PER_STEP * steps)]


def measure_rays(given: Arguments) -> list[Table]:
    """The paper's rendering-time table; in part of its cells beside the paper's scheme and mujoco_warp.rays."""
    options, rivals = Options(rounds=5, num_threads=2, device=given.device), (ONE_MESH, RAYS_TREE)
    if given.small:
        options = replace(options, num_bodies=4, rounds=1)
        ours, beside = measure_table(options, max_rays=256_000), measure_table(options, 256_000, rivals)
    else:
        ours, beside = measure_table(options), measure_table(replace(options, rounds=3), 8_400_000, rivals)
    slower = [row[:2] for row in ours.rows if row[2] > row[5]]
    rays, num_envs, most = ours.rows[-1][:3]
    ours.notes.append(f"cells slower than the paper's: {slower or 'none'}")
    ours.notes.append(f"{num_envs} x {rays:,} rays in {most:.1f} ms (target: 4096 x 32,000 in {LARGEST_CELL_MS:g} ms)")
    beside.name = "paper_table_baselines"
    for name, target in ((ONE_MESH, 3.0), (RAYS_TREE, 2.0)):
        pairs = zip(beside.column(name), beside.column("ours"), strict=True)
        least = min((theirs / own for theirs, own in pairs if theirs == theirs), default=0.0)
        met = "met" if least >= target else "NOT MET"
        beside.notes.append(f"at least {least:.2f} times as fast as {name} (target {target:g}: {met})")
    return [ours, beside]


def measure_env(given: Arguments) -> list[Table]:
    """Environment steps per second at the paper's setting, and with every point of the sensor; shares of the stages."""
    whole = f"lidar.num_rays={300 if given.small else 20_000}"
    return [_measure_steps(given, "env_stages"), _measure_steps(given, "env_stages_whole_clouds", whole)]


def _measure_steps(given: Arguments, name: str, *overrides: str) -> Table:
    run, synchronise = given.run(*overrides), device_barrier(given.device)
    timed = env_benchmark.step_of(run)
    timed.call(0)

    def clock() -> float:
        synchronise()
        return time.perf_counter()

    start = clock()
    timed.call(0)
    rate = timed.steps / (clock() - start)
    timed.env.timer = StageTimer(clock)  # stages of a block of their own: the device is waited for at both ends of each
    timed.call(0)
    stages = timed.env.timer.drain()
    total = sum(stages.values())
    title = f"env.step with {run.env.num_envs} environments, {run.env.lidar.num_rays} rays: {rate:,.0f} env steps/s"
    table = Table(name, title, ("stage", "us per env step", "share, %"))
    table.rows = [(stage, 1e6 * spent / timed.steps, 100.0 * spent / total) for stage, spent in stages.items()]
    share = 100.0 * sum(stages.get(name, 0.0) for name in PERCEPTION_STAGES) / total
    table.notes = [f"{', '.join(PERCEPTION_STAGES)} together: {share:.0f} % (target: below 50 %)"]
    return table


def measure_training(given: Arguments) -> list[Table]:
    """A few whole iterations at the paper's setting: throughput, collection and update, memory."""
    run = given.run()
    runner = build_runner(run, None)
    runner.learn(1 if given.small else 2)
    seconds, iterations = runner.total_time, 1 if given.small else 10
    runner.learn(iterations)
    seconds = (runner.total_time - seconds) / iterations
    rate = run.env.num_envs * run.ppo.num_steps_per_env / seconds
    title = f"Whole PPO iterations of experiment=paper with {run.env.num_envs} environments"
    table = Table("training", title, ("iterations", "s per iteration", "env steps/s"), [(iterations, seconds, rate)])
    met = "met" if rate >= STEPS_PER_SECOND else "NOT MET"
    table.notes = [f"target: {STEPS_PER_SECOND:,.0f} env steps/s: {met}"]
    if given.on_gpu:
        device = runner.env.device
        most = torch.cuda.max_memory_allocated(device) + wp.get_mempool_used_mem_high(wp.get_device(str(device)))
        table.notes.append(f"memory used at most: {most / 1e6:,.0f} MB (PyTorch's and Warp's allocators)")
    return [table]


PARTS: dict[str, Callable[[Arguments], list[Table]]] = {
    "tests": check_tests,
    "lidar": check_lidar,
    "steps": check_steps,
    "syncs": check_syncs,
    "rays": measure_rays,
    "env": measure_env,
    "training": measure_training,
}
"""In the order in which they run."""


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """The command line."""

    device: str = argument("cuda:0", "cuda:<index> or cpu")
    size: str = argument("full", "small: tiny sizes, to see that everything works", choices=("full", "small"))
    only: tuple[str, ...] = argument(tuple(PARTS), "parts to run", choices=tuple(PARTS))
    minutes: float = argument(8.0, "parts that would begin later are left out", positive=True)
    out: Path = argument(Path("outputs/gpu_check"), "folder of the results")

    @property
    def small(self) -> bool:
        return self.size == "small"

    @property
    def on_gpu(self) -> bool:
        return self.device.startswith("cuda")

    def run(self, *overrides: str) -> build.RunConfig:
        """The paper's recipe on this device, at the paper's size or a tiny one."""
        sizes = ("num_envs=8", "lidar.num_rays=200", "ppo.num_steps_per_env=8") if self.small else ()
        recipe = ("experiment=paper", "sim=mujoco_warp", f"sim.device={self.device}", *sizes, *overrides)
        return build.assemble(config.compose(recipe))


def execute(given: Arguments) -> bool:
    """Runs the parts, prints and writes their tables and a summary; whether none of them failed.

    A part that fails is reported with its last line and does not keep the others from running.
    """
    where, began, good = about(2, given.device), time.perf_counter(), True
    summary = Table("summary", f"Checks on {where['machine']['device']}", ("part", "s", "result"))
    for name, part in PARTS.items():
        if name not in given.only:
            continue
        start = time.perf_counter()
        if start - began > 60.0 * given.minutes:
            result = "left out: no time was left"
        else:
            result = _run_part(part, given, where)
            good &= result in ("done", NEEDS_GPU)
        summary.rows.append((name, time.perf_counter() - start, result))
        write(summary, where, given.out)  # what has been seen is kept, whatever comes
    print(f"{summary.markdown()}\n\n{machine_line(where)}")
    return good


def _run_part(part: Callable[[Arguments], list[Table]], given: Arguments, where: dict) -> str:
    """One part's tables on the screen and in files; 'done', or what went wrong."""
    try:
        tables = part(given)
    except Exception as error:
        traceback.print_exc()
        return f"FAILED: {type(error).__name__}: {error}".splitlines()[0]
    for table in tables:
        write(table, where, given.out)
        print(f"{table.markdown()}\n", flush=True)
    if not tables:
        return NEEDS_GPU
    wrong = [table.name for table in tables if table.details.get("passed") is False]
    return f"WRONG: {', '.join(wrong)}" if wrong else "done"


def _judged(table: Table, passed: bool) -> Table:
    table.details["passed"] = passed
    table.notes.append("passed" if passed else "NOT PASSED")
    return table


def _simulator(given: Arguments, device: str, num_envs: int) -> MujocoWarpSimulator:
    env = given.run("terrain=flat", "obstacles=static").env  # `step_errors` stands the robots on a plane
    world = build_world(env.robot, env.terrain, env.obstacles, (FOOT_FORCE, OBSTACLE_CONTACT))
    return replace(env.sim, device=device).build(world, num_envs)


def main(given: Arguments) -> None:
    """Runs the parts; exits with 1 if something failed or was wrong."""
    if given.device != "cpu" and not (given.on_gpu and torch.cuda.is_available()):
        raise ConfigError(
            f"device={given.device}: there is no such GPU here; device=cpu size=small runs what needs none, tiny"
        )
    sys.exit(0 if execute(given) else 1)


command = Command(main, Arguments, __doc__)

if __name__ == "__main__":
    command()
