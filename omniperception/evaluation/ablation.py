"""The ablation study: trains variants over seeds, evaluates them, and writes tables."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from omniperception import config
from omniperception.common.provenance import provenance
from omniperception.common.tables import markdown
from omniperception.config import ConfigError
from omniperception.evaluation.records import FOLDER, Record, read
from omniperception.evaluation.statistics import pooled
from omniperception.evaluation.suite import Evaluation, World, evaluate, weights_hash

_NO_PROXIMAL = ("perception.height_weight=0", "perception.sampler.num_proximal=0", "perception.network.proximal_dim=0")
_NO_DISTAL = ("perception.sampler.num_distal=0", "perception.network.distal_dim=0")
VARIANTS: dict[str, tuple[str, ...]] = {
    "pd_risknet_no_proximal": ("perception=pd_risknet", *_NO_PROXIMAL),
    "pd_risknet_no_distal": ("perception=pd_risknet", *_NO_DISTAL),
    "proximity_gru_no_proximal": ("perception=proximity_gru", *_NO_PROXIMAL),
    "polar_rings_no_proximal": ("perception=polar_rings", *_NO_PROXIMAL),
    "polar_rings_no_height": ("perception=polar_rings", "perception.height_weight=0"),
    "polar_rings_no_match": ("perception=polar_rings", "perception.network.rings.match=null"),
}
"""Overrides of the variants that are no presets of `perception`; what the perception is supervised with is the
experiment's."""

RATES = {
    "untouched": "reached, untouched",
    "success": "reached",
    "collision": "touched",
    "fall": "falls",
    "time_out": "time-outs",
}
"""Rates in a row, and what the table calls them; the first decides."""
PAPER = {
    "direct_mlp": "out of memory (24 GB)",
    "fps_mlp": "33.3 | 93.3",
    "fps_gru": "30.0 | 70.0",
    "pd_risknet": "76.7 | 56.7",
}
"""Success and collision rates (%) of the paper's Table 'PD-RiskNet Ablation Results', by the preset of that network.

30 trials each in Isaac Gym, in a corridor that its text describes in part, of policies trained end to end: shown beside
ours, in our corridor and with our training, and not to be compared with it.
"""


@dataclass(frozen=True)
class Ablation:
    """Settings of an ablation study.

    Attributes:
        out: the study's directory.
        experiment: the recipe that all variants share.
        variants: perception presets, or names from VARIANTS.
        seeds: one run of each variant for each.
        scenarios: names from conf/scenario.
        trials: of each run in each scenario.
        overrides: of the training, Hydra's own (such as hydra/launcher=submitit_slurm) included.
        trust: packages of one's own whose names the configuration may build.
    """

    out: Path
    experiment: str
    variants: Sequence[str]
    seeds: Sequence[int]
    scenarios: Sequence[str]
    trials: int = 1000
    overrides: Sequence[str] = ()
    trust: Sequence[str] = ()

    def __post_init__(self) -> None:
        if len(set(self.seeds)) < len(self.seeds):
            raise ConfigError(f"seeds={','.join(map(str, self.seeds))} names one twice; each is one run")
        known = (*VARIANTS, *config.presets("perception", config.search_path(self.overrides)))
        for variant in self.variants:
            if variant not in known:
                raise ConfigError(f"variants={variant} is unknown; {config.suggest(variant, known)}")
        for override in config.parse(self.overrides):
            if override.key_or_group in ("experiment", "perception", "seed"):
                raise ConfigError(f"{override.input_line}: give experiment=, variants= and seeds= instead")

    def run_dir(self, variant: str, seed: int) -> Path:
        return self.out / variant / f"seed{seed}"


