"""Trains perception variants over seeds, evaluates them in scenarios, and writes tables with intervals.

    ablate variants=fps_mlp_small,fps_gru_small,polar_rings seeds=1,2,3
    ablate stage=train hydra/launcher=submitit_slurm hydra.launcher.partition=cpu

Runs lie in <out>/<variant>/seed<seed>. The same command goes on where it was stopped: finished runs and evaluations are
left alone. A variant is a preset of `perception`, or a name from `VARIANTS` in omniperception/evaluation/ablation.py
(such as polar_rings_no_match), which lists its overrides. On a cluster, with pip install
'omniperception[train,cluster]', give stage=train and Hydra's launcher; nothing else differs. Writes
<out>/ablation.md and ablation.json.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from omniperception import config
from omniperception.cli import Command, argument, trust
from omniperception.evaluation.ablation import Ablation, evaluate_all, train, write_tables
from omniperception.evaluation.suite import held_out_scenarios
from omniperception.learning import CheckpointError

STAGES = ("train", "evaluate", "table", "all")


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """The command's own arguments."""

    stage: str = argument("all", "what is done", choices=STAGES)
    out: Path = argument(Path("outputs/ablation"), "folder of the study")
    experiment: str = argument("avoid", "recipe that all variants share")
    variants: tuple[str, ...] = argument(("fps_mlp_small", "fps_gru_small", "polar_rings"), "perception variants")
    seeds: tuple[int, ...] = argument((1, 2, 3), "seeds; each variant is trained with each", least=0)
    scenarios: tuple[str, ...] = argument(("all",), "where they are evaluated")
    trials: int = argument(250, "trials of each run in each scenario", least=1)
    trust: tuple[str, ...] = trust()


def main(arguments: Arguments, overrides: list[str]) -> None:
    """Runs the stages of the study."""
    known = config.presets("scenario", config.search_path(overrides))
    for name in arguments.scenarios:
        if name not in (*known, "all"):
            raise config.ConfigError(f"scenarios={name} is unknown; {config.suggest(name, known)}")
    study = Ablation(
        out=arguments.out,
        experiment=arguments.experiment,
        variants=arguments.variants,
        seeds=arguments.seeds,
        scenarios=held_out_scenarios() if arguments.scenarios == ("all",) else arguments.scenarios,
        trials=arguments.trials,
        overrides=tuple(overrides),
        trust=arguments.trust,
    )
    if arguments.stage in ("train", "all"):
        train(study)
    if arguments.stage in ("evaluate", "all"):
        evaluate_all(study)
    if arguments.stage in ("table", "all"):
        print(write_tables(study))


command = Command(main, Arguments, __doc__, "of the training", (CheckpointError,))
