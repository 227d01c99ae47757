"""Tables of studies: a row for each training and policy, its seeds together."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from omniperception.common.tables import markdown
from omniperception.config import ConfigError
from omniperception.evaluation.report.records import Record
from omniperception.evaluation.report.tables import check_apart, grouped, headline, rate_cell

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
_PAPER_HEADING = "paper (30 trials of its own scene and training): success | collision, %"


def study_table(records: Sequence[Record]) -> str:
    """A table for each world and condition. The folder of a run's seeds names its training: <arm>/<variant>/seed1.

    Raises:
        ConfigError: see `check_apart`; or a run is of no study.
    """
    check_apart(records)
    tables = []
    for (world, terrain, condition), here in grouped(records, "world", "terrain", "condition").items():
        by_row: dict[tuple[str, ...], list[Record]] = {}
        for record in here:
            if len(parts := Path(record.run).parts[-3:-1]) < 2:
                raise ConfigError(f"{record.run} is no run of a study, whose runs lie in <arm>/<variant>/seed<n>")
            by_row.setdefault((*parts, record.policy), []).append(record)
        rows = [[*row, *_cells(seeds)] for row, seeds in by_row.items()]
        columns = ["arm", "variant", "policy", *(f"{label}, %" for label in RATES.values())]
        if world == "corridor" and any(row[1] in PAPER for row in rows):
            columns.append(_PAPER_HEADING)
            rows = [[*row, PAPER.get(row[1], "")] for row in rows]
        place = world if terrain == "own" else f"{world}, {terrain}"
        tables.append(f"**{place}, {condition}**; {headline(here)}\n\n{markdown(columns, rows)}")
    return "\n\n".join(tables) + "\n"


def _cells(seeds: Sequence[Record]) -> list[str]:
    happened = [record.episodes.happened() for record in seeds]
    return [rate_cell([by_name[name] for by_name in happened]) if name in happened[0] else "–" for name in RATES]
