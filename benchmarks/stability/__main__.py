"""Where physics, LiDAR and learning hold and where they break, and that nothing breaks silently.

    python scripts/stability.py subject=physics sim.timestep=0.002
    python scripts/stability.py subject=lidar rays=10000

physics   gains kp 5..2000, kv 0..50 by step 0.5..10 ms and integrator, PD in the engine and outside, with the analytic
          limit of the linearised joints; corners of the randomization, drops, impacts, overlaps, wild targets, latency.
          only=floating, only=standing or only=scenes runs one part. Overrides change the robot and the physics.
lidar     rays far away, at tiny and huge bodies, bad triangles, grazing, inside, without poses, none and very many,
          each against float64
learning  extreme rewards, observations, clouds, noise, gradients and batches, what training makes of them; float32
          against float64 by layer

Writes CSV, JSON, Markdown and figures (extra `plots`). Exit status 1 if something is not as it should be.
docs/lab/stability.md holds what was measured.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.harness.table import Table, about, report
from benchmarks.stability import learning, lidar, physics, plots
from omniperception import build, config
from omniperception.config import ConfigError
from omniperception.env.config import EnvConfig
from omnirobot.common.cli import Command, argument, refuse_arguments

BLIND = ("~experiment", "perception=none", "lidar=none", "rewards=walk", "observations=walk")
PARTS = ("floating", "standing", "scenes")
"""Of subject=physics."""
AGREEMENT = 0.99
"""Least share of gains where the analytic limit and the simulation must say the same."""


OWN = {"physics": ("size", "num_envs", "seconds"), "lidar": ("rays", "many"), "learning": ("iterations",)}
"""Arguments that one subject alone reads."""


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """The command line."""

    subject: str = argument(doc="what is tried", choices=("physics", "lidar", "learning"))
    out: Path | None = argument(None, "folder of the results; outputs/stability/<subject>")
    only: str = argument("", "learning: cases whose names contain this; physics: floating, standing or scenes")
    size: int = argument(12, "physics: gains along each axis of a map", least=2)
    num_envs: int = argument(32, "physics: robots of a scene", least=1)
    seconds: float = argument(4.0, "physics: of a scene", positive=True)
    rays: int = argument(2000, "lidar: rays of each case", least=1)
    many: int = argument(1_000_000, "lidar: rays of the case with very many", least=1)
    iterations: int = argument(3, "learning: iterations of each training", least=1)

    @property
    def folder(self) -> Path:
        return (self.out or Path("outputs/stability") / self.subject).resolve()


def _lidar(given: Arguments, overrides: list[str]) -> Iterator[Table]:
    yield judged("lidar", "rays at the extremes against float64", lidar.run(given.rays, given.many))


def _learning(given: Arguments, overrides: list[str]) -> Iterator[Table]:
    cases = [case for case in learning.cases() if given.only in case.name]
    yield judged("learning", "training at the extremes", [learning.run_case(case, given.iterations) for case in cases])
    if not given.only:
        yield judged("clouds", "samplers of degenerate clouds", learning.clouds())
        precision = learning.precision()
        yield Table.of("precision", "float32 against float64 by layer", precision)
        plots.draw_precision(precision, given.folder / "precision.png")


def _physics(given: Arguments, overrides: list[str]) -> Iterator[Table]:
    env = build.assemble(config.compose([*BLIND, "obstacles=static", *overrides])).env
    paper = build.assemble(config.compose([*BLIND, "randomization=paper"])).env.randomization
    if given.only in ("", "scenes"):
        gains = env.robot.kp, env.robot.kv
        rows = [physics.play(scene, given.seconds, gains) for scene in physics.scenes(env, given.num_envs, paper)]
        yield Table.of("scenes", f"robots in trouble for {given.seconds:g} s", rows)
    if given.only in ("", "floating"):
        maps = list(_maps(physics.INTEGRATORS, physics.stability_map, env, given.size, 200))
        yield from _map_tables("floating", maps)
        plots.draw_maps(maps, "log10 of late over initial energy", (-3.0, 3.0), given.folder / "floating.png")
    if given.only in ("", "standing"):
        maps = list(_maps((env.sim.integrator,), physics.standing_map, env, given.size, 1.0))
        yield from _map_tables("standing", maps)
        plots.draw_maps(maps, "log10 of late joint speed (rad/s)", (-2.0, 2.0), given.folder / "standing.png")


def _maps(
    integrators: Sequence[str], make: Callable[..., physics.Map], env: EnvConfig, size: int, length: float
) -> Iterator[physics.Map]:
    for integrator in integrators:
        for outside in (False, True):
            for step in physics.STEPS_MS:
                yield make(env, integrator, step, outside, size, length)


def _map_tables(name: str, maps: Sequence[physics.Map]) -> Iterator[Table]:
    """One row a map; and every cell, for plots of one's own."""
    rows = [
        {"integrator": m.integrator, "PD": "outside" if m.outside else "in engine", "step ms": m.step_ms}
        | {"gains": m.growth.size, "unstable": float((m.growth > 0).mean()), "caught": float(m.failed.mean())}
        | ({"theory": float((m.radius > 1).mean()), "agreement": m.agreement} if m.radius.any() else {})
        for m in maps
    ]
    table = Table.of(name, f"gains by step and integrator, robots {name}", rows)
    table.details["passed"] = all(row.get("agreement", 1.0) >= AGREEMENT for row in rows)
    table.details["cells"] = [
        {"integrator": m.integrator, "outside": m.outside, "step ms": m.step_ms, "kp": m.kp[j], "kv": m.kv[i]}
        | {"log10": m.growth[i, j], "caught": bool(m.failed[i, j]), "radius": m.radius[i, j]}
        for m in maps
        for i in range(len(m.kv))
        for j in range(len(m.kp))
    ]
    yield table


def judged(name: str, title: str, rows: Sequence[dict]) -> Table:
    """A table that has passed if every row is good."""
    table = Table.of(name, title, rows)
    table.details["passed"] = all(row["good"] for row in rows)
    return table


SUBJECTS = {"physics": _physics, "lidar": _lidar, "learning": _learning}


def _check_only(given: Arguments) -> None:
    """Raises a ConfigError for an `only` that would run nothing."""
    known = {"physics": PARTS, "lidar": (), "learning": tuple(case.name for case in learning.cases())}[given.subject]
    runs = given.only in ("", *known) or (given.subject == "learning" and any(given.only in name for name in known))
    if not runs:
        expected = f"one of {', '.join(known)} was expected" if known else "it is not divided"
        raise ConfigError(f"only={given.only} runs nothing of subject={given.subject}: {expected}")


def main(given: Arguments, overrides: list[str]) -> None:
    """Runs a subject, and exits with 1 if something is not as it should be."""
    if overrides and given.subject != "physics":
        raise ConfigError(f"{overrides[0]} is unknown for subject={given.subject}; overrides are for subject=physics")
    for subject, names in OWN.items():
        if subject != given.subject:
            refuse_arguments(given, names, f"it is of subject={subject}")
    _check_only(given)
    given.folder.mkdir(parents=True, exist_ok=True)
    with contextlib.chdir(given.folder):  # which takes the engine's log of diverged simulations, MUJOCO_LOG.TXT
        tables = report(SUBJECTS[given.subject](given, overrides), about(1), given.folder)
    sys.exit(0 if all(table.details.get("passed", True) for table in tables) else 1)


command = Command(main, Arguments, __doc__, "of the robot and of sim (subject=physics)")

if __name__ == "__main__":
    command()
