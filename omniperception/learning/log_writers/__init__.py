"""Where the numbers of a training go: TensorBoard, Weights & Biases, MLflow, Trackio, or a writer of one's own."""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

from rsl_rl.utils.log_writer import LogWriter

from omniperception.common.checked import AtLeastOne, Positive, checked
from omnirobot.common.errors import UserError


class LoggerError(UserError):
    """A service that does not take what is logged."""


@checked("logger")
class LoggerConfig:
    """TensorBoard files in the run directory; the other loggers write them as well, and more.

    Attributes:
        video_interval: iterations between two videos of environment 0; None makes none.
        video_s: their length (s).
    """

    video_interval: AtLeastOne | None = None
    video_s: Positive = 10.0
    extra: ClassVar[str] = ""
    """Extra of this package, and library, that it needs."""

    def check(self) -> None:
        """Raises LoggerError where the library is missing."""
        if self.extra and importlib.util.find_spec(self.extra) is None:
            raise LoggerError(f"logger={self.extra} needs {self.extra}: pip install 'omniperception[{self.extra}]'")

    def open(self, run_dir: Path, first_iteration: int, settings: Mapping[str, Any]) -> LogWriter:
        """Begins to log, or goes on.

        Args:
            run_dir: run directory.
            first_iteration: what is logged begins there; TensorBoard drops scalars from there on, as they will come
                again, services keep them.
            settings: the run's composed configuration.

        Raises:
            LoggerError: the service refuses.
        """
        from omniperception.learning.log_writers.tensorboard import TensorBoardWriter

        return TensorBoardWriter(run_dir, first_iteration, settings)


class ServiceConfig(LoggerConfig):
    """A service beside the TensorBoard files.

    Attributes:
        project: in which the run appears.
    """

    project: str = "omniperception"

    def open(self, run_dir: Path, first_iteration: int, settings: Mapping[str, Any]) -> LogWriter:
        """See `LoggerConfig.open`."""
        module = importlib.import_module(f"omniperception.learning.log_writers.{self.extra}")
        return module.Writer(run_dir, first_iteration, settings, self.project)


class WandbConfig(ServiceConfig):
    """Weights & Biases. Its own environment variables hold, such as WANDB_MODE=offline."""

    extra: ClassVar[str] = "wandb"


class MlflowConfig(ServiceConfig):
    """MLflow, whose experiment is the project. Its own environment variables hold, such as MLFLOW_TRACKING_URI."""

    extra: ClassVar[str] = "mlflow"


class TrackioConfig(ServiceConfig):
    """Trackio. Its own environment variables hold, such as TRACKIO_DIR."""

    extra: ClassVar[str] = "trackio"


def run_name(run_dir: Path) -> str:
    """A run's name in a service: the last two folders of its directory, which are its date and time."""
    return "_".join(run_dir.resolve().parts[-2:])
