"""Finds where a gait breaks: each row of the randomization alone over multiples of its range, and single kicks.

    robustness run=latest                                   # ranges of randomization=robot times 0.5 to 3
    robustness run=latest rows=latency_s,joint_offset factors=1,2,4,8
    robustness run=latest what=kicks speeds=0.5,1,1.5,2     # under condition=robot, one kick in each trial

Robots follow the commands of scenario=walk on flat ground. Prints a table and draws a picture in the run's evaluation
folder; `out` adds the trials of the ranges to a file. The same command goes on where it was stopped.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from omniperception import build, config
from omniperception.cli import Command, argument, trust
from omniperception.common.figures import PlotsUnavailable
from omniperception.common.tables import markdown
from omniperception.config import ConfigError
from omniperception.evaluation import robustness
from omniperception.evaluation.kicks import AFTER_S, WATCHED_S, KickResults, draw_kicks, kick
from omniperception.evaluation.records import FOLDER, merge
from omniperception.evaluation.suite import Evaluation, World
from omniperception.learning import CheckpointError


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """The command's own arguments."""

    run: str = argument("latest", "run directory, or latest for the newest under outputs/")
    what: str = argument("ranges", "what is tried", choices=("ranges", "kicks"))
    rows: tuple[str, ...] = argument((), "rows of the randomization; none: all that have a range and concern the robot")
    factors: tuple[float, ...] = argument((0.5, 1.0, 1.5, 2.0, 2.5, 3.0), "multiples of the ranges")
    preset: str = argument("robot", "preset of randomization that has the ranges")
    trials: int = argument(200, "trials of each row and factor", least=1)
    speeds: tuple[float, ...] = argument((0.5, 1.0, 1.5, 2.0), "sizes of the kicks (m/s)")
    bearings: int = argument(16, "directions of the kicks, evenly around", least=1)
    repeats: int = argument(16, "kicks of each size and direction", least=1)
    condition: str | None = argument("robot", "preset of conf/condition for kicks, without its pushes")
    out: Path | None = argument(None, "file (.json or .json.gz) that the trials of the ranges are added to")
    trust: tuple[str, ...] = trust()


def main(arguments: Arguments, overrides: list[str]) -> None:
    """Measures, prints a table and draws a picture."""
    run_dir = config.find_run(arguments.run)
    picture = run_dir / FOLDER / f"robustness-{arguments.what}.png"
    picture.parent.mkdir(exist_ok=True)
    if arguments.what == "kicks":
        results = kicked(arguments, run_dir, overrides)
        print(kicks_table(results, arguments.speeds))
        draw_kicks(results, arguments.speeds, arguments.bearings, picture)
    else:
        evaluation = Evaluation(
            [run_dir], [World("walk")], trials=arguments.trials, overrides=tuple(overrides), trust=arguments.trust
        )
        rows = arguments.rows or robustness.rows_of_the_robot(arguments.preset)
        found = robustness.measure(robustness.stretches(evaluation, arguments.preset, rows, arguments.factors))
        print(robustness.table(found))
        robustness.draw(found, picture)
        if arguments.out is not None:
            merge(arguments.out, [record for _, record in found])
            print(f"added to {arguments.out}")
    print(f"wrote {picture}")


def kicked(arguments: Arguments, run_dir: Path, overrides: list[str]) -> KickResults:
    """Kicks the run's policy."""
    given = [] if arguments.condition is None else [f"condition={arguments.condition}"]
    length = f"terminations.episode_length_s={AFTER_S + WATCHED_S}"
    composed = config.load(run_dir, ["scenario=walk", *given, *overrides, length, "num_envs=64"])
    composed.randomization.pushes = None
    trained = build.load_policy(build.assemble(composed, arguments.trust), run_dir)
    try:
        return kick(trained.env, trained.policy, arguments.speeds, arguments.bearings, arguments.repeats)
    except ValueError as error:
        raise ConfigError(str(error)) from None


def kicks_table(results: KickResults, speeds: tuple[float, ...]) -> str:
    """Shares survived by size."""
    rates = [results.rate(speed) for speed in speeds]
    cells = [f"{100 * r['rate']:.1f} [{100 * r['low']:.1f}, {100 * r['high']:.1f}]" for r in rates]
    rows = [[f"{speed:g}", cell] for speed, cell in zip(speeds, cells, strict=True)]
    return markdown(["kick, m/s", f"no fall within {WATCHED_S:g} s, %"], rows) + "\n"


command = Command(main, Arguments, __doc__, "of the run's configuration", (CheckpointError, PlotsUnavailable))