def train(study: Ablation) -> None:
    """Trains what is missing, a sweep over the seeds for each variant.

    Stopped runs go on, finished ones are left alone. With a launcher of Hydra's (a cluster) the variants are trained at
    the same time, otherwise one after the other.
    """
    together = any(override.startswith("hydra/launcher=") for override in study.overrides)
    running = []
    for variant in study.variants:
        command = [
            *(sys.executable, "-m", "omniperception", "train", "-m", f"experiment={study.experiment}"),
            *overrides_of(variant),
            f"seed={','.join(map(str, study.seeds))}",
            f"hydra.sweep.dir={study.out}",
            f"hydra.sweep.subdir={variant}/seed${{seed}}",
            *study.overrides,
        ]
        running.append(subprocess.Popen(command))
        if not together:
            _wait(running.pop())
    for process in running:
        _wait(process)


def overrides_of(variant: str) -> tuple[str, ...]:
    """Overrides of a variant: a preset of `perception`, or one of VARIANTS."""
    return VARIANTS.get(variant, (f"perception={variant}",))


def _wait(process: subprocess.Popen) -> None:
    if process.wait():
        raise ConfigError(f"training ended with exit code {process.returncode}; the same command goes on from there")


def evaluate_all(study: Ablation) -> None:
    """Evaluates every run in every scenario, but for what the same code has evaluated at the same checkpoint before."""
    for variant in study.variants:
        for seed in study.seeds:
            worlds = [World(name) for name in study.scenarios]
            evaluate(Evaluation([study.run_dir(variant, seed)], worlds, trials=study.trials, trust=study.trust))


def write_tables(study: Ablation) -> str:
    """Writes ablation.json and ablation.md into the study's directory; the latter's text."""
    rows = {variant: _row(study, variant) for variant in study.variants}
    text = "\n\n".join(_table(scenario, rows, study) for scenario in study.scenarios) + "\n"
    record = {"experiment": study.experiment, "overrides": list(study.overrides), "rows": rows, **provenance("cpu")}
    (study.out / "ablation.json").write_text(json.dumps(record, indent=2) + "\n")
    (study.out / "ablation.md").write_text(text)
    return text


def _row(study: Ablation, variant: str) -> dict:
    """Rates of one variant by scenario, over all seeds."""
    row = {}
    for scenario in study.scenarios:
        happened = [_record(study, study.run_dir(variant, seed), scenario).episodes.happened() for seed in study.seeds]
        row[scenario] = {name: pooled([by_name[name] for by_name in happened]) for name in RATES if name in happened[0]}
    return row


def _table(scenario: str, rows: dict, study: Ablation) -> str:
    columns = ["variant", *(f"{label}, %" for label in RATES.values())]
    cells = [[variant, *(_cell(row[scenario].get(name)) for name in RATES)] for variant, row in rows.items()]
    if scenario == "corridor":
        columns.append("paper (30 trials of its own scene and training): success | collision, %")
        for variant, row in zip(rows, cells, strict=True):
            row.append(PAPER.get(variant, ""))
    title = (
        f"**{scenario}**, {study.trials} trials of each of {len(study.seeds)} seeds: rate [95 % interval]"
        " (least to most of the seeds)"
    )
    return f"{title}\n\n{markdown(columns, cells)}"


def _cell(rate: dict | None) -> str:
    if rate is None:
        return "–"
    low, high, least, most = (100 * rate[key] for key in ("low", "high", "least", "most"))
    return f"{100 * rate['rate']:.1f} [{low:.1f}, {high:.1f}] ({least:.1f} to {most:.1f})"


def _record(study: Ablation, run_dir: Path, scenario: str) -> Record:
    """What `evaluate_all` has measured of a run in a scenario."""
    path = run_dir / FOLDER / f"dev-ideal-{scenario}-own-run.json"
    for record in read(path) if path.is_file() else []:
        if len(record.episodes) == study.trials and record.weights == weights_hash(run_dir):
            return record
    raise ConfigError(
        f"{run_dir} has not been evaluated in {scenario} with trials={study.trials} and its newest checkpoint; use"
        " stage=evaluate or stage=all"
    )
