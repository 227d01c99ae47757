"""Which geoms of a robot the rays of a sensor on it can never reach, whatever its joints do: a conservative bound."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import mujoco
import numpy as np

_MAX_CELLS = 50_000
"""Cells of joint angles looked at together; a geom that needs more counts as within reach."""
_MAX_BALLS = 8
"""Balls along each axis that a geom is covered with."""


@dataclass(frozen=True)
class FieldOfView:
    """Where a sensor's rays go, in its own frame: all of them lie in a band of elevations and in a cone.

    Attributes:
        pos, quat: the sensor in the frame of the body that carries it, m and (w, x, y, z).
        elevation: lowest and highest elevation, rad.
        axis: unit vector, (3,).
        half_angle: of the cone around the axis, rad.
        reach: how far from the sensor's origin rays start, m.
    """

    pos: np.ndarray
    quat: np.ndarray
    elevation: tuple[float, float]
    axis: np.ndarray
    half_angle: float
    reach: float

    @classmethod
    def of(
        cls, pos: np.ndarray, quat: np.ndarray, directions_s: np.ndarray, spread: float = 0.0, reach: float = 0.0
    ) -> FieldOfView:
        """The field of view of rays along `directions_s` (M, 3), each of which may lean by `spread` (rad)."""
        directions = np.asarray(directions_s, dtype=np.float64)
        elevation = np.arcsin(directions[:, 2].clip(-1.0, 1.0))
        mean = directions.mean(0)
        axis = mean / max(np.linalg.norm(mean), 1e-9)
        half_angle = np.arccos((directions @ axis).clip(-1.0, 1.0)).max() + spread
        band = float(elevation.min() - spread), float(elevation.max() + spread)
        return cls(np.asarray(pos, float), np.asarray(quat, float), band, axis, float(half_angle), reach)

    def may_see(self, centres: np.ndarray, radius: np.ndarray | float) -> np.ndarray:
        """(...) bool: whether a ray may come into balls at `centres` (..., 3) in the carrier's frame."""
        radius = radius + self.reach
        c = (centres - self.pos) @ _matrix(self.quat)
        distance = np.linalg.norm(c, axis=-1)
        inside = distance <= radius
        distance = np.where(inside, 1.0, distance)
        fills = np.arcsin(np.where(inside, 1.0, radius / distance)) + 1e-6
        elevation = np.arcsin((c[..., 2] / distance).clip(-1.0, 1.0))
        away = np.arccos((c @ self.axis / distance).clip(-1.0, 1.0))
        low, high = self.elevation
        in_band = (elevation + fills >= low) & (elevation - fills <= high)
        return inside | (in_band & (away - fills <= self.half_angle))


def unreachable_geoms(model: mujoco.MjModel, carrier: int, view: FieldOfView) -> frozenset[int]:
    """Geoms on the links below the sensor's carrier that no ray can meet in any configuration of the joints.

    Geoms are covered with balls. A ball's centre moves by at most (distance from the axis) x (angle) with each joint
    between it and the carrier, so that one test of a ball widened by that decides for a whole cell of joint angles;
    cells that stay open are divided. Joints may turn all around: the engine's limits are soft, and a hard command
    presses a joint a radian beyond them. What occludes what is not considered.

    Args:
        model: the compiled model.
        carrier: id of the body that carries the sensor.
        view: its field of view.
    """
    found = set()
    for geom in range(model.ngeom):
        chain = _chain(model, carrier, int(model.geom_bodyid[geom]))
        if chain is not None and not _within_reach(model, chain, geom, view):
            found.add(geom)
    return frozenset(found)


def _chain(model: mujoco.MjModel, carrier: int, body: int) -> list[int] | None:
    """Bodies from below the carrier down to `body`; None where it is no link below it that turns on hinges."""
    chain: list[int] = []
    while body not in (carrier, 0):
        chain.insert(0, body)
        body = int(model.body_parentid[body])
    if body != carrier:
        return None
    turning = all(model.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE for b in chain for j in _joints(model, b))
    return chain if turning else None


def _joints(model: mujoco.MjModel, body: int) -> range:
    first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
    return range(first, first + count)


def _within_reach(model: mujoco.MjModel, chain: list[int], geom: int, view: FieldOfView) -> bool:
    points, radius = _balls(model, geom)
    joints = [j for body in chain for j in _joints(model, body)]
    centre, half = np.zeros((1, len(joints))), np.full(len(joints), np.pi)
    halves = np.array(list(product((-0.5, 0.5), repeat=len(joints)))).reshape(2 ** len(joints), len(joints))
    while True:
        placed, arm = _place(model, chain, centre, points)  # (C, B, 3), (joints, B)
        if view.may_see(placed, radius).any():
            return True
        centre = centre[view.may_see(placed, radius + half @ arm).any(1)]
        if not len(centre):
            return False
        if not joints or len(centre) * len(halves) > _MAX_CELLS:
            return True
        centre = (centre[:, None] + halves * half).reshape(-1, len(joints))
        half = half / 2


def _balls(model: mujoco.MjModel, geom: int) -> tuple[np.ndarray, float]:
    """Centres (B, 3) in the geom's body and the radius of balls that cover a geom's box; for a plane, all of space."""
    half = model.geom_aabb[geom, 3:]
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE:
        return np.zeros((1, 3)), np.inf
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_SPHERE:
        return model.geom_pos[geom][None].copy(), float(half[0])
    counts = np.minimum(np.ceil(half / half.min() - 1e-9), _MAX_BALLS).astype(int)
    steps = [(2 * np.arange(n) + 1 - n) / n for n in counts]
    grid = np.stack(np.meshgrid(*steps, indexing="ij"), -1).reshape(-1, 3)
    centres = model.geom_aabb[geom, :3] + grid * half
    return model.geom_pos[geom] + centres @ _matrix(model.geom_quat[geom]).T, float(np.linalg.norm(half / counts))


def _place(
    model: mujoco.MjModel, chain: list[int], angles: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Points (C, B, 3) in the carrier's frame, and (J, B) how far each is from a joint at most.

    Angles (C, J) count from the reference pose. The largest distance from a joint's anchor, whatever the joints below
    it do, is the way along the links.
    """
    placed = np.broadcast_to(points, (len(angles), *points.shape))
    arms: list[np.ndarray] = []
    away = None  # (B,) bound of the distance from the present body's origin
    column = angles.shape[1]
    for body in reversed(chain):
        for joint in reversed(_joints(model, body)):
            column -= 1
            anchor = model.jnt_pos[joint]
            spans = np.linalg.norm(points - anchor, axis=-1) if away is None else away + np.linalg.norm(anchor)
            arms.insert(0, spans)
            turn = _rotations(model.jnt_axis[joint], angles[:, column])
            placed = np.einsum("cij,cbj->cbi", turn, placed - anchor) + anchor
            away = spans + np.linalg.norm(anchor)
        step = np.linalg.norm(model.body_pos[body])
        away = (np.linalg.norm(points, axis=-1) if away is None else away) + step
        placed = placed @ _matrix(model.body_quat[body]).T + model.body_pos[body]
    return placed, np.array(arms).reshape(angles.shape[1], len(points))


def _rotations(axis: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Rotation matrices (C, 3, 3) by angles (C,) about a unit axis, by Rodrigues' formula."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    sin, cos = np.sin(angles)[:, None, None], np.cos(angles)[:, None, None]
    return np.eye(3) + sin * cross + (1.0 - cos) * (cross @ cross)


def _matrix(quat: np.ndarray) -> np.ndarray:
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, np.asarray(quat, dtype=np.float64))
    return matrix.reshape(3, 3)
