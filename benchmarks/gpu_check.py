"""What has to be seen on a GPU: correctness, then measurements, then a short training; every table a file."""

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

from benchmarks import memory
from benchmarks.lidar_accuracy import cases, compare
from benchmarks.lidar_benchmark.compare import Options
from benchmarks.lidar_benchmark.paper import measure_table
from benchmarks.lidar_benchmark.peers import ONE_MESH
from benchmarks.lidar_benchmark.report import Table, machine, machine_line, write
from benchmarks.lidar_benchmark.timing import device_barrier
from benchmarks.step_errors import step_errors
from benchmarks.waits import find_waits
from omniperception import build, config
from omniperception.build import build_runner, seed_everything
from omniperception.common.timing import StageTimer
from omniperception.env.env import OmniEnv
from omniperception.scene import build_world
from omniperception.scene.build import FOOT_FORCE, OBSTACLE_CONTACT
from omniperception.sim.mujoco_warp import MujocoWarpSimulator

ROOT = Path(__file__).resolve().parents[1]
RAYS_TREE = "mujoco_warp rays"
STEPS_PER_SECOND = 60_000.0
"""Environment steps per second that whole iterations are to reach at the paper's setting."""
LARGEST_CELL_MS = 100.0
"""What 4096 environments with 32,000 rays each may take, ms."""
WITHIN = 0.9999
"""Share of rays that have to agree with `mj_ray`."""
ENGINE_ERROR = 5e-3
"""Largest difference (m/s or rad/s) from `mj_step` after one step that passes."""
PERCEPTION_STAGES = ("rays", "sampling", "sectors")


@dataclass(frozen=True)
class CheckOptions:
    """The command line.

    Attributes:
        device: "cuda:<index>" or "cpu".
        small: tiny sizes, to see that everything works.
        out: folder of the results.
        only: names of the parts to run; all if empty.
        minutes: parts that would begin later are left out.
    """

    device: str = "cuda:0"
    small: bool = False
    out: Path = Path("outputs/gpu_check")
    only: tuple[str, ...] = ()
    minutes: float = 8.0

    @property
    def on_gpu(self) -> bool:
        return self.device.startswith("cuda")

    def run(self, *overrides: str) -> build.RunConfig:
        """The paper's recipe on this device, at the paper's size or a tiny one."""
        sizes = ("num_envs=8", "lidar.num_rays=200", "ppo.num_steps_per_env=8") if self.small else ()
        recipe = ("experiment=paper", "sim=mujoco_warp", f"sim.device={self.device}", *sizes, *overrides)
        return build.assemble(config.compose(recipe))


def check_tests(options: CheckOptions) -> list[Table]:
    """The tests marked `gpu`, in a process of their own."""
    if not options.on_gpu:
        return [Table("tests", "Tests marked gpu", ("result",), [("left out: they need a GPU",)])]
    command = [sys.executable, "-m", "pytest", "-q", "-m", "gpu", str(ROOT / "tests")]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    lines = done.stdout.strip().splitlines() or [done.stderr.strip()[-200:]]
    table = Table("tests", "Tests marked gpu", ("result",), [(lines[-1],)], notes=lines[-12:-1])
    return [_judged(table, done.returncode == 0)]


def check_lidar(options: CheckOptions) -> list[Table]:
    """Ranges on the device against `mj_ray` in float64, for each kind of shape and a crowd of all."""
    num_rays = 300 if options.small else 100_000
    chosen = [case for case in cases() if options.small is False or case.name in ("box", "crowd")]
    table = Table(
        "lidar_accuracy",
        f"Rays on {options.device} against mj_ray, {num_rays:,} a case",
        ("case", "rays", "within", "hit/miss differs", "explained", "unexplained"),
    )
    good = True
    for case in chosen:
        tally = compare(case, num_rays, 0, device=options.device)
        good &= tally.share_within >= WITHIN and tally.unexplained == 0
        counts = (tally.disagreements, tally.explained, tally.unexplained)
        table.rows.append((case.name, tally.rays, tally.share_within, *counts))
    table.notes = ["explained: grazes a silhouette, or starts on a surface"]
    return [_judged(table, good)]


def check_steps(options: CheckOptions) -> list[Table]:
    """One physics step against `mj_step`, and a graph's replay against the same steps on the CPU."""
    sim = _simulator(options, options.device, 16 if options.small else 512)
    found = step_errors(sim)
    table = Table(
        "step_errors",
        f"One step of mujoco_warp on {options.device} against mj_step in float64, {sim.num_envs} states,"
        f" {int((found.contacts > 0).sum())} of them in contact",
        ("difference", "median", "99 %", "largest"),
        found.table(),
    )
    tables = [_judged(table, bool(found.velocity.max() < ENGINE_ERROR))]
    if options.on_gpu:
        tables.append(_compare_replay(options))
    return tables


