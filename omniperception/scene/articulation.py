"""Poses of the parts of compounds: from where their obstacles are, how large they are and how far they have swung."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from omnilidar import quat_from_rpy
from omniperception.common.rotations import matrix_of, multiply, rotate, yaw_quat
from omniperception.common.stateful import Stateful
from omniperception.scene.part_shapes import quat_about
from omniperception.scene.parts import Part, PartConfig

Rows = torch.Tensor | slice
"""Some environments, (n,) int64, or all."""
ALL = slice(None)
_WHOLE = PartConfig("sphere", (1.0,))
"""Form of an obstacle that is its own only part: its middle is half its height above its root."""


class Articulation(Stateful):
    """Parts in their obstacles. An obstacle's root is the point on its underside from which its parts are measured.

    Attributes:
        obstacle: (P,) index of the obstacle of each part.
        swings: whether some part swings.
        turns: whether some part changes its orientation within an episode.
        scale: (num_envs, O) of the obstacles.
        lift: (num_envs, P) m, of the middles of whole obstacles above their roots; 0 for parts of compounds.
        cycle: (num_envs, O) at which swings began.
        seconds: (num_envs,) s since then.
        metres: (num_envs, O) m moved since then.
    """

    buffers = ("scale", "lift", "cycle", "seconds", "metres")

    def __init__(self, parts: Sequence[Part], num_envs: int, dtype: torch.dtype, device: torch.device) -> None:
        def column(rows: list) -> torch.Tensor:
            return torch.tensor(rows, dtype=dtype, device=device)

        forms = [part.form or _WHOLE for part in parts]
        swings = [form.swing for form in forms]
        self.obstacle = torch.tensor([part.obstacle for part in parts], device=device)
        num_obstacles = int(self.obstacle.max()) + 1
        self._joint, self._hang = column([form.pos for form in forms]), column([form.hang for form in forms])
        self._rest = column([quat_from_rpy(*map(math.radians, form.rpy_deg)) for form in forms])
        self._axis = column([swing.direction if swing else (1.0, 0.0, 0.0) for swing in swings])
        self._amplitude = torch.deg2rad(column([swing.amplitude_deg if swing else 0.0 for swing in swings]))
        self._frequency = column([swing.frequency if swing else 0.0 for swing in swings])
        self._per_metre = column([swing.per_metre if swing else 0.0 for swing in swings])
        self._phase = torch.deg2rad(column([swing.phase_deg if swing else 0.0 for swing in swings]))
        self.swings = any(swings)
        self.turns = self.swings or any(part.form is not None and part.moves for part in parts)
        self._is_whole = torch.tensor([part.form is None for part in parts], device=device)
        self.scale = torch.ones(num_envs, num_obstacles, dtype=dtype, device=device)
        self.lift = torch.zeros(num_envs, len(parts), dtype=dtype, device=device)
        self.cycle, self.metres = torch.zeros(2, num_envs, num_obstacles, dtype=dtype, device=device).unbind(0)
        self.seconds = torch.zeros(num_envs, dtype=dtype, device=device)

    def reset(self, env_ids: torch.Tensor, scale: torch.Tensor, half_height: torch.Tensor, cycle: torch.Tensor) -> None:
        """Begins an episode in environments (n,).

        Args:
            env_ids: (n,).
            scale: (n, O).
            half_height: (n, P) m, of upright parts.
            cycle: (n, O) from 0 to 1, at which swings begin.
        """
        self.scale[env_ids] = scale
        self.lift[env_ids] = torch.where(self._is_whole, half_height, 0.0)
        self.cycle[env_ids] = cycle
        self.seconds.index_fill_(0, env_ids, 0.0)
        self.metres.index_fill_(0, env_ids, 0.0)

    def advance(self, dt: float, speed: torch.Tensor) -> None:
        """Lets `dt` (s) pass, in which obstacles move at `speed` (num_envs, O) m/s."""
        self.seconds += dt
        self.metres += dt * speed

    def angles(self, rows: Rows = ALL) -> torch.Tensor:
        """(n, P) rad, by which parts have swung about their joints."""
        return self._amplitude * self._turn(rows).sin()

    def _turn(self, rows: Rows) -> torch.Tensor:
        """(n, P) rad: where in their cycles the swings are."""
        cycles = self.cycle[rows][:, self.obstacle] + self._frequency * self.seconds[rows][:, None]
        cycles = cycles + self._per_metre * self.metres[rows][:, self.obstacle]
        return 2 * math.pi * cycles + self._phase

    def orientation(self, rows: Rows = ALL) -> torch.Tensor:
        """(n, P, 4) of the parts in their obstacles' frames."""
        if not self.swings:
            return self._rest.expand(len(self.seconds[rows]), -1, -1)
        return multiply(self._rest, quat_about(self._axis, self.angles(rows)))

    def pose(self, root: torch.Tensor, yaw: torch.Tensor, rows: Rows = ALL) -> tuple[torch.Tensor, torch.Tensor]:
        """Positions (n, P, 3) in m and quaternions (n, P, 4) of the parts.

        Args:
            root: (n, O, 3) m, where the obstacles are.
            yaw: (n, O) rad, their orientation about the vertical.
            rows: which environments.
        """
        turned, heading = self.orientation(rows), yaw_quat(yaw)[:, self.obstacle]
        middle = self._joint + rotate(turned, self._hang)
        middle = middle * self.scale[rows][:, self.obstacle, None]
        middle[..., 2] += self.lift[rows]
        return root[:, self.obstacle] + rotate(heading, middle), multiply(heading, turned)

    def velocity(self, root_velocity: torch.Tensor, yaw: torch.Tensor, rows: Rows = ALL) -> torch.Tensor:
        """(n, P, 2) m/s, of the parts' middles: what the obstacle does, and the swing.

        Args:
            root_velocity: (n, O, 2) m/s.
            yaw: (n, O) rad.
            rows: which environments.
        """
        whole = root_velocity[:, self.obstacle]
        if not self.swings:
            return whole
        speed = root_velocity.norm(dim=-1)[:, self.obstacle]
        per_second = self._frequency + self._per_metre * speed
        rate = self._amplitude * self._turn(rows).cos() * 2 * math.pi * per_second  # rad/s
        arm = rotate(quat_about(self._axis, self.angles(rows)), self._hang)
        arm = arm * self.scale[rows][:, self.obstacle, None]
        swing = rotate(self._rest, torch.linalg.cross(self._axis.expand_as(arm), arm))
        swing = rotate(yaw_quat(yaw)[:, self.obstacle], swing * rate[..., None])
        return whole + swing[..., :2]


def tilt_of(quat: torch.Tensor) -> torch.Tensor:
    """Matrices (..., 3, 3) of what orientations (..., 4) are besides a turn about the vertical by 2 atan2(z, w)."""
    return matrix_of(multiply(yaw_quat(-2 * torch.atan2(quat[..., 3], quat[..., 0])), quat))
