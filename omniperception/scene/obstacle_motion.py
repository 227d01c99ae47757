"""How obstacles move: courses past the robot, and what happens at the edge of an area."""

from __future__ import annotations

import torch


def passing_velocity(
    bearing: torch.Tensor, distance: torch.Tensor, miss: torch.Tensor, speed: torch.Tensor, robot_vel: torch.Tensor
) -> torch.Tensor:
    """Velocity of an obstacle whose course leads past a robot that keeps its own velocity.

    Seen from the robot, the obstacle moves along e, which points back to the robot but for the angle
    asin(miss / distance): it passes at distance |miss|. Its own velocity is w = v + s e with |w| = speed, so
    s = -v.e + sqrt((v.e)^2 + speed^2 - |v|^2). Without a solution s > 0 the robot gets away, and w = speed e.

    Args:
        bearing: (..., 2) unit vectors from the robot to the obstacle.
        distance: (...) m, larger than `miss`.
        miss: (...) m, to the left of the way to the robot where positive.
        speed: (...) m/s, of the obstacle.
        robot_vel: (..., 2) v, m/s.

    Returns:
        (..., 2) m/s.
    """
    angle = torch.asin(miss / distance)
    x, y = (-bearing).unbind(-1)
    course = torch.stack((angle.cos() * x - angle.sin() * y, angle.sin() * x + angle.cos() * y), -1)
    along = (robot_vel * course).sum(-1)
    discriminant = along.square() + speed.square() - robot_vel.square().sum(-1)
    relative = discriminant.clamp(min=0.0).sqrt() - along
    catches = (discriminant >= 0) & (relative > 1e-3)
    return torch.where(catches[..., None], robot_vel + relative[..., None] * course, speed[..., None] * course)


def bounce(
    xy: torch.Tensor, velocity: torch.Tensor, bounds: tuple[torch.Tensor, torch.Tensor], bound: torch.Tensor
) -> None:
    """Turns obstacles back at the edge of their areas, in place.

    Args:
        xy, velocity: (n, O, 2) m and m/s.
        bounds: low and high (O, 2) m.
        bound: (O,) bool, whom an area holds.
    """
    low, high = bounds
    below, above = (xy < low) & bound[:, None], (xy > high) & bound[:, None]
    inward = torch.where(below, velocity.abs(), torch.where(above, -velocity.abs(), velocity))
    velocity.copy_(inward)
    xy.copy_(torch.where(below, 2 * low - xy, torch.where(above, 2 * high - xy, xy)))


def wrap(
    xy: torch.Tensor, centre: torch.Tensor, bounds: tuple[torch.Tensor, torch.Tensor], bound: torch.Tensor
) -> None:
    """Lets obstacles that leave their areas around `centre` (n, 2) m in at the opposite edge, in place.

    The other arguments are those of `bounce`.
    """
    low = bounds[0] + centre[:, None]
    wrapped = low + torch.remainder(xy - low, bounds[1] - bounds[0])
    xy.copy_(torch.where(bound[:, None], wrapped, xy))