def _compare_replay(options: CheckOptions) -> Table:
    """Control steps 1 (as it is), 2 (captured) and 3 (replayed) on the GPU beside the CPU's."""
    sims = [_simulator(options, device, 8) for device in (options.device, "cpu")]
    table = Table("graph_replay", "Control steps on the GPU against the CPU", ("control step", "largest difference"))
    joints = torch.tensor(list(sims[0].world.robot.default_joint_pos.values()))
    qpos = torch.cat((torch.tensor([0.0, 0.0, 0.32, 1.0, 0.0, 0.0, 0.0]), joints)).repeat(8, 1)
    for sim in sims:
        everyone = torch.arange(8, device=sim.device)
        sim.mocap_pos[..., 2] = -100.0
        sim.reset(everyone, qpos.to(sim.device), torch.zeros(8, 18, device=sim.device))
    for step in range(4):
        target = joints + 0.1 * torch.sin(torch.arange(8.0)[:, None] + step)
        for sim in sims:
            path = sim.mocap_pos[:, None].expand(-1, 4, -1, -1).clone()
            sim.step(target.to(sim.device), 4, path)
        table.rows.append((step + 1, float((sims[0].qvel.cpu() - sims[1].qvel).abs().max())))
    return _judged(table, table.rows[-1][1] < 0.05)


def check_waiting(options: CheckOptions) -> list[Table]:
    """Where a control step of the environment waits for the GPU: PyTorch tells, or on a CPU `find_waits` finds."""
    table = Table("waits", "Places of a control step that wait for the GPU", ("place", "times"))
    sizes = () if options.small else ("num_envs=256",)
    env = OmniEnv(replace(options.run(*sizes).env, initial_obstacle_level=1.0, log_interval=10**9))
    actions, steps = torch.zeros(env.num_envs, env.num_actions, device=env.device), 6

    def control_steps() -> None:
        for _ in range(steps):
            env.episode_length_buf[0] = env.max_episode_length  # an episode ends in every step
            env.step(actions)

    control_steps()  # kernels are compiled, graphs captured
    if options.on_gpu:
        places = _places_that_wait(control_steps)
        table.notes = ["Warp's and the physics' own waits, of which there should be none, are not seen by this"]
    else:
        with find_waits() as waits:
            control_steps()
        places = waits.places()
        table.notes = [f"{waits.operators / steps:.0f} operators of PyTorch in a control step"]
    table.rows = sorted(places.items())
    table.notes.append(f"in {steps} control steps")
    return [_judged(table, not places)]


def _places_that_wait(work: Callable[[], None]) -> dict[str, int]:
    torch.cuda.set_sync_debug_mode("warn")
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            work()
    finally:
        torch.cuda.set_sync_debug_mode("default")
    places = [f"{Path(w.filename).name}:{w.lineno}" for w in caught if "synchroniz" in str(w.message)]
    return {place: places.count(place) for place in places}


def measure_rays(options: CheckOptions) -> list[Table]:
    """The paper's rendering-time table; in part of its cells beside the paper's scheme and mujoco_warp.rays."""
    sizes = {"num_threads": 2, "device": options.device}
    if options.small:
        own = replace(Options(**sizes), num_bodies=4, rounds=1)
        ours, beside = measure_table(own, max_rays=256_000), measure_table(own, 256_000, (ONE_MESH, RAYS_TREE))
    else:
        ours = measure_table(Options(rounds=5, **sizes))
        beside = measure_table(Options(rounds=3, **sizes), 8_400_000, (ONE_MESH, RAYS_TREE))
    slower = [row[:2] for row in ours.rows if row[2] > row[5]]
    ours.notes.append(f"cells slower than the paper's: {slower or 'none'}")
    rays, num_envs, most = ours.rows[-1][:3]
    ours.notes.append(f"{num_envs} x {rays:,} rays in {most:.1f} ms (bar for 4096 x 32,000: {LARGEST_CELL_MS:g} ms)")
    beside.name, ratios = "paper_table_peers", {}
    for name, bar in ((ONE_MESH, 3.0), (RAYS_TREE, 2.0)):
        column = beside.columns.index(name)
        ratios[name] = min((row[column] / row[2] for row in beside.rows if row[column] == row[column]), default=0.0)
        met = "met" if ratios[name] >= bar else "NOT MET"
        beside.notes.append(f"at least {ratios[name]:.2f} times as fast as {name} (bar {bar:g}: {met})")
    return [ours, beside]


def measure_env(options: CheckOptions) -> list[Table]:
    """Environment steps per second at the paper's setting, and with every point of the sensor; shares of the stages."""
    whole = 300 if options.small else 20_000
    return [
        _measure_steps(options, "env_stages"),
        _measure_steps(options, "env_stages_whole_clouds", f"lidar.num_rays={whole}"),
    ]


