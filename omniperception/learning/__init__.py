"""Training on top of rsl_rl: the perceptive actor, PPO, a rollout storage that shares LiDAR frames, and the
runner."""

from omniperception.learning.checkpoint import (
    CheckpointError,
    latest_checkpoint,
    list_checkpoints,
    load_checkpoint,
    save_checkpoint,
)
from omniperception.learning.models import PerceptionActor
from omniperception.learning.ppo import PerceptivePpo, RolloutTooSmall, TrainingDiverged
from omniperception.learning.runner import Runner
from omniperception.learning.storage import PerceptiveStorage, WindowedObservations, point_cloud_bytes

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
    "point_cloud_bytes",
    "save_checkpoint",
]
