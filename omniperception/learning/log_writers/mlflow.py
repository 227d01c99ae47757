"""MLflow."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mlflow
from mlflow.exceptions import MlflowException
from rsl_rl.utils.log_writer import LogWriter
from torch.utils.tensorboard import SummaryWriter

from omniperception.learning.log_writers import LoggerError, run_name
from omniperception.learning.log_writers.tensorboard import begin

ID_FILE = "mlflow_id.txt"
"""In the run directory: under which a resumed run goes on."""


class Writer(SummaryWriter, LogWriter):
    """Metrics; seed, num_envs and PPO's settings as parameters; the configuration and videos as artifacts."""

    def __init__(self, run_dir: Path, first_iteration: int, settings: Mapping[str, Any], project: str) -> None:
        """See `LoggerConfig.open`."""
        begin(self, run_dir, first_iteration, settings)
        id_file = run_dir / ID_FILE
        goes_on = id_file.read_text() if first_iteration and id_file.is_file() else None
        try:
            mlflow.set_experiment(project)
            run = mlflow.start_run(run_id=goes_on, run_name=run_name(run_dir))
            mlflow.log_dict(dict(settings), "config.yaml")
            if goes_on is None:
                mlflow.log_params(_parameters(settings))
        except MlflowException as error:
            raise LoggerError(
                f"logger=mlflow: {error}; MLFLOW_TRACKING_URI=sqlite:///mlflow.db logs into a file"
            ) from None
        id_file.write_text(run.info.run_id)

    def add_scalar(self, tag: str, scalar_value: float, global_step: int | None = None, *args: Any, **kw: Any) -> None:
        """Logs a scalar; MLflow sends it in a thread of its own."""
        super().add_scalar(tag, scalar_value, global_step, *args, **kw)
        mlflow.log_metric(tag, scalar_value, step=global_step, synchronous=False)

    def save_video(self, video: Path, it: int) -> None:
        """Stores a video file as an artifact."""
        mlflow.log_artifact(str(video), "videos")

    def stop(self) -> None:
        """Closes the file, and completes the run when all is sent."""
        self.close()
        mlflow.flush_async_logging()
        mlflow.end_run()


def _parameters(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings that MLflow's tables compare."""
    top = {name: settings[name] for name in ("seed", "num_envs") if name in settings}
    return top | {f"ppo.{name}": value for name, value in settings.get("ppo", {}).items()}
