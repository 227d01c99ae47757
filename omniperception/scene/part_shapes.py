"""Sizes of parts of obstacles, and what follows from them: extents, outlines, reach."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch

from omnilidar import quat_from_rpy
from omniperception.common.rotations import matrix_of, multiply, rotate
from omniperception.scene.parts import Part, PartConfig


class SizeRanges:
    """Sizes of all parts, drawn from their ranges."""

    def __init__(self, parts: Sequence[Part], dtype: torch.dtype, device: torch.device) -> None:
        padded = [[*part.size, *[(0.0, 0.0)] * (3 - len(part.size))] for part in parts]
        self._low, self._high = torch.tensor(padded, dtype=dtype, device=device).reshape(-1, 3, 2).unbind(-1)
        self._obstacle = torch.tensor([part.obstacle for part in parts], device=device)
        self._jointly = torch.tensor([part.form is not None for part in parts], dtype=torch.bool, device=device)

    def draw(self, u: torch.Tensor, share: torch.Tensor) -> torch.Tensor:
        """Sizes (n, P, 3) in m, padded with 0, from draws (n, 3, P), of compounds at `share` (n, O) of their ranges."""
        u = torch.where(self._jointly, share[:, None, self._obstacle], u)
        return self._low + u.transpose(1, 2) * (self._high - self._low)


class PartShapes:
    """What follows from sizes (n, P, 3) of parts, which are padded with 0."""

    def __init__(self, kinds: Sequence[str], dtype: torch.dtype, device: torch.device) -> None:
        def among(*some: str) -> torch.Tensor:
            return torch.tensor([kind in some for kind in kinds], dtype=torch.bool, device=device)

        self._is_box, self._is_sphere, self._has_disc = among("box", "mesh"), among("sphere"), among("cylinder")
        self._upright = torch.eye(3, dtype=dtype, device=device)

    def half_extents(self, size: torch.Tensor, tilt: torch.Tensor | None = None) -> torch.Tensor:
        """(n, P, 3) m, of the boxes around parts that are turned by the matrices `tilt` (n, P, 3, 3) from upright."""
        turned = self._upright if tilt is None else tilt
        axis = turned[..., 2]
        box = (turned.abs() * size[..., None, :]).sum(-1)
        off_axis = torch.where(self._has_disc[:, None], (1 - axis.square()).clamp(min=0.0).sqrt(), 1.0)
        length = torch.where(self._is_sphere, 0.0, size[..., 1])
        rounded = size[..., :1] * off_axis + length[..., None] * axis.abs()
        return torch.where(self._is_box[:, None], box, rounded)

    def outline(self, half: torch.Tensor, tilt: torch.Tensor | None = None) -> torch.Tensor:
        """(n, P, 2) m: half x, half y of the rectangle seen from above; radius, -1 of a circle."""
        circle = ~self._is_box
        if tilt is not None:
            circle = circle & (self._is_sphere | (tilt[..., 2, 2].abs() > 1.0 - 1e-6))
        return torch.stack((half[..., 0], torch.where(circle, -1.0, half[..., 1])), -1)


def footprint_radius(outline: torch.Tensor) -> torch.Tensor:
    """Radius (...) in m of the circles around outlines (..., 2)."""
    return torch.where(outline[..., 1] < 0, outline[..., 0], torch.linalg.vector_norm(outline, dim=-1))


def reach(parts: Mapping[str, PartConfig]) -> float:
    """Radius (m) about its root of the circle in which a compound of scale 1 stays from above, however it swings."""
    return max(_reach(part) for part in parts.values())


def _reach(form: PartConfig) -> float:
    amplitude = 0.0 if form.swing is None else math.radians(form.swing.amplitude_deg)
    angle = torch.linspace(-amplitude, amplitude, 37, dtype=torch.float64)
    axis = torch.tensor((1.0, 0.0, 0.0) if form.swing is None else form.swing.direction, dtype=torch.float64)
    rest = torch.tensor(quat_from_rpy(*map(math.radians, form.rpy_deg)), dtype=torch.float64)
    turned = multiply(rest, quat_about(axis, angle))
    pos, hang = (torch.tensor(value, dtype=torch.float64) for value in (form.pos, form.hang))
    size = torch.tensor([[*form.size, 0.0, 0.0][:3]], dtype=torch.float64)
    half = PartShapes([form.kind], size.dtype, size.device).half_extents(size, matrix_of(turned)[:, None])[:, 0, :2]
    centre = (pos + rotate(turned, hang))[:, :2]
    return float((centre.norm(dim=1) + half.norm(dim=1)).max())


def quat_about(axis: torch.Tensor, angle: torch.Tensor) -> torch.Tensor:
    """Quaternions (..., 4) of turns by angles (...) in rad about unit axes (..., 3)."""
    return torch.cat(((angle / 2).cos()[..., None], (angle / 2).sin()[..., None] * axis), -1)
