"""Settings of robots without legs."""

from __future__ import annotations

from pathlib import Path

import torch

from omniperception.common.checked import Accelerations, AtLeastOne, NonNegative, Positive, checked
from omniperception.scene import World
from omniperception.sim.base import Simulator
from omniperception.sim.response import GaitResponse, NoResponse
from omnirobot.common.shell import command_line


@checked("sim")
class PlanarConfig:
    """Settings of `sim=planar`.

    Attributes:
        response: run directory of the gait whose measured response is followed.
        under: condition of conf/condition under which it was measured.
        timestep: (s) of the motion and of contacts.
        decimation: such steps per control step, which is the period of the decisions.
        acceleration: most (m/s^2, rad/s^2) by which the asked velocity changes, as whoever asks a gait limits it.
        spread: factor on the differences between robots; 0: all are as the mean.
        num_threads: CPU threads; 0 uses every core.
    """

    response: str
    under: str = "ideal"
    timestep: Positive = 0.025
    decimation: AtLeastOne = 4
    acceleration: Accelerations = (6.0, 8.0)
    spread: NonNegative = 1.0
    num_threads: int = 0

    has_legs = False

    @property
    def control_dt(self) -> float:
        """Control step (s)."""
        return self.timestep * self.decimation

    @property
    def torch_device(self) -> torch.device:
        return torch.device("cpu")

    def build(self, world: World, num_envs: int, record_states: bool = False) -> Simulator:
        """`num_envs` robots in a world, which draw from streams of their own until `PlanarSimulator.draw_by`."""
        from omniperception.sim.planar_world import PlanarSimulator  # with Warp, which not every task loads

        response = GaitResponse.load(Path(self.response))
        if self.under not in response.conditions:
            known = ", ".join(response.conditions)
            line = command_line("gait", f"run={self.response}", "what=response", f"conditions={self.under}")
            raise NoResponse(
                f"{self.response} has no response measured under condition={self.under} (it has {known}); set"
                f" sim.under, or measure it: {line}"
            )
        return PlanarSimulator(world, self, response, num_envs)
