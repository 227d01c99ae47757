"""Trackio."""

from __future__ import annotations

import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import trackio
from rsl_rl.utils.log_writer import LogWriter
from torch.utils.tensorboard import SummaryWriter

from omniperception.learning.log_writers import LoggerError, run_name
from omniperception.learning.log_writers.tensorboard import begin

NAME_FILE = "trackio_name.txt"
"""In the run directory: the name under which a resumed run goes on; no other run has it."""


class Writer(SummaryWriter, LogWriter):
    """Metrics by iteration, the configuration, and videos."""

    def __init__(self, run_dir: Path, first_iteration: int, settings: Mapping[str, Any], project: str) -> None:
        """See `LoggerConfig.open`."""
        begin(self, run_dir, first_iteration, settings)
        name_file = run_dir / NAME_FILE
        if not (first_iteration and name_file.is_file()):
            name_file.write_text(f"{run_name(run_dir)}_{uuid.uuid4().hex[:6]}")
        try:
            trackio.init(project, name_file.read_text(), config=dict(settings), resume="allow")
        except ValueError as error:
            raise LoggerError(f"logger=trackio: {error}; see logger.project and TRACKIO_SERVER_URL") from None
        self._step: int | None = None
        self._values: dict[str, Any] = {}  # of the iteration that is being logged

    def add_scalar(self, tag: str, scalar_value: float, global_step: int | None = None, *args: Any, **kw: Any) -> None:
        """Logs a scalar; those of an iteration are sent together, when the next one begins."""
        super().add_scalar(tag, scalar_value, global_step, *args, **kw)
        if global_step != self._step:
            self._send()
            self._step = global_step
        self._values[tag] = scalar_value

    def save_video(self, video: Path, it: int) -> None:
        """Logs a video file."""
        self._send()
        trackio.log({"video": trackio.Video(str(video), format="mp4")}, step=it)

    def stop(self) -> None:
        """Sends the rest, closes the file and completes the run."""
        self._send()
        self.close()
        trackio.finish()

    def _send(self) -> None:
        if self._values:
            trackio.log(self._values, step=self._step)
            self._values = {}
