"""Trains networks, ways of training and seeds against each other, evaluates them, and writes tables with intervals.

    ablate study=end_to_end                                  # the paper's ablation, end to end: PPO alone, and taught
    ablate study=avoider,avoider_ppo sim.num_threads=1       # avoiders of experiment=avoid, and what PPO adds
    ablate variants=fps_mlp_small,polar_rings seeds=1,2      # of study=perception
    ablate stage=train hydra/launcher=submitit_slurm hydra.launcher.partition=cpu

A study is a file of conf/study; the arguments below replace what it says. Runs lie in <out>/<arm>/<variant>/seed<seed>.
The same command goes on where it was stopped: finished runs and evaluations are left alone. A variant is a preset of
`perception`, or a name from `VARIANTS` in omniperception/evaluation/ablation.py (such as polar_rings_no_match), which
lists its overrides. On a cluster, with pip install 'omniperception[train,cluster]', give stage=train and Hydra's
launcher; nothing else differs. Writes <out>/ablation.md, and every trial into <out>/results.json.gz,
which tables reads.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from omniperception import config
from omniperception.evaluation.ablation import (
    Ablation,
    check_trainings,
    evaluate_all,
    load_study,
    train,
    write_tables,
)
from omniperception.evaluation.trials.policies import POLICIES, SPLITS
from omnirobot.common.cli import Command, argument, trust
from omnirobot.common.errors import check_known

STAGES = ("train", "evaluate", "table", "all")


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """The command's own arguments."""

    stage: str = argument("all", "what is done", choices=STAGES)
    study: tuple[str, ...] = argument(("perception",), "files of conf/study, one after the other")
    out: Path | None = argument(None, "folder of the study, where there is one; null: outputs/<study>")
    experiment: str | None = argument(None, "recipe that all trainings share; null, here and below: the study's")
    arms: tuple[str, ...] | None = argument(None, "those of its ways of training that are meant")
    variants: tuple[str, ...] | None = argument(None, "perception variants")
    seeds: tuple[int, ...] | None = argument(None, "seeds; each variant is trained with each", least=0)
    scenarios: tuple[str, ...] | None = argument(None, "where they are evaluated; all: those of the held-out suite")
    suite: str | None = argument(None, "file of conf/suite, such as held_out, in place of scenarios")
    conditions: tuple[str, ...] | None = argument(None, "presets of conf/condition")
    policies: tuple[str, ...] | None = argument(None, "policies, as of evaluate", choices=tuple(POLICIES))
    split: str | None = argument(None, "obstacles and seeds for choosing, or for reporting", choices=SPLITS)
    trials: int | None = argument(None, "trials of each run in each scenario", least=1)
    trust: tuple[str, ...] = trust()


def main(arguments: Arguments, overrides: list[str]) -> None:
    """Runs the stages of the study."""
    if arguments.out is not None and len(arguments.study) > 1:
        raise config.ConfigError(
            f"out={arguments.out} is the folder of one study, {len(arguments.study)} are given; leave it out"
        )
    ablations = [_ablation(name, arguments, overrides) for name in arguments.study]
    if arguments.stage in ("train", "all"):
        for ablation in ablations:
            check_trainings(ablation)
    for ablation in ablations:
        if arguments.stage in ("train", "all"):
            train(ablation)
        if arguments.stage in ("evaluate", "all"):
            evaluate_all(ablation)
        if arguments.stage in ("table", "all"):
            print(write_tables(ablation))


def _ablation(name: str, arguments: Arguments, overrides: list[str]) -> Ablation:
    """A study as the arguments change it, in its folder."""
    names = ("experiment", "variants", "seeds", "scenarios", "suite", "conditions", "policies", "split", "trials")
    given = {name: value for name in names if (value := getattr(arguments, name)) is not None}
    if ("suite" in given) != ("scenarios" in given):  # one takes the place of the other
        given = {"suite": None, "scenarios": ()} | given
    study = replace(load_study(name, config.search_path(overrides)), **given)
    if arguments.arms is not None:
        check_known("arms", arguments.arms, tuple(study.arms))
        study = replace(study, arms={name: arm for name, arm in study.arms.items() if name in arguments.arms})
    if arguments.stage == "all" and "exported" in study.policies:
        raise config.ConfigError(
            "policies=exported: no run is exported yet; give stage=train, export each run, then give stage=evaluate"
        )
    return Ablation(study, arguments.out or config.OUTPUTS / name, tuple(overrides), arguments.trust)


command = Command(main, Arguments, __doc__, "of the trainings")
