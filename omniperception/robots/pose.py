"""A standing pose: legs a little shorter than they can be, feet below the centre of mass, soles flat."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from omniperception.robots.body import Body

BENT = {True: 0.8, False: 0.95}
"""Depth of the feet below the base as a share of the greatest, for robots of more than two feet and others."""
_MARGIN = 0.1
"""Share of a joint's range at each end that the pose keeps away from."""
_SAMPLES, _ROUNDS, _STEPS = 400, 4, 60
_DAMPING, _HOLD = 1e-3, 0.02
_FLATNESS = 0.3
"""Weight (m / rad) of a sole's tilt beside its place."""


@dataclass(frozen=True)
class Foot:
    """What the pose has to bring somewhere.

    Attributes:
        link: the foot.
        geom: the one whose centre counts; None: the link's origin, and the sole stays flat.
        joints: that only this foot hangs on.
    """

    link: int
    geom: int | None
    joints: tuple[int, ...]

    def place(self, body: Body) -> np.ndarray:
        """(3,) m."""
        return (body.data.xpos[self.link] if self.geom is None else body.data.geom_xpos[self.geom]).copy()


def feet_of(body: Body) -> list[Foot]:
    """The feet in the present pose, with the joints of their legs."""
    links = body.feet()
    legs = {link: body.leg(link) for link in links}
    found = []
    for link in links:
        others = {joint for other in links if other != link for joint in legs[other]}
        own = tuple(joint for joint in legs[link] if joint not in others)
        found.append(Foot(link, None if body.is_flat(link) else min(body.soles(link), key=body.lowest), own))
    return found


def first_pose(body: Body) -> dict[int, float]:
    """Angles (rad): 0, or well inside of the range where that is no angle of the joint."""
    angles = {}
    for joint in body.joints:
        low, high = body.limits(joint)
        inset = 1.5 * _MARGIN * (high - low)
        angles[joint] = 0.0 if low < 0 < high else float(np.clip(0, low + inset, high - inset))
    return angles


def standing_pose(body: Body, start: dict[int, float], feet: list[Foot]) -> dict[int, float]:
    """Angles (rad) of all joints; those of no leg stay as in `start`. Soles are as flat as in the file's own pose."""
    body.place({})
    upright = {foot.link: body.data.xmat[foot.link].reshape(3, 3).copy() for foot in feet}
    ratio = BENT[len(feet) > 2]
    goals = {}
    for foot in feet:
        body.place(start)
        aside, deepest = foot.place(body)[1], _deepest(body, start, foot)
        goals[foot.link] = np.array([deepest[0], aside, ratio * deepest[2]])
    angles = dict(start)
    for foot in feet:
        for joint in foot.joints:
            low, high = body.limits(joint)
            angles[joint] += 0.2 * ((low + high) / 2 - angles[joint])
    wanted = dict(angles)
    for _ in range(_ROUNDS):
        for foot in feet:
            _reach(body, angles, wanted, foot, goals[foot.link], upright[foot.link])
        body.place(angles)
        middle = np.mean(
            [foot.place(body)[:2] if foot.geom is not None else _sole_centre(body, foot) for foot in feet], 0
        )
        shift = body.data.subtree_com[body.base, :2] - middle
        for goal in goals.values():
            goal[:2] += shift
    return angles


def _sole_centre(body: Body, foot: Foot) -> np.ndarray:
    low, high = body.bounds(body.soles(foot.link))
    return ((low + high) / 2)[:2]


def _deepest(body: Body, start: dict[int, float], foot: Foot) -> np.ndarray:
    """(3,) m: where the foot is when it is as far below the base as the leg allows."""
    rng, angles = np.random.default_rng(0), dict(start)
    body.place(angles)
    best, place = angles, foot.place(body)
    for k in range(_SAMPLES):
        trial = dict(best)
        for joint in foot.joints:
            low, high = body.limits(joint)
            spread = (high - low) * (0.5 if k < _SAMPLES // 2 else 0.5 * 0.97 ** (k - _SAMPLES // 2))
            trial[joint] = float(np.clip(best[joint] + spread * rng.normal(), low, high))
        body.place(trial)
        found = foot.place(body)
        if found[2] < place[2] - 1e-6:
            best, place = trial, found
    return place


def _reach(
    body: Body, angles: dict[int, float], wanted: dict[int, float], foot: Foot, goal: np.ndarray, upright: np.ndarray
) -> None:
    """Moves a leg's angles by damped least squares until the foot is at its goal (3,) (m)."""
    model, data = body.model, body.data
    dofs = [int(model.jnt_dofadr[joint]) for joint in foot.joints]
    limits = np.array([body.limits(joint) for joint in foot.joints])
    room = _MARGIN * (limits[:, 1] - limits[:, 0])
    low, high = limits[:, 0] + room, limits[:, 1] - room
    q, rest = (np.array([pose[joint] for joint in foot.joints]) for pose in (angles, wanted))
    low, high = np.minimum(low, rest), np.maximum(high, rest)
    jac, turn = np.zeros((3, model.nv)), np.zeros((3, model.nv))
    for _ in range(_STEPS):
        body.place(angles | dict(zip(foot.joints, q.tolist(), strict=True)))
        point = foot.place(body)
        mujoco.mj_jac(model, data, jac, turn, point, foot.link)
        rows, error = [jac[:, dofs]], [goal - point]
        if foot.geom is None:
            tilt = np.cross(data.xmat[foot.link].reshape(3, 3) @ upright.T @ np.eye(3)[2], np.eye(3)[2])
            rows.append(_FLATNESS * turn[:2, dofs])
            error.append(_FLATNESS * tilt[:2])
        rows.append(_HOLD * np.eye(len(q)))
        error.append(_HOLD * (rest - q))
        a, b = np.vstack(rows), np.concatenate(error)
        step = np.linalg.solve(a.T @ a + _DAMPING * np.eye(len(q)), a.T @ b)
        q = np.clip(q + np.clip(step, -0.2, 0.2), low, high)
    angles.update(zip(foot.joints, q.tolist(), strict=True))
