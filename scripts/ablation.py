"""Trains perception variants over seeds, evaluates them in scenarios, and writes the paper's table beside ours.

    python scripts/ablation.py [stage=all|train|evaluate|table] [out=outputs/ablation] [experiment=avoid]
        [variants=fps_mlp_small,fps_gru_small,pd_risknet_rings] [seeds=1,2,3] [scenarios=corridor,static|all]
        [trials=1000] [overrides of the training]

Runs lie in <out>/<variant>/seed<seed>. The same command goes on where it was stopped: finished runs and evaluations
are left alone. On a cluster, with pip install 'omniperception[cluster]': stage=train hydra/launcher=submitit_slurm, and
what hydra.launcher.* of it needs; nothing else differs. Writes <out>/ablation.md and ablation.json.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from omniperception import config
from omniperception.evaluation.ablation import Ablation, evaluate_all, train, write_tables
from omniperception.learning import CheckpointError

STAGES = ("train", "evaluate", "table")
ARGUMENTS = {
    "stage": "all",
    "out": "outputs/ablation",
    "experiment": "avoid",
    "variants": "fps_mlp_small,fps_gru_small,pd_risknet_rings",
    "seeds": "1,2,3",
    "scenarios": "all",
    "trials": "1000",
}


def parse(arguments: Sequence[str]) -> tuple[Ablation, tuple[str, ...]]:
    """The study and the stages to run."""
    own, overrides = config.split_arguments(arguments, ARGUMENTS)
    if own["stage"] not in (*STAGES, "all"):
        raise config.ConfigError(f"stage={own['stage']} must be one of {', '.join(STAGES)}, all")
    study = Ablation(
        out=Path(own["out"]),
        experiment=own["experiment"],
        variants=own["variants"].split(","),
        seeds=[config.positive("seeds", seed, int) for seed in own["seeds"].split(",")],
        scenarios=config.scenarios() if own["scenarios"] == "all" else own["scenarios"].split(","),
        trials=config.positive("trials", own["trials"], int),
        overrides=overrides,
    )
    return study, STAGES if own["stage"] == "all" else (own["stage"],)


def main() -> None:
    if {"-h", "--help"} & set(sys.argv[1:]):
        print(__doc__)
        return
    with config.one_line_errors(CheckpointError):
        study, stages = parse(sys.argv[1:])
        if "train" in stages:
            train(study)
        if "evaluate" in stages:
            evaluate_all(study)
        if "table" in stages:
            print(write_tables(study))


if __name__ == "__main__":
    main()
