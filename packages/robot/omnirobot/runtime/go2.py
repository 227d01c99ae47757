"""Facts of a Unitree Go2 that a robot's own computer needs: the order of its motors, and how far its joints go."""

MOTORS = tuple(f"{leg}_{joint}_joint" for leg in ("FR", "FL", "RR", "RL") for joint in ("hip", "thigh", "calf"))
"""Joint of each motor slot of Unitree's messages: `LegID` in unitree_sdk2_python's examples."""

_HIP, _CALF = (-1.0472, 1.0472), (-2.7227, -0.83776)
_FRONT, _REAR = (_HIP, (-1.5708, 3.4907), _CALF), (_HIP, (-0.5236, 4.5379), _CALF)
RANGES = dict(zip(MOTORS, 2 * _FRONT + 2 * _REAR, strict=True))
"""Lowest and highest angle (rad) of each joint, from Unitree's robot description."""
