"""Torque limits and gains of joints, from the file, or from masses and the standing pose."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from omniperception.robots.body import Body
from omniperception.robots.pose import Foot

GRAVITY = 9.81
LEG_LOAD = 0.5
"""Torque limit of a leg's joint as a share of weight times length of the leg; the Go2's hips have 0.45."""
ARM_LOAD = 2.0
"""That of any other joint as a multiple of its load, with everything that it carries stretched out."""
STIFFNESS = 2.0
"""Least kp as a multiple of a joint's load: with less than 1 an upright load topples; the Go2's 25: 2.1."""
SAG = 0.2
"""Angle (rad) by which gravity may bend a joint away from its target in the standing pose."""
ROTOR = 4e-4
"""Armature (kg m^2) for each N m of the torque limit, where the file has none; the Go2's: 0.01 at 24 N m."""
REACH = 0.25
"""The action scale is this share of the angle at which the gain alone gives the torque limit."""
SCALES = 0.15, 0.5
"""Least and greatest action scale (rad)."""


@dataclass(frozen=True)
class Gains:
    """Figures of the actuated joints, in their order.

    Attributes:
        torque_limits: N m.
        said: which of the limits the file says.
        inertia: kg m^2 about each joint with everything below it, rotors included.
        armature: kg m^2; None where the file has it for all joints.
        kp, kv: N m / rad and N m s / rad.
        action_scale: rad.
    """

    torque_limits: np.ndarray
    said: np.ndarray
    inertia: np.ndarray
    armature: np.ndarray | None
    kp: np.ndarray
    kv: np.ndarray
    action_scale: np.ndarray


def gains_of(
    body: Body, spec: mujoco.MjSpec, joints: list[int], feet: list[Foot], frequency: float, damping_ratio: float
) -> Gains:
    """Gains in the present pose.

    A joint with everything below it is a spring of `frequency` (Hz) with `damping_ratio`, kp = I (2 pi f)^2 and kv = 2
    zeta sqrt(kp I), or stiffer where gravity would bend it by more than SAG or its load would topple it.

    Args:
        body: standing.
        spec: the file as it is, with its actuators.
        joints: ids of those that are actuated.
        feet: that carry the robot.
        frequency: Hz.
        damping_ratio: 1 is critical.
    """
    model, data = body.model, body.data
    dofs = [int(model.jnt_dofadr[joint]) for joint in joints]
    stated = np.array([_stated_limit(model, spec, joint) for joint in joints])
    guessed = np.array([_guessed_limit(body, joint, feet) for joint in joints])
    limits = np.where(stated > 0, stated, guessed)
    missing = model.dof_armature[dofs] == 0
    armature = np.where(missing, ROTOR * limits, model.dof_armature[dofs])
    inertia = mass_matrix(model, data).diagonal()[dofs] - model.dof_armature[dofs] + armature
    held = np.abs(_holding_torque(body, feet)[dofs])
    load = STIFFNESS * np.array([_load(body, joint, feet) for joint in joints])
    kp = np.max([inertia * (2 * np.pi * frequency) ** 2, held / SAG, load], axis=0)
    return Gains(
        torque_limits=limits,
        said=stated > 0,
        inertia=inertia,
        armature=armature if missing.any() else None,
        kp=kp,
        kv=2 * damping_ratio * np.sqrt(kp * inertia),
        action_scale=np.clip(REACH * limits / kp, *SCALES),
    )


def mass_matrix(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """(nv, nv)."""
    mujoco.mj_forward(model, data)
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    return full


def _holding_torque(body: Body, feet: list[Foot]) -> np.ndarray:
    """(nv,) N m: holds the robot up against gravity while its feet share its weight."""
    model, data = body.model, body.data
    data.qvel[:] = 0
    mujoco.mj_forward(model, data)
    torque, jac = data.qfrc_bias.copy(), np.zeros((3, model.nv))
    share = model.body_subtreemass[body.base] * GRAVITY / max(len(feet), 1)
    for foot in feet:
        mujoco.mj_jac(model, data, jac, None, foot.place(body), foot.link)
        torque -= jac[2] * share
    return torque


def _stated_limit(model: mujoco.MjModel, spec: mujoco.MjSpec, joint: int) -> float:
    """N m that the file allows: of its joint, or of an actuator of its; 0 where it says nothing."""
    if model.jnt_actfrclimited[joint]:
        return float(np.abs(model.jnt_actfrcrange[joint]).max())
    name, found = model.joint(joint).name, 0.0
    for actuator in spec.actuators:
        if actuator.target == name and actuator.trntype == mujoco.mjtTrn.mjTRN_JOINT:
            force = float(np.abs(actuator.forcerange).max())
            if actuator.biastype == mujoco.mjtBias.mjBIAS_NONE and force == 0:
                force = float(np.abs(actuator.ctrlrange).max() * abs(actuator.gainprm[0]))  # a motor
            found = force * abs(actuator.gear[0])
    return found


def _guessed_limit(body: Body, joint: int, feet: list[Foot]) -> float:
    """N m: for a leg from the robot's weight and the leg's length, for others from what they carry."""
    is_leg = any(joint in foot.joints for foot in feet)
    return max(_load(body, joint, feet) * (LEG_LOAD * len(feet) if is_leg else ARM_LOAD), 0.1)


def _load(body: Body, joint: int, feet: list[Foot]) -> float:
    """N m for each rad by which a load leans: a leg's share of the weight times its length; what another carries."""
    model, data = body.model, body.data
    for foot in feet:
        if joint in foot.joints:
            length = np.linalg.norm(foot.place(body) - data.xanchor[foot.joints[0]])
            return float(model.body_subtreemass[body.base] * GRAVITY / len(feet) * length)
    link = int(model.body_weldid[model.jnt_bodyid[joint]])
    carried = [k for k in range(1, model.nbody) if link in body.above(int(model.body_weldid[k]))]
    arms = np.linalg.norm(data.xipos[carried] - data.xanchor[joint], axis=1)
    return float(GRAVITY * model.body_mass[carried] @ arms)
