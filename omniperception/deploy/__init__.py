"""An exported policy on a robot: NumPy and onnxruntime, without torch, Warp or Hydra."""

from omniperception.deploy.description import DeployError, Description
from omniperception.deploy.runtime import ExportedPolicy, RobotState
from omniperception.deploy.safety import SafetyConfig, SafetyStop

__all__ = ["DeployError", "Description", "ExportedPolicy", "RobotState", "SafetyConfig", "SafetyStop"]
