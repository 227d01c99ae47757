"""Physics back ends behind one protocol."""

from omniperception.sim.base import Failure, SimConfig, Simulator
from omniperception.sim.mujoco import MujocoSimulator

__all__ = ["Failure", "MujocoSimulator", "SimConfig", "Simulator"]
