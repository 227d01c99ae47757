"""Facts of a Unitree Go2 that a robot's own computer needs: the order of its motors."""

MOTORS = tuple(f"{leg}_{joint}_joint" for leg in ("FR", "FL", "RR", "RL") for joint in ("hip", "thigh", "calf"))
"""Joint of each motor slot of Unitree's messages: `LegID` in unitree_sdk2_python's examples."""