def _measure_steps(options: CheckOptions, name: str, *overrides: str) -> Table:
    run = options.run(*overrides)
    seed_everything(run.env.seed)
    env = OmniEnv(replace(run.env, log_interval=10**9, initial_obstacle_level=1.0))
    wait, blocks, steps = device_barrier(options.device), (1 if options.small else 5), 5
    actions = [0.4 * torch.randn(env.num_envs, env.num_actions, device=env.device) for _ in range(steps)]

    def block() -> float:
        wait()
        start = time.perf_counter()
        for action in actions:
            env.step(action)
        wait()
        return time.perf_counter() - start

    with torch.inference_mode():
        block(), block()
        seconds = sorted(block() for _ in range(blocks))[blocks // 2]

        def clock() -> float:
            wait()
            return time.perf_counter()

        env.timer = StageTimer(clock)
        block()
    stages = env.timer.drain()
    total = sum(stages.values())
    rate = env.num_envs * steps / seconds
    table = Table(
        name,
        f"env.step with {env.num_envs} environments, {run.env.lidar.num_rays} rays: {rate:,.0f} env steps/s",
        ("stage", "us per env step", "share, %"),
    )
    for stage, spent in stages.items():
        table.rows.append((stage, 1e6 * spent / (steps * env.num_envs), 100.0 * spent / total))
    share = 100.0 * sum(stages.get(name, 0.0) for name in PERCEPTION_STAGES) / total
    table.notes = [
        "stages were timed with the device waited for at both ends, in a block of their own",
        f"{', '.join(PERCEPTION_STAGES)} together: {share:.0f} % (bar: below 50 %)",
        f"room that was too small: {env.sim.anomalies()}; clouds in {len(env.sensing.lidar.env_slices)} parts",
    ]
    return table


def measure_training(options: CheckOptions) -> list[Table]:
    """A few whole iterations at the paper's setting: throughput, collection and update, memory."""
    run = options.run()
    parts = memory.predict(run)
    runner = build_runner(run, None)
    runner.learn(1 if options.small else 2)
    seconds, iterations = runner.total_time, 1 if options.small else 10
    runner.learn(iterations)
    seconds = (runner.total_time - seconds) / iterations
    rate = runner.env.num_envs * run.ppo.num_steps_per_env / seconds
    table = Table(
        "training",
        f"Whole PPO iterations of experiment=paper with {runner.env.num_envs} environments",
        ("iterations", "s per iteration", "env steps/s"),
        [(iterations, seconds, rate)],
        notes=[f"bar: {STEPS_PER_SECOND:,.0f} env steps/s: {'met' if rate >= STEPS_PER_SECOND else 'NOT MET'}"],
    )
    rows = memory.table(parts, runner.env.num_envs)
    used = Table("memory", "Memory by part, predicted", ("part", "MB shared", "kB per environment", "MB"), rows)
    if options.on_gpu:
        device = runner.env.device
        most = torch.cuda.max_memory_allocated(device) + wp.get_mempool_used_mem_high(wp.get_device(str(device)))
        used.notes = [f"used at most: {most / 1e6:,.0f} MB (PyTorch's and Warp's allocators)"]
    return [table, used]


PARTS: dict[str, Callable[[CheckOptions], list[Table]]] = {
    "tests": check_tests,
    "lidar": check_lidar,
    "steps": check_steps,
    "waits": check_waiting,
    "rays": measure_rays,
    "env": measure_env,
    "training": measure_training,
}
"""In the order in which they run."""


def execute(options: CheckOptions) -> bool:
    """Runs the parts, prints and writes their tables and a summary; whether none of them failed.

    A part that fails is told with its last line and does not keep the others from running.
    """
    about, began, good = machine(2, options.device), time.perf_counter(), True
    summary = Table("summary", f"Checks on {about['device']}", ("part", "s", "result"))
    for name, part in PARTS.items():
        if options.only and name not in options.only:
            continue
        start = time.perf_counter()
        if start - began > 60.0 * options.minutes:
            result = "left out: no time was left"
        else:
            result = _run_part(part, options, about)
            good &= result == "done"
        summary.rows.append((name, time.perf_counter() - start, result))
        write(summary, about, options.out)  # what has been seen is kept, whatever comes
    print(f"{summary.markdown()}\n\n{machine_line(about)}")
    return good


def _run_part(part: Callable[[CheckOptions], list[Table]], options: CheckOptions, about: dict) -> str:
    """One part's tables on the screen and in files; 'done', or what went wrong."""
    try:
        tables = part(options)
    except Exception as error:
        traceback.print_exc()
        return f"FAILED: {type(error).__name__}: {error}".splitlines()[0]
    for table in tables:
        write(table, about, options.out)
        print(f"{table.markdown()}\n", flush=True)
    wrong = [table.name for table in tables if table.details.get("passed") is False]
    return f"WRONG: {', '.join(wrong)}" if wrong else "done"


def _judged(table: Table, passed: bool) -> Table:
    table.details["passed"] = passed
    table.notes.append("passed" if passed else "NOT PASSED")
    return table


def _simulator(options: CheckOptions, device: str, num_envs: int) -> MujocoWarpSimulator:
    env = options.run("obstacles=static").env
    world = build_world(env.robot, env.terrain, env.obstacles, (FOOT_FORCE, OBSTACLE_CONTACT))
    return replace(env.sim, device=device).build(world, num_envs)
