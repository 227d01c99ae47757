"""Directions that the LiDAR has looked into: where it gave no points, nothing is known to be free."""

from __future__ import annotations

import math

import torch

from omniperception.avoidance.sector_motion import sector_bearings
from omniperception.common.rotations import multiply, rotate, yaw_of, yaw_quat
from omniperception.common.sectors import sector_of
from omniperception.common.stateful import Stateful
from omnirobot.common.coverage import BIN_DEG, FRAMES, NUM_BINS, NUM_SECTORS, OPEN_DEG, SHARE, SHUT_DEG


class Coverage(Stateful):
    """Which sectors the newest frames cover, in each environment.

    A sector is covered where the answers of the newest FRAMES frames lie in enough bins of elevation: many points in a
    narrow band say nothing of what is above and below.

    Attributes:
        covered: (num_envs, NUM_SECTORS) bool; everywhere before an episode's first frame.
    """

    saved = ("_answered", "covered")

    def __init__(self, num_envs: int, least: torch.Tensor) -> None:
        """Args: num_envs; least: (NUM_SECTORS,) bins of a covered sector, see :func:`least_bins`."""
        self._least = least
        self._answered = torch.ones(
            FRAMES, num_envs, NUM_SECTORS, NUM_BINS, dtype=torch.bool, device=least.device
        )  # the newest last
        self.covered = self._answered[0, ..., 0].clone()

    def begin_frame(self) -> None:
        """Makes room for the next frame, of all environments."""
        self._answered = self._answered.roll(-1, 0)

    def add_frame(self, ranges: torch.Tensor, directions_l: torch.Tensor, came: torch.Tensor, envs: slice) -> None:
        """Takes in a frame of some environments.

        Args:
            ranges: (n, R) m, infinite without an answer.
            directions_l: (n, R, 3) unit vectors in the yaw-aligned frame without roll and pitch.
            came: (n,) bool, whose frame came.
            envs: which.
        """
        self._answered[-1, envs] = answered_bins(directions_l, ranges.isfinite()) & came[:, None, None]
        self.covered[envs] = self._answered[:, envs].any(0).sum(-1) >= self._least

    def reset(self, env_ids: torch.Tensor) -> None:
        """Episodes begin in environments (n,)."""
        self._answered.index_fill_(1, env_ids, True)
        self.covered.index_fill_(0, env_ids, True)


def answered_bins(directions_l: torch.Tensor, answered: torch.Tensor) -> torch.Tensor:
    """(n, NUM_SECTORS, NUM_BINS) bool: whether one of the rays (n, R, 3) of a bin is answered (n, R)."""
    sector = sector_of(directions_l[..., :2], NUM_SECTORS)
    elevation = torch.rad2deg(directions_l[..., 2].clamp(-1.0, 1.0).asin()) + 90.0
    cell = sector * NUM_BINS + (elevation / BIN_DEG).long().clamp(max=NUM_BINS - 1)
    found = torch.zeros(len(cell), NUM_SECTORS * NUM_BINS, dtype=torch.uint8, device=cell.device)
    return found.scatter_reduce_(1, cell, answered.to(torch.uint8), "amax").unflatten(1, (NUM_SECTORS, -1)).bool()


def levelled(directions_s: torch.Tensor, carrier_quat: torch.Tensor, mount_quat: torch.Tensor) -> torch.Tensor:
    """Directions (n, R, 3) of the sensor's frame in the yaw-aligned one of its carrier, without roll and pitch.

    Args:
        directions_s: (n, R, 3) unit vectors.
        carrier_quat: (n, 4) attitude of the link that carries the sensor, (w, x, y, z).
        mount_quat: (4,) of the sensor on it.
    """
    level = multiply(yaw_quat(-yaw_of(carrier_quat)), multiply(carrier_quat, mount_quat))
    return rotate(level[:, None], directions_s)


def least_bins(directions_s: torch.Tensor, mount_quat: torch.Tensor, height: float, max_range: float) -> torch.Tensor:
    """(NUM_SECTORS,) int64 bins of a covered sector: SHARE of those that flat ground answers while the robot stands.

    Where flat ground answers nothing, as behind a camera, it is 0: such a sector always counts as covered.

    Args:
        directions_s: (M, 3) unit vectors of the device's scan, sensor frame.
        mount_quat: (4,) of the sensor in the base, (w, x, y, z).
        height: of the sensor above the ground (m).
        max_range: m.
    """
    directions = rotate(mount_quat, directions_s)[None]
    sinks = -directions[..., 2]
    answers = answered_bins(directions, (sinks > 0.0) & (height <= max_range * sinks))
    return (SHARE * answers[0].sum(-1)).ceil().long()


def kept_to_covered(velocity: torch.Tensor, covered: torch.Tensor) -> torch.Tensor:
    """Velocities (n, 2), yaw-aligned frame, slowed down where they lead into sectors that are not covered.

    Args:
        velocity: (n, 2) m/s.
        covered: (n, NUM_SECTORS) bool.

    Returns:
        (n, 2) m/s: 0 up to SHUT_DEG from the centre of the nearest uncovered sector, as it was from OPEN_DEG on, in
        between linear in the cosine.
    """
    speed = velocity.norm(dim=1, keepdim=True).clamp(min=1e-6)
    cosine = velocity @ sector_bearings(NUM_SECTORS, velocity.device).T / speed
    towards = torch.where(covered, -1.0, cosine).amax(1, keepdim=True)
    shut, free = math.cos(math.radians(SHUT_DEG)), math.cos(math.radians(OPEN_DEG))
    return velocity * ((shut - towards) / (shut - free)).clamp(0.0, 1.0)
