"""Evaluates runs in fixed worlds: how often they arrive untouched, beside baselines, and all that goes with it.

    evaluate run=latest scenario=corridor,static policy=run,blind trials=100
    evaluate run=pretrained/avoider suite=held_out split=test condition=robot policy=run,blind,oracle
    evaluate run=outputs/a,outputs/b,outputs/c suite=held_out    # the same training with three seeds

A scenario from conf/scenario replaces the run's obstacles, commands, terminations, terrain and seed, a condition from
conf/condition its randomization; the run keeps its robot, LiDAR, observations, rewards and networks. Overrides go on
top. `suite` is a file of conf/suite: scenarios and the terrains that each is run on. Trial k is the same scene for
every policy and any number of environments. On split=dev the seed is the scenario's; use it to choose anything. On
split=test the obstacles are of sizes beyond the scene's own, half of the boxes, cylinders and spheres of kinds that no
training scene has, the seed follows from the hash of the run's weights, and each result is noted in `log`. Policies:

    run        the run's
    blind      the same, as it acts before its first frame
    stop       follows V_cmd, which falls to zero while something is near in its direction
    histogram  follows V_cmd + V_avoid, by the run's avoidance controller from the raw cloud by geometry
    oracle     follows V_cmd + V_avoid, by the run's avoidance controller from ground truth
    exported   the run's as the export command wrote it, on raw points, joint states and IMU, with the limits of its
               runtime

`stop`, `histogram` and `oracle` drive the gait of `walker`, or without one the run's own, which then sees no frame.

Prints one table. Each policy and world becomes a JSON file with every trial in the run's evaluation folder at once; the
same command goes on where it was stopped. `out` adds all of them to one file, which the tables command renders.

With viewer=web the first policy walks in the first world before your eyes, in the browser; nothing is measured or
written, and the page switches worlds, conditions and policies.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING

from omniperception import config
from omniperception.config import ConfigError
from omniperception.evaluation.trials.policies import DRIVEN, POLICIES, Settings
from omniperception.viewer import Shown, serve
from omniperception.viewer.options import PAGE, PageArguments
from omnirobot.common.cli import Command, argument, refuse_arguments

if TYPE_CHECKING:
    from omniperception.evaluation.suite import World

MEASURED = ("trials", "num_envs", "jobs", "plots", "again", "out", "log")
"""Arguments about what is measured."""


@dataclass(frozen=True, kw_only=True)
class Arguments(Settings, PageArguments):
    """The command's own arguments."""

    run: tuple[Path, ...] = argument((Path("latest"),), "run directories, or latest for the newest under outputs/")
    suite: str | None = argument(None, "file of conf/suite, such as held_out: many worlds")
    scenario: tuple[str, ...] = argument(
        (), "scenarios in place of a suite, or all of held_out; corridor without either"
    )
    policy: tuple[str, ...] = argument(("run",), "policies", choices=tuple(POLICIES))
    walker: str | None = argument(
        None, "run directory of experiment=walk or gait, whose gait stop, histogram and oracle drive"
    )
    viewer: str = argument("none", "web: look at the first policy in the first world", choices=("none", "web"))


def main(arguments: Arguments, overrides: list[str]) -> None:
    """Evaluates, prints the table and writes the runs' evaluation folders."""
    runs = [config.find_run(str(name)) for name in arguments.run]
    folders = config.search_path(overrides, config.read(runs[0]))
    worlds = _worlds(arguments, folders, any(o.split("=", 1)[0] == "terrain" for o in overrides))
    if arguments.viewer == "web":
        refuse_arguments(arguments, MEASURED, "viewer=web measures nothing")
        return serve(_shown(arguments, runs[0], worlds[0], overrides), arguments.page)
    refuse_arguments(arguments, PAGE, f"viewer={arguments.viewer} has no page")
    if arguments.split != "test":
        refuse_arguments(arguments, ("log",), "only split=test is noted")
    if not set(DRIVEN) & set(arguments.policy):
        refuse_arguments(arguments, ("walker",), f"none of policy={','.join(arguments.policy)} drives a gait")
    given = {field.name: getattr(arguments, field.name) for field in fields(Settings)}
    walker = config.find_run(arguments.walker, "walker") if arguments.walker else None
    from omniperception.evaluation.suite import Evaluation, evaluate

    evaluate(Evaluation(runs, worlds, policies=arguments.policy, walker=walker, overrides=tuple(overrides), **given))


def _shown(arguments: Arguments, run_dir: Path, world: World, overrides: list[str]) -> Shown:
    """What the browser shows of an evaluation."""
    if arguments.split == "test":
        raise ConfigError("viewer=web shows split=dev: who has looked at the test split has chosen by it")
    if arguments.policy[0] == "exported" or arguments.walker is not None:
        raise ConfigError("viewer=web shows policy=run and those that drive the run's own gait; leave walker= out")
    presets = [f"scenario={world.name}"]
    presets += [f"terrain={world.terrain}"] if world.terrain is not None else []
    presets += [f"condition={arguments.condition}"] if arguments.condition is not None else []
    return Shown(run_dir, (*overrides, *presets), arguments.policy[0], trust=arguments.trust)


def _worlds(arguments: Arguments, folders: list[Path], terrain_given: bool) -> list[World]:
    """The worlds of a suite, or the scenarios on their own terrain."""
    from omniperception.evaluation.suite import World, held_out_scenarios, suite_worlds  # brings PyTorch

    if arguments.suite is None:
        names = arguments.scenario or ("corridor",)
        if names == ("all",):
            names = held_out_scenarios()
        return [World(name) for name in names]
    if arguments.scenario:
        raise ConfigError(f"suite={arguments.suite} has its own worlds; leave scenario= out, or suite=")
    if terrain_given:
        raise ConfigError(f"suite={arguments.suite} says on which terrains; use scenario= with terrain=")
    return suite_worlds(arguments.suite, folders)


command = Command(main, Arguments, __doc__, "of the runs' configuration")
