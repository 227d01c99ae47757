"""An exported policy on a robot: NumPy, onnxruntime and cyclonedds; no torch, no Warp, no Hydra, no ROS."""
