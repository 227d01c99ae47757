"""An exported policy on a robot: NumPy and onnxruntime, without torch, Warp or Hydra."""

from omniperception.deploy.description import DeployError, Description
from omniperception.deploy.runtime import ExportedPolicy, RobotState

__all__ = ["DeployError", "Description", "ExportedPolicy", "RobotState"]
