"""An exported policy on a robot: NumPy and onnxruntime, without torch, Warp or Hydra."""

from omnirobot.runtime.description import DeployError, Description
from omnirobot.runtime.runtime import ExportedPolicy, RobotState
from omnirobot.runtime.safety import SafetyConfig, SafetyStop

__all__ = ["DeployError", "Description", "ExportedPolicy", "RobotState", "SafetyConfig", "SafetyStop"]
