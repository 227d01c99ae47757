"""The ablation study: trains variants over seeds, evaluates them, and writes the paper's table beside ours."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from omniperception.common.provenance import provenance
from omniperception.config import ConfigError
from omniperception.evaluation.statistics import wilson
from omniperception.evaluation.suite import FOLDER, Evaluation, evaluate
from omniperception.learning import latest_checkpoint

TRAIN = Path(__file__).resolve().parents[2] / "train.py"
RUN_NAME = "${hydra:runtime.choices.perception}/seed${seed}"
"""Where in the study's directory a run lies."""

PAPER = {
    "direct_mlp": "out of memory (24 GB)",
    "fps_mlp": "33.3 | 93.3",
    "fps_gru": "30.0 | 70.0",
    "pd_risknet": "76.7 | 56.7",
}
"""Success and collision rates (%) of the paper's Table 'PD-RiskNet Ablation Results', 30 trials each, in a corridor."""


@dataclass(frozen=True)
class Ablation:
    """What to train and how to evaluate it.

    Attributes:
        out: the study's directory.
        experiment: the recipe that all variants share.
        variants: perception presets.
        seeds: one run of each variant for each.
        scenarios: names from conf/scenario.
        trials: of each run in each scenario.
        overrides: of the training, Hydra's own (such as hydra/launcher=submitit_slurm) included.
    """

    out: Path
    experiment: str
    variants: Sequence[str]
    seeds: Sequence[int]
    scenarios: Sequence[str]
    trials: int = 1000
    overrides: Sequence[str] = field(default_factory=tuple)

    def __post_init__(self) -> None:
        for key in ("variants", "seeds", "scenarios"):
            values = list(getattr(self, key))
            if not values or len(set(values)) < len(values):
                raise ConfigError(f"{key}={','.join(map(str, values))} must name at least one, and none twice")
        for override in self.overrides:
            if override.split("=", 1)[0] in ("experiment", "perception", "seed"):
                raise ConfigError(f"{override}: give experiment=, variants= and seeds= instead")

    def run_dir(self, variant: str, seed: int) -> Path:
        return self.out / variant / f"seed{seed}"


def train(study: Ablation) -> None:
    """Trains what is missing, as one sweep of train.py; runs that were stopped go on, finished ones are left alone."""
    command = [
        sys.executable,
        str(TRAIN),
        "-m",
        f"experiment={study.experiment}",
        f"perception={','.join(study.variants)}",
        f"seed={','.join(map(str, study.seeds))}",
        f"hydra.sweep.dir={study.out}",
        f"hydra.sweep.subdir={RUN_NAME}",
        *study.overrides,
    ]
    done = subprocess.run(command)
    if done.returncode:
        raise ConfigError(f"training ended with exit code {done.returncode}; the same command goes on from there")


def evaluate_all(study: Ablation) -> None:
    """Evaluates every run in every scenario, but for what has been evaluated at the same checkpoint before."""
    for variant in study.variants:
        for seed in study.seeds:
            run_dir = study.run_dir(variant, seed)
            missing = [name for name in study.scenarios if not _evaluated(run_dir, name, study.trials)]
            if missing:
                evaluate(Evaluation(run_dir, missing, trials=study.trials, plots=False))


def write_tables(study: Ablation) -> str:
    """Writes ablation.json and ablation.md into the study's directory; the latter's text."""
    rows = {variant: _row(study, variant) for variant in study.variants}
    text = "\n\n".join(_table(scenario, rows, study) for scenario in study.scenarios) + "\n"
    record = {"experiment": study.experiment, "overrides": list(study.overrides), "rows": rows, **provenance("cpu")}
    (study.out / "ablation.json").write_text(json.dumps(record, indent=2) + "\n")
    (study.out / "ablation.md").write_text(text)
    return text


def pooled(counts: Sequence[tuple[int, int]]) -> dict:
    """Rate over all seeds with Wilson's 95 % interval, and the lowest and the highest of the seeds' rates.

    The interval takes trials for independent; how much seeds differ, the range tells.
    """
    happened, trials = (sum(column) for column in zip(*counts, strict=True))
    low, high = wilson(happened, trials)
    rates = [count / number for count, number in counts]
    return {"rate": happened / trials, "low": low, "high": high, "least": min(rates), "most": max(rates), "n": trials}


def _row(study: Ablation, variant: str) -> dict:
    """Rates of one variant by scenario."""
    row = {}
    for scenario in study.scenarios:
        summaries = [_report(study.run_dir(variant, seed), scenario)["policies"]["run"] for seed in study.seeds]
        row[scenario] = {
            name: pooled([(s["rates"][name]["count"], s["episodes"]) for s in summaries])
            for name in ("success", "success_untouched", "collision", "fall", "time_out")
        }
    return row


def _table(scenario: str, rows: dict, study: Ablation) -> str:
    names = ("success", "success_untouched", "collision", "fall", "time_out")
    paper = scenario == "corridor"
    head = ["variant", *(name.replace("_", " ") + ", %" for name in names)] + [
        "paper: success \\| collision, %"
    ] * paper
    lines = [
        f"**{scenario}**, {study.trials} trials of each of {len(study.seeds)} seeds: rate [95 % interval]"
        " (least to most of the seeds)",
        "",
        "| " + " | ".join(head) + " |",
        "|" + "---|" * len(head),
    ]
    for variant, row in rows.items():
        cells = [variant, *(_cell(row[scenario][name]) for name in names)]
        if paper:
            cells.append(PAPER.get(variant.removesuffix("_small").removesuffix("_rings"), "").replace("|", "\\|"))
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _cell(rate: dict) -> str:
    low, high, least, most = (100 * rate[key] for key in ("low", "high", "least", "most"))
    return f"{100 * rate['rate']:.1f} [{low:.1f}, {high:.1f}] ({least:.1f} to {most:.1f})"


def _report(run_dir: Path, scenario: str) -> dict:
    path = run_dir / FOLDER / f"{scenario}.json"
    if not path.is_file():
        raise ConfigError(f"{path} does not exist: {run_dir} has not been evaluated; use stage=evaluate or stage=all")
    return json.loads(path.read_text())


def _evaluated(run_dir: Path, scenario: str, trials: int) -> bool:
    path = run_dir / FOLDER / f"{scenario}.json"
    if not path.is_file():
        return False
    policies = _report(run_dir, scenario)["policies"]
    if "run" not in policies or policies["run"]["episodes"] < trials:
        return False
    return Path(policies["run"]["checkpoint"]).name == latest_checkpoint(run_dir).name
