"""Physics back ends behind one protocol."""

from omniperception.sim.base import Failure, Simulator
from omniperception.sim.mujoco import MujocoSimulator, SimConfig

__all__ = ["Failure", "MujocoSimulator", "SimConfig", "Simulator"]
