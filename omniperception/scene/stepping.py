"""Stepping on the spot: joint angles that lift a robot's feet in turn, to which actions are added."""

from __future__ import annotations

import itertools

import mujoco
import numpy as np

from omniperception.common.checked import NonNegative, Positive, checked
from omniperception.scene.robot import RobotConfig

ROWS = 40
"""Rows of a table of `stepping_offsets`; in between, angles are interpolated linearly."""
_DAMPING = 1e-6
_ITERATIONS = 30
_LARGEST = 0.3
"""rad: most that a joint turns in an iteration."""
_CONVERGED = 1e-12
"""rad: a step below this is the last."""
_TOLERANCE = 1e-3
"""m: of where a foot is lifted to."""


@checked("stepping")
class SteppingConfig:
    """A robot that steps on the spot by the clock of `robot.gait` while its actions are zero.

    As the foot trajectories of Lee et al., 'Learning Quadrupedal Locomotion over Challenging Terrain' (2020), with one
    frequency: each foot goes straight up and down, and what takes the robot anywhere is learned.

    Attributes:
        lift: how high feet are lifted, as a share of `robot.gait.foot_height`: more than 1 where joints yield.
        rest_s: how long (s) the command has to be to stand until the feet stay down.
    """

    lift: Positive
    rest_s: NonNegative


def stepping_offsets(robot: RobotConfig, lift: float) -> np.ndarray:
    """(ROWS, num_joints) rad: what is added to the default pose over one period of the clock of `robot.gait`, in the
    order of `robot.joints`; row k is at the share k / ROWS of a period.

    A foot that swings is (lift * foot_height - its height in the default pose) sin^2(pi s) higher at a share s of it;
    its leg's joints take it there, the base being held. What the position leaves free keeps the foot's orientation,
    as far as joints reach.

    Raises:
        ValueError: the robot has no gait, or a leg cannot lift its foot so high, or not straight up.
    """
    gait = robot.gait
    if gait is None:
        raise ValueError("stepping follows the clock of robot.gait, which is null; give it, or use stepping=null")
    legs = _Legs(robot, gait.foot_height)
    offsets = np.zeros((ROWS, robot.num_joints))
    for row, (foot, offset) in itertools.product(range(ROWS), enumerate(gait.offsets)):
        swing = (np.mod(row / ROWS - offset, 1.0) - gait.duty) / (1.0 - gait.duty)
        if swing > 0.0:
            offsets[row] += legs.lifted(foot, lift, float(np.sin(np.pi * swing) ** 2))
    return offsets


class _Legs:
    """The robot in its default pose, whose feet are lifted one at a time."""

    def __init__(self, robot: RobotConfig, foot_height: float) -> None:
        self._foot_height = foot_height
        self._robot, self._model = robot, robot.compiled()
        self._data = robot.posed(self._model)
        self._pose = self._data.qpos.copy()
        self._feet = [[self._model.geom(name).id for name in foot] for foot in robot.feet]

    def lifted(self, foot: int, lift: float, share: float) -> np.ndarray:
        """(num_joints,) rad: change of the pose that lifts a foot by a share of the way to `lift` times its height."""
        model, data, robot = self._model, self._data, self._robot
        joints = [model.joint(name) for name in robot.joints]
        body = int(model.geom_bodyid[self._feet[foot][0]])
        carries = [_above(model, body, int(joint.bodyid[0])) for joint in joints]
        own = [joint for joint, has in zip(joints, carries, strict=True) if has]
        dofs, places = [int(joint.dofadr[0]) for joint in own], [int(joint.qposadr[0]) for joint in own]
        low, high = np.array([joint.range if joint.limited[0] else (-np.inf, np.inf) for joint in own]).T
        data.qpos[:] = self._pose
        start = self._foot(foot)
        target = start + share * np.array((0.0, 0.0, lift * self._foot_height - start[2]))
        upright = data.xquat[body].copy()
        for _ in range(_ITERATIONS):
            here = self._foot(foot)
            moves, turns = self._jacobians(foot, body, dofs)
            turned = np.empty(3)
            mujoco.mju_subQuat(turned, upright, data.xquat[body])
            turned = data.xmat[body].reshape(3, 3) @ turned
            angles, step = data.qpos[places], _step(moves, turns, target - here, turned)
            beyond = (angles + step < low) | (angles + step > high)
            if beyond.any():  # those go to their stops, the others do what is left
                moves[:, beyond] = turns[:, beyond] = 0.0
                step = np.where(beyond, step, _step(moves, turns, target - here, turned))
            data.qpos[places] = np.clip(angles + step, low, high)
            if np.abs(step).max() < _CONVERGED:
                break
        if np.abs(self._foot(foot) - target).max() > _TOLERANCE:
            raise ValueError(
                f"stepping.lift={lift}: the leg of {robot.foot_names[foot]} does not lift it straight up to"
                f" {target[2]:.3f} m within the ranges of its joints; lower it or robot.gait.foot_height, bend the leg"
                " more in robot.default_joint_pos, or use stepping=null"
            )
        change = np.zeros(robot.num_joints)
        change[carries] = (data.qpos - self._pose)[places]
        return change

    def _foot(self, foot: int) -> np.ndarray:
        """(3,) m: where a foot is."""
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)
        return self._data.geom_xpos[self._feet[foot]].mean(0)

    def _jacobians(self, foot: int, body: int, dofs: list[int]) -> tuple[np.ndarray, np.ndarray]:
        """(3, J) each: of the foot's position and orientation."""
        moves, turns = np.empty((2, 3, self._model.nv))
        mujoco.mj_jac(self._model, self._data, moves, turns, self._data.geom_xpos[self._feet[foot]].mean(0), body)
        return moves[:, dofs], turns[:, dofs]


def _step(moves: np.ndarray, turns: np.ndarray, offset: np.ndarray, turned: np.ndarray) -> np.ndarray:
    """(J,) rad, at most _LARGEST: change of angles that moves a foot by `offset` (3,) m and, where that leaves a
    choice, turns it by `turned` (3,) rad."""
    inverse = _damped_inverse(moves)
    step = inverse @ offset
    free = np.eye(len(step)) - inverse @ moves
    step += free @ _damped_inverse(turns @ free) @ (turned - turns @ step)
    return step * min(1.0, _LARGEST / max(float(np.abs(step).max()), _LARGEST))


def _damped_inverse(matrix: np.ndarray) -> np.ndarray:
    """(J, 3) of a matrix (3, J): nearly zero in directions that hardly move anything."""
    return matrix.T @ np.linalg.inv(matrix @ matrix.T + _DAMPING * np.eye(3))


def _above(model: mujoco.MjModel, body: int, ancestor: int) -> bool:
    """Tell whether a body is fixed to another or to what follows from it."""
    while body > 0 and body != ancestor:
        body = int(model.body_parentid[body])
    return body == ancestor
