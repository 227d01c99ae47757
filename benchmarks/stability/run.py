"""Runs one subject of the stability report: tables on the console, as CSV and JSON, and figures."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from benchmarks.stability import learning, lidar, physics, plots
from benchmarks.stability.report import Row, provenance, table, write
from omniperception import build, config
from omniperception.env.env import EnvConfig


@dataclass(frozen=True)
class Options:
    """What a run of the report needs to know.

    Attributes:
        out: folder of the tables and figures.
        size: gains along each axis of a physics map.
        num_envs: robots of a physics scene.
        seconds: of a physics scene.
        rays: of each LiDAR case.
        many: rays of the case with very many.
        iterations: of each training.
        only: part of the names of the learning cases to run, or of the parts "floating", "standing" and "scenes".
        overrides: of the configuration whose robot and physics settings are tried.
    """

    out: Path
    size: int
    num_envs: int
    seconds: float
    rays: int
    many: int
    iterations: int
    only: str
    overrides: tuple[str, ...]


def execute(subject: str, options: Options) -> bool:
    """Whether everything that can be judged is as it should be."""
    options.out.mkdir(parents=True, exist_ok=True)
    about = provenance({"subject": subject, **{k: str(v) for k, v in vars(options).items()}})
    with _engine_log_in(options.out):
        return SUBJECTS[subject](options, about)


def _lidar(options: Options, about: Mapping[str, object]) -> bool:
    rows = lidar.run(options.rays, options.many)
    _show(options.out, "lidar", rows, about, ["case", "good", "rays", "wrong", "worst error", "expected", "either way"])
    return _good(rows)


def _learning(options: Options, about: Mapping[str, object]) -> bool:
    rows = []
    print("| case | good | outcome |\n| --- | --- | --- |")
    for case in learning.cases():
        if options.only in case.name:
            row = learning.run_case(case, options.iterations)
            rows.append(row)
            print(f"| {row['case']} | {'yes' if row['good'] else 'NO'} | {row['outcome']} |", flush=True)
    write(options.out, "learning", rows, about)
    if options.only:
        return _good(rows)
    clouds = learning.clouds()
    _show(options.out, "clouds", clouds, about, ["cloud", "sampler", "good", "all zero"])
    precision = learning.precision()
    _show(options.out, "precision", precision, about, ["layer", "output", "gradient"])
    plots.draw_precision(precision, options.out / "precision.png")
    return _good([*rows, *clouds])


def _physics(options: Options, about: Mapping[str, object]) -> bool:
    env = build.assemble(config.compose([*BLIND, "obstacles=static", *options.overrides])).env
    paper = build.assemble(config.compose([*BLIND, "randomization=paper"])).env.randomization
    good = True
    if options.only in "scenes":
        gains = env.robot.kp, env.robot.kv
        rows = [physics.play(scene, options.seconds, gains) for scene in physics.scenes(env, options.num_envs, paper)]
        _show(options.out, "scenes", rows, about, list(rows[0]))
    if options.only in "floating":
        floating = list(_maps(physics.INTEGRATORS, physics.stability_map, env, options.size, 200))
        good = _tell_maps(options.out, "floating", floating, about)
        plots.draw_maps(floating, "log10 of late over initial energy", (-3.0, 3.0), options.out / "floating.png")
    if options.only in "standing":
        standing = list(_maps((env.sim.integrator,), physics.standing_map, env, options.size, 1.0))
        _tell_maps(options.out, "standing", standing, about)
        plots.draw_maps(standing, "log10 of late joint speed (rad/s)", (-2.0, 2.0), options.out / "standing.png")
    return good


BLIND = ("perception=none", "lidar=none", "rewards=walk", "observations=walk")
AGREEMENT = 0.99
"""Least share of gains where the analytic limit and the simulation must say the same."""


def _maps(
    integrators: Sequence[str], make: Callable[..., physics.Map], env: EnvConfig, size: int, length: float
) -> Iterator[physics.Map]:
    for integrator in integrators:
        for outside in (False, True):
            for step in physics.STEPS_MS:
                yield make(env, integrator, step, outside, size, length)


def _tell_maps(out: Path, name: str, maps: Sequence[physics.Map], about: Mapping[str, object]) -> bool:
    """Writes every cell and prints one row a map."""
    cells = [
        {"integrator": m.integrator, "outside": m.outside, "step ms": m.step_ms, "kp": m.kp[j], "kv": m.kv[i]}
        | {"log10": m.growth[i, j], "caught": bool(m.failed[i, j]), "radius": m.radius[i, j]}
        for m in maps
        for i in range(len(m.kv))
        for j in range(len(m.kp))
    ]
    write(out, f"{name}_cells", cells, about)
    rows = [
        {"integrator": m.integrator, "PD": "outside" if m.outside else "in engine", "step ms": m.step_ms}
        | {"gains": m.growth.size, "unrest": float((m.growth > 0).mean()), "caught": float(m.failed.mean())}
        | ({"theory": float((m.radius > 1).mean()), "agreement": m.agreement} if m.radius.any() else {})
        for m in maps
    ]
    _show(out, name, rows, about, list(rows[0]))
    return all(row.get("agreement", 1.0) >= AGREEMENT for row in rows)


def _show(out: Path, name: str, rows: Sequence[Row], about: Mapping[str, object], columns: Sequence[str]) -> None:
    write(out, name, rows, about)
    print(f"\n{table(rows, columns)}", flush=True)


def _good(rows: Sequence[Row]) -> bool:
    return all(row["good"] for row in rows)


@contextmanager
def _engine_log_in(out: Path) -> Iterator[None]:
    """Keeps the engine's log of diverged simulations, MUJOCO_LOG.TXT, in the report's folder."""
    before = os.getcwd()
    os.chdir(out)
    try:
        yield
    finally:
        os.chdir(before)


SUBJECTS = {"physics": _physics, "lidar": _lidar, "learning": _learning}
