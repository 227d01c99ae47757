"""Training on top of rsl_rl: the actor that reads LiDAR frames, PPO, storage that shares frames, the runner."""

from omniperception.learning.checkpoint import (
    CheckpointError,
    latest_checkpoint,
    list_checkpoints,
    load_checkpoint,
    save_checkpoint,
)
from omniperception.learning.divergence import TrainingDiverged
from omniperception.learning.models import PerceptionActor
from omniperception.learning.ppo import PerceptivePpo, RolloutTooSmall
from omniperception.learning.runner import Runner
from omniperception.learning.storage import PerceptiveStorage, WindowedObservations

__all__ = [
    "CheckpointError",
    "PerceptionActor",
    "PerceptivePpo",
    "PerceptiveStorage",
    "RolloutTooSmall",
    "Runner",
    "TrainingDiverged",
    "WindowedObservations",
    "latest_checkpoint",
    "list_checkpoints",
    "load_checkpoint",
    "save_checkpoint",
]
