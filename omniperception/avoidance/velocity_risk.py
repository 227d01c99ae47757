"""Velocity risk: how near and how soon each velocity would lead past an obstacle, and the velocity that follows."""

from __future__ import annotations

import math
from functools import lru_cache

import torch

from omniperception.avoidance.sector_motion import sector_bearings
from omniperception.common.checked import AtLeastOne, NonNegative, Positive, Times, checked
from omniperception.common.sectors import FAR

_SLOW = 0.1
"""Commanded speed (m/s) below which the direction counts less."""


_NO_RISK = 16.0
"""Risks below exp(-_NO_RISK), a ten-millionth, count as none where no gradient is asked for."""

_SMALLEST = 1e-6
"""Squared distance (m^2) below which a gradient would not exist."""


@lru_cache(16)
def _bearings(num_sectors: int, device: torch.device) -> torch.Tensor:
    """`sector_bearings`, made once."""
    with torch.inference_mode(False):
        return sector_bearings(num_sectors, device).contiguous()


@checked("rewards.avoidance.risk")
class VelocityRisk:
    """Candidate velocities, their risk and the choice between them.

    The candidates lie on rings around standing still, in the yaw-aligned frame. The risk of one, 0 to 1, is the largest
    of exp(-gap / decay - t / time_constant) over all obstacles and `times` t, where gap (m) lies between the
    obstacle's outline and the robot's, seen from above, if both keep their velocities until then: a velocity obstacle
    (Fiorini and Shiller, 1998) with soft edges. The robot's outline is a capsule: what lies within `robot_radius` of a
    line from `robot_half_length` behind to as much before the base's origin. The choice is the mean of the candidates
    under the weights softmax(-(along^2 + sideways * across^2 + weight * risk) / temperature), where along and across
    (m/s) are how much a candidate deviates from the command in its direction and beside it.

    Beyond the paper, whose V_avoid sees distances alone; see docs/lab/negative.md for what it brings.

    Attributes:
        max_speed: of the outermost ring (m/s).
        num_rings: equally spaced speeds.
        num_directions: candidates on each ring.
        times: when the gap is looked at (s).
        robot_radius, robot_half_length: of the robot's outline (m); a disc where the latter is 0.
        decay: (m).
        time_constant: (s).
        weight: of a risk of 1 against a squared deviation from the command ((m/s)^2).
        temperature: ((m/s)^2) of the choice; small ones take the best candidate alone.
        sideways: what a squared deviation beside the command counts; at 1 it is better to stand before something wide
            than to go round it.
    """

    max_speed: Positive
    num_rings: AtLeastOne
    num_directions: AtLeastOne
    times: Times
    robot_radius: NonNegative
    decay: Positive
    time_constant: Positive
    weight: Positive
    temperature: Positive
    sideways: Positive = 1.0
    robot_half_length: NonNegative = 0.0

    @property
    def num_candidates(self) -> int:
        """K, standing still included."""
        return 1 + self.num_rings * self.num_directions

    def candidates(self, device: torch.device | str = "cpu") -> torch.Tensor:
        """(K, 2) m/s in the yaw-aligned frame: standing still, then the rings from the inside, counter-clockwise."""
        speed = self.max_speed * torch.arange(1, self.num_rings + 1, device=device) / self.num_rings
        angle = 2 * math.pi * torch.arange(self.num_directions, device=device) / self.num_directions
        ring = torch.stack((angle.cos(), angle.sin()), -1)
        return torch.cat((ring.new_zeros(1, 2), (speed[:, None, None] * ring).flatten(0, 1)))

    def risk(self, sectors: torch.Tensor, candidates: torch.Tensor) -> torch.Tensor:
        """Risks of the candidates among obstacles that are known by azimuth sector.

        An obstacle's outline is what it is in the sectors: a point at the centre of each sector that it is in, which
        moves at the obstacle's velocity.

        Args:
            sectors: (n, S, 3) distance (m, infinite without an obstacle) and velocity (m/s, yaw-aligned frame).
            candidates: those of :meth:`candidates`.

        Returns:
            (n, K).
        """
        traced = torch.jit.is_tracing() or torch.onnx.is_in_onnx_export()
        if not traced and not torch.is_grad_enabled():
            return self._largest(sectors, candidates)
        bearings = sector_bearings(sectors.shape[1], sectors.device)
        place = sectors[..., :1].clamp(max=FAR) * bearings
        velocity = sectors[..., 1:]
        with torch.no_grad():
            if traced:
                sector, time = self._worst(place, velocity, candidates)
            else:
                sector, time = self._worst_by_kernel(place, velocity, candidates)
        sector = sector[..., None].expand(-1, -1, 2)
        meeting = place.gather(1, sector) + time[..., None] * (velocity.gather(1, sector) - candidates)
        distance = self._squared(*meeting.unbind(-1)).clamp(min=_SMALLEST).sqrt()
        return (-self._exponent(distance, time)).exp()

    def _largest(self, sectors: torch.Tensor, candidates: torch.Tensor) -> torch.Tensor:
        """As :meth:`risk`, without gradients: whose sector makes a risk, and when, is not kept."""
        import warp as wp

        from omnilidar.launch import constant, launch_over_envs, view
        from omniperception.avoidance.kernels import largest_risks

        sectors = sectors.float().contiguous()
        points = sectors.new_empty(*sectors.shape[:2], 2)
        risk = sectors.new_empty(len(sectors), len(candidates))
        inputs = [
            view(sectors, wp.vec3),
            view(_bearings(sectors.shape[1], sectors.device), wp.vec2),
            view(candidates, wp.vec2),
            view(constant(tuple(self.times), sectors.device), wp.float32),
            self.robot_radius,
            self.robot_half_length,
            self.decay,
            self.time_constant,
            self.max_speed,
            _NO_RISK,
            view(points, wp.vec2),
            view(risk, wp.float32),
        ]
        launch_over_envs(largest_risks, len(sectors), inputs, sectors.device)
        return risk

    def _worst_by_kernel(
        self, place: torch.Tensor, velocity: torch.Tensor, candidates: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """As :meth:`_worst`; loads Warp, which a run without obstacles does not."""
        import warp as wp

        from omnilidar.launch import constant, launch_over_envs, view
        from omniperception.avoidance.kernels import worst_sectors

        place, velocity = place.contiguous(), velocity.contiguous()
        sector = torch.zeros(len(place), len(candidates), dtype=torch.int64, device=place.device)
        when = place.new_zeros(sector.shape)
        times = constant(tuple(self.times), place.device)
        points, least = torch.empty_like(place), place.new_empty(sector.shape)
        sectors = torch.empty(place.shape[:2], dtype=torch.int32, device=place.device)
        inputs = [
            view(place, wp.vec2),
            view(velocity, wp.vec2),
            view(candidates, wp.vec2),
            view(times, wp.float32),
            self.robot_radius,
            self.robot_half_length,
            self.decay,
            self.time_constant,
            FAR,
            view(points, wp.vec2),
            view(sectors, wp.int32),
            view(least, wp.float32),
            view(sector, wp.int64),
            view(when, wp.float32),
        ]
        launch_over_envs(worst_sectors, len(place), inputs, place.device)
        return sector, when

    def _worst(
        self, place: torch.Tensor, velocity: torch.Tensor, candidates: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """(n, K) which sector's obstacle makes each candidate's risk, and when (s)."""
        times = place.new_tensor(self.times)[:, None]  # (T, 1)
        points = place[:, None] + times[..., None] * velocity[:, None]  # (n, T, S, 2)
        goals = times[..., None] * candidates  # (T, K, 2)
        along, across = (points[..., None, axis] - goals[:, None, :, axis] for axis in (0, 1))  # (n, T, S, K)
        squared, nearest = self._squared(along, across).min(2)
        soonest = self._exponent(squared.sqrt(), times).argmin(1, keepdim=True)
        return nearest.gather(1, soonest)[:, 0], times[soonest[:, 0], 0]

    def _squared(self, along: torch.Tensor, across: torch.Tensor) -> torch.Tensor:
        """Squared distances (m^2) from the line in the robot's middle, of places along and across it (m)."""
        return (along.abs() - self.robot_half_length).clamp(min=0.0).square() + across.square()

    def _exponent(self, distance: torch.Tensor, time: torch.Tensor) -> torch.Tensor:
        """Minus the logarithm of the risk of passing an obstacle at a distance (m) after a time (s)."""
        return (distance - self.robot_radius).clamp(min=0.0) / self.decay + time / self.time_constant

    def avoidance(self, risk: torch.Tensor, command: torch.Tensor, candidates: torch.Tensor) -> torch.Tensor:
        """V_avoid: the choice under the risks less the choice without any, so that no risk changes nothing.

        Args:
            risk: (n, K).
            command: (n, 2) commanded velocity (m/s).
            candidates: those of :meth:`candidates`.

        Returns:
            (n, 2) m/s in the yaw-aligned frame.
        """
        deviation = self._deviation(command[:, None], candidates)
        wary = torch.softmax(-(deviation + self.weight * risk) / self.temperature, 1)
        free = torch.softmax(-deviation / self.temperature, 1)
        return (wary - free) @ candidates

    def _deviation(self, command: torch.Tensor, velocities: torch.Tensor) -> torch.Tensor:
        """(n, K) of velocities (K, 2) from commands (n, 1, 2); slow ones have less of a direction."""
        away = command - velocities
        heading = command / command.square().sum(-1, keepdim=True).clamp(min=_SLOW**2).sqrt()
        across = away[..., 0] * heading[..., 1] - away[..., 1] * heading[..., 0]
        return away.square().sum(-1) - (1.0 - self.sideways) * across.square()
