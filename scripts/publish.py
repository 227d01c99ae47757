"""Makes a small run directory of a run's newest policy, fit for a repository.

python scripts/publish.py run=latest to=<folder> [precision=float16]

The folder holds weights, config.yaml and provenance.json; play.py, evaluate.py and export.py take it as run=<folder>,
train.py as init=<folder>. At most 4 MB are published; precision=float16 halves the weights, rounded to three digits.
"""

from __future__ import annotations

import sys
from pathlib import Path

from omniperception import config
from omniperception.deploy.publish import publish
from omniperception.learning import CheckpointError

ARGUMENTS = {"run": "latest", "to": "", "precision": "float32"}


def main() -> None:
    if {"-h", "--help"} & set(sys.argv[1:]):
        print(__doc__)
        return
    with config.one_line_errors(CheckpointError):
        own, overrides = config.split_arguments(sys.argv[1:], ARGUMENTS)
        if overrides or not own["to"]:
            raise config.ConfigError(
                f"{overrides[0] if overrides else 'to='}: give run=<run directory> to=<folder>, no more"
            )
        record = publish(config.find_run(own["run"]), Path(own["to"]), own["precision"])
        print(f"{own['to']}: {record['iterations']} iterations, {record['training_hours']} h of training")


if __name__ == "__main__":
    main()
