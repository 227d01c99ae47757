"""A policy on a robot: Unitree's messages over DDS, the Mid-360's packets, and what stands between them and the motors.

NumPy, onnxruntime and cyclonedds; no torch, no ROS.
"""
