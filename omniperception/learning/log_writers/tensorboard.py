"""TensorBoard files in the run directory."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml
from rsl_rl.utils.log_writer import LogWriter
from torch.utils.tensorboard import SummaryWriter


class TensorBoardWriter(SummaryWriter, LogWriter):
    """Scalars, and the run's configuration as text; videos stay files in the run directory."""

    def __init__(self, run_dir: Path, first_iteration: int, settings: Mapping[str, Any]) -> None:
        """See `LoggerConfig.open`."""
        begin(self, run_dir, first_iteration, settings)

    def stop(self) -> None:
        """Closes the file."""
        self.close()


_say = threading.excepthook


def _leave_to_the_writer(failed: threading.ExceptHookArgs) -> None:
    """What TensorBoard's thread cannot write, its writer raises at the next call; of other threads as before."""
    if not (isinstance(failed.exc_value, OSError) and type(failed.thread).__module__.startswith("tensorboard.")):
        _say(failed)


threading.excepthook = _leave_to_the_writer


def begin(writer: SummaryWriter, run_dir: Path, first_iteration: int, settings: Mapping[str, Any]) -> None:
    """Opens a writer's file, the run's configuration in it; see `LoggerConfig.open`."""
    SummaryWriter.__init__(writer, str(run_dir), flush_secs=10, purge_step=first_iteration or None)
    text = yaml.safe_dump(dict(settings), sort_keys=False)
    writer.add_text("configuration", f"```yaml\n{text}```", first_iteration)
