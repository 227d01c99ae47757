"""Weights & Biases."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import wandb
from rsl_rl.utils.wandb_log_writer import WandbLogWriter

from omniperception.learning.log_writers import LoggerError, run_name
from omniperception.learning.log_writers.tensorboard import begin

ID_FILE = "wandb_id.txt"
"""In the run directory: under which a resumed run goes on."""


class Writer(WandbLogWriter):
    """rsl_rl's writer; a resumed run goes on as the same run."""

    def __init__(self, run_dir: Path, first_iteration: int, settings: Mapping[str, Any], project: str) -> None:
        """See `LoggerConfig.open`."""
        begin(self, run_dir, first_iteration, settings)
        id_file = run_dir / ID_FILE
        goes_on = id_file.read_text() if first_iteration and id_file.is_file() else None
        try:
            run = wandb.init(project=project, name=run_name(run_dir), id=goes_on, resume="allow", config=dict(settings))
        except wandb.Error as error:
            raise LoggerError(
                f"logger=wandb: {error}; 'wandb login' gives a key, WANDB_MODE=offline logs without one"
            ) from None
        id_file.write_text(run.id)
        self.logged_videos: set[str] = set()

    def stop(self) -> None:
        """Closes the file and completes the run."""
        self.close()
        super().stop()
