"""Trials over the robot's wire in real time: robot-sim, robot and its guard as processes, with and without faults.

    R="run=pretrained/avoider policy=pretrained/avoider/exported condition=ideal"
    robot-trials $R scenario=moving,corridor trials=100 out=outputs/wire
    robot-trials $R scenario=static faults=all trials=3 out=outputs/faults
    robot-trials table=true out=outputs/wire                    # the tables again, from the files

Writes a file for each trial; the same command goes on where it was stopped, and a folder with results of another run,
policy, limit or other overrides is refused. Prints two tables: outcomes with 95 %
intervals, and timing: p50 and p99 of a control step and of how late it began, steps later than half a period, LiDAR
frames, lost packets, and by how much the simulation was behind real time. The tables mean something only on a machine
with a free core for each of the three processes: look at the lag first.

Beside them, in one process and without a wire, under the same condition (the run's own is what it was trained under):
evaluate run=pretrained/avoider policy=exported condition=ideal scenario=moving,corridor trials=100, which reads
exported/ in the run directory, where export writes unless told otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from omniperception import config
from omniperception.deploy.trials import KNOWN_FAULTS, NO_FAULT, TrialsConfig, results, run, table
from omnirobot.common.cli import Command, argument, trust
from omnirobot.common.errors import check_known


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """The command's own arguments."""

    run: str = argument("latest", "run directory, for the robot, its LiDAR and the worlds")
    policy: Path = argument(Path("exported"), "folder that export has written")
    scenario: tuple[str, ...] = argument(("moving", "corridor"), "of conf/scenario")
    faults: tuple[str, ...] = argument((NO_FAULT,), "while it walks, or all", choices=(*KNOWN_FAULTS, "all"))
    trials: int = argument(100, "of each scenario and fault", least=1)
    limit_s: float = argument(30.0, "from standing up, within which the goal has to be reached", positive=True)
    out: Path = argument(Path("outputs/wire"), "folder of the results")
    trust: tuple[str, ...] = trust()
    table: bool = argument(False, "whether only the tables of the results that are there are printed")


def main(arguments: Arguments, overrides: list[str]) -> None:
    """Tries and prints the tables."""
    if not arguments.table:
        faults = KNOWN_FAULTS if "all" in arguments.faults else arguments.faults
        folder = str(config.find_run(arguments.run))
        known = config.presets("scenario", config.search_path(overrides, config.read(Path(folder))))
        check_known("scenario", arguments.scenario, known)
        given = {name: getattr(arguments, name) for name in ("policy", "out", "trials", "limit_s", "trust")}
        run(TrialsConfig(folder, scenarios=arguments.scenario, faults=faults, overrides=overrides, **given))
    print(table(results(arguments.out)))


command = Command(main, Arguments, __doc__, overrides="of the run's configuration")
