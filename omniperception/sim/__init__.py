"""Physics back ends behind one protocol."""

from omniperception.sim.base import SimConfig, Simulator
from omniperception.sim.mujoco import MujocoSimulator

__all__ = ["MujocoSimulator", "SimConfig", "Simulator"]
