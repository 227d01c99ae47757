"""The ground as a height field on a kinematic body, whatever its heights come from."""

from __future__ import annotations

import mujoco
import numpy as np

from omniperception.scene.terrain import GROUND, set_contact

EDGE = 1.0
"""Distance (m) from the outer edge of the terrain at which an environment counts as outside."""
_BASE = 0.5
"""Thickness (m) of the solid under the lowest point."""


def add_height_field(
    spec: mujoco.MjSpec, heights: np.ndarray, cell: float, friction: float, restitution: float
) -> None:
    """Adds heights (rows, cols) in m, `cell` (m) apart, x along columns, whose middle is the body's origin."""
    low, span = heights.min(), max(np.ptp(heights), 1e-3)
    rows, cols = heights.shape
    spec.add_hfield(
        name=GROUND,
        size=[(cols - 1) * cell / 2, (rows - 1) * cell / 2, span, _BASE],
        nrow=rows,
        ncol=cols,
        userdata=((heights - low) / span).astype(np.float32).ravel(),
    )
    body = spec.worldbody.add_body(name=GROUND, mocap=True)
    geom = body.add_geom(name=GROUND, type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname=GROUND, pos=[0, 0, low])
    set_contact(geom, friction, restitution)
