"""A robot's links, limbs and feet, by the geometry and the tree of its compiled model."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import mujoco
import numpy as np

_DRIVABLE = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
SAME_LEVEL = 0.15
"""Ends of limbs are feet up to this share of the robot's height above the lowest one."""
SOLE = 0.012
"""Geoms of a foot that reach down to within this (m) of its lowest point carry the robot."""
POINT = 0.002
"""The same of a foot that is a point."""
FLAT = 0.05
"""A foot whose carrying geoms span at least this (m) has to stand flat."""


class Body:
    """A robot in a pose; links that are fixed to one another count as one, by the id of the topmost.

    Attributes:
        model, data: of the robot alone, kinematics up to date.
        base: body id of the floating base.
        joints: ids of the hinges and slides, in the order of the file.
        touchable: ids of the geoms that can be touched.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model, self.data = model, mujoco.MjData(model)
        self.base = int(model.jnt_bodyid[0])
        self.joints = [k for k in range(model.njnt) if model.jnt_type[k] in _DRIVABLE]
        self.touchable = [k for k in range(model.ngeom) if model.geom_contype[k] or model.geom_conaffinity[k]]
        self.place({})

    def name(self, joint: int) -> str:
        return self.model.joint(joint).name

    def link(self, geom: int) -> int:
        """The link that a geom belongs to."""
        return int(self.model.body_weldid[self.model.geom_bodyid[geom]])

    def place(self, angles: Mapping[int, float]) -> None:
        """Puts joints to angles (rad), all others as in the file, the base upright at the origin."""
        self.data.qpos[:] = self.model.qpos0
        self.data.qpos[:7] = 0, 0, 0, 1, 0, 0, 0
        for joint, angle in angles.items():
            self.data.qpos[self.model.jnt_qposadr[joint]] = angle
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)

    def limits(self, joint: int) -> tuple[float, float]:
        """Range of a joint (rad or m); half a turn to each side without limits."""
        if not self.model.jnt_limited[joint]:
            return -np.pi, np.pi
        low, high = self.model.jnt_range[joint].tolist()
        return low, high

    def lowest(self, geom: int) -> float:
        """Height (m) of the lowest point of a geom."""
        size, turn = self.model.geom_size[geom], self.data.geom_xmat[geom].reshape(3, 3)
        return float(self.data.geom_xpos[geom, 2]) - _reach_down(self.model, geom, size, turn[2])

    def ground(self) -> float:
        """Height (m) of the lowest point of all that can be touched."""
        return min(self.lowest(geom) for geom in self.touchable)

    def ends(self) -> list[int]:
        """Links that can be touched and have none such below them: hands, feet, tails."""
        links = {self.link(geom) for geom in self.touchable}
        inner = {above for link in links for above in self.above(link)[1:]}
        return sorted(links - inner - {int(self.model.body_weldid[self.base])})

    def above(self, link: int) -> list[int]:
        """A link and those that carry it, up to the base."""
        chain, top = [], int(self.model.body_weldid[self.base])
        while link != top and link != 0:
            chain.append(link)
            link = int(self.model.body_weldid[self.model.body_parentid[link]])
        return [*chain, top]

    def feet(self) -> list[int]:
        """The ends that reach down as far as the lowest, in the present pose."""
        ends = self.ends()
        low = {link: min(self.lowest(geom) for geom in self.geoms(link)) for link in ends}
        ground = min(low.values(), default=0.0)
        highest = max(float(self.data.geom_xpos[geom, 2]) for geom in self.touchable)
        return [link for link in ends if low[link] - ground <= SAME_LEVEL * (highest - ground)]

    def geoms(self, link: int) -> list[int]:
        """Geoms of a link that can be touched."""
        return [geom for geom in self.touchable if self.link(geom) == link]

    def soles(self, link: int) -> list[int]:
        """Geoms of a foot that carry the robot in the present pose."""
        return self._low(link, SOLE if self.is_flat(link) else POINT)

    def _low(self, link: int, above: float) -> list[int]:
        """Geoms of a link that reach down to `above` (m) over its lowest point."""
        low = {geom: self.lowest(geom) for geom in self.geoms(link)}
        return [geom for geom, z in low.items() if z - min(low.values()) <= above]

    def is_flat(self, link: int) -> bool:
        """Tell whether a foot has a sole, not a point: balls and ends of capsules touch below their middle."""
        ground = min(self.lowest(geom) for geom in self.geoms(link))
        places = np.concatenate([self._touching(geom, ground + SOLE) for geom in self._low(link, SOLE)])
        return float(np.ptp(places, 0).max()) >= FLAT

    def _touching(self, geom: int, height: float) -> np.ndarray:
        """(P, 2) m: around where a geom is lower than a height."""
        kind, centre = self.model.geom_type[geom], self.data.geom_xpos[geom]
        if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
            return centre[None, :2]
        if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
            radius, half = self.model.geom_size[geom, :2]
            axis = self.data.geom_xmat[geom].reshape(3, 3)[:, 2]
            ends = centre + np.array([[-half], [half]]) * axis
            return ends[ends[:, 2] - radius <= height + 1e-9, :2]
        return np.stack(self.bounds([geom]))[:, :2]

    def leg(self, link: int) -> list[int]:
        """Joints that carry a foot, from the base downwards."""
        links = self.above(link)[::-1][1:]
        carrier = self.model.body_weldid[self.model.jnt_bodyid]
        return [joint for at in links for joint in self.joints if carrier[joint] == at]

    def bounds(self, geoms: Iterable[int], frame: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """(3,) least and greatest coordinates (m) of geoms, in the world or in the frame of a body."""
        turn, origin = np.eye(3), np.zeros(3)
        if frame is not None:
            turn, origin = self.data.xmat[frame].reshape(3, 3), self.data.xpos[frame]
        low, high = np.full(3, np.inf), np.full(3, -np.inf)
        for geom in geoms:
            own = turn.T @ self.data.geom_xmat[geom].reshape(3, 3)
            centre, size = turn.T @ (self.data.geom_xpos[geom] - origin), self.model.geom_size[geom]
            reach = [
                (_reach_down(self.model, geom, size, -own[k]), _reach_down(self.model, geom, size, own[k]))
                for k in range(3)
            ]
            low = np.minimum(low, centre - [down for _, down in reach])
            high = np.maximum(high, centre + [up for up, _ in reach])
        return low, high


def _reach_down(model: mujoco.MjModel, geom: int, size: np.ndarray, up: np.ndarray) -> float:
    """How far (m) a geom reaches from its centre against `up`, a unit vector (3,) in the geom's frame."""
    kind, (x, y, z) = mujoco.mjtGeom(int(model.geom_type[geom])), size
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return x
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return x + y * abs(up[2])
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        return y * abs(up[2]) + x * float(np.hypot(up[0], up[1]))
    if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
        return float(np.linalg.norm(size * up))
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = int(model.geom_dataid[geom])
        first = int(model.mesh_vertadr[mesh])
        return float(-(model.mesh_vert[first : first + model.mesh_vertnum[mesh]] @ up).min())
    return float(np.abs(up) @ np.array([x, y, z]))
