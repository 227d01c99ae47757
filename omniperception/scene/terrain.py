"""The flat ground: a plane with friction and restitution."""

from __future__ import annotations

import math

import mujoco
import torch

from omniperception.common.checked import NonNegative, Share, checked

GROUND = "ground"
"""Name of the ground's geom, and of the body that carries it where it is a height field."""


@checked("terrain")
class TerrainConfig:
    """A flat ground plane at height 0 of every environment.

    Attributes:
        friction: sliding friction coefficient of the ground; it holds for every contact with the ground.
        restitution: the ground's coefficient of restitution in [0, 1]; a contact has half of it, see `ground_solrefs`.
    """

    friction: NonNegative = 0.8
    restitution: Share = 0.0

    def add_to(self, spec: mujoco.MjSpec) -> None:
        """Adds the ground geom, whose contact parameters take priority over the robot's."""
        geom = spec.worldbody.add_geom(name=GROUND, type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1])
        set_contact(geom, self.friction, self.restitution)


def set_contact(geom: mujoco.MjsGeom, friction: float, restitution: float) -> None:
    """Makes a geom the ground, whose contact parameters take priority over the robot's."""
    geom.contype, geom.conaffinity, geom.condim, geom.priority = 1, 0, 3, 1
    geom.friction = [friction, 0.005, 0.0001]
    geom.solref[:2] = ground_solrefs(torch.tensor(restitution, dtype=torch.float64, device="cpu")).tolist()


_CONTACT_FREQUENCY = 50.0
"""Natural frequency (rad/s) of the ground contact: MuJoCo's default, slow enough for a 5 ms physics step."""


def ground_solrefs(restitution: torch.Tensor) -> torch.Tensor:
    """(..., 2) `geom_solref` of grounds with coefficients of restitution (...).

    A contact has the mean of the ground's coefficient and the robot's own, which is 0, as PhysX has by default (and so
    the paper's simulator). Contacts with coefficients beyond a half would have no friction left: with MuJoCo's
    pyramidal cones what damps the rebound is also what slows down a sliding foot.
    """
    return contact_solrefs(0.5 * restitution)


def contact_solrefs(restitution: torch.Tensor) -> torch.Tensor:
    """(..., 2) MuJoCo's (-stiffness, -damping) of ground contacts with coefficients of restitution (...).

    The stiffness is the same for every restitution: in MuJoCo's other format, (time constant, damping ratio),
    it grows as the damping ratio falls, and a lively contact then gains energy at usual step sizes.
    """
    damping = -2.0 * damping_ratio(restitution) * _CONTACT_FREQUENCY
    return torch.stack((torch.full_like(damping, -(_CONTACT_FREQUENCY**2)), damping), -1)


def damping_ratio(restitution: torch.Tensor) -> torch.Tensor:
    """Damping ratio of a contact whose rebound speed is `restitution` times the impact speed.

    A linear spring-damper with ratio z rebounds with e = exp(-pi z / sqrt(1 - z^2)), so
    z = -ln(e) / sqrt(pi^2 + ln(e)^2); e = 0 is critical damping.
    """
    log_e = restitution.log()
    ratio = -log_e / torch.hypot(log_e, torch.full_like(log_e, math.pi))
    return torch.where(restitution <= 0, 1.0, ratio)
