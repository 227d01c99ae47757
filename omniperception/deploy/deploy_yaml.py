"""The description of an exported policy in the form of unitree_rl_lab's deploy.yaml."""

from __future__ import annotations

import math
from collections.abc import Sequence

import yaml

from omnirobot.common.errors import repeated
from omnirobot.runtime.description import Description, Group, Joints, Term
from omnirobot.runtime.go2 import MOTORS

FILE = "deploy.yaml"

_NAMES = {
    "joint_pos_offset": "joint_pos_rel",
    "joint_vel": "joint_vel_rel",
    "base_lin_vel": "base_lin_vel",
    "base_ang_vel": "base_ang_vel",
    "projected_gravity": "projected_gravity",
    "command": "velocity_commands",
    "previous_action": "last_action",
    "gait_phase": "gait_phase",
}
"""Isaac Lab's name of each quantity."""


def deploy_yaml(description: Description) -> str | None:
    """Text of deploy.yaml; None for a robot whose joints are not a Go2's, of which the motors' order is not known here.

    As there, `stiffness` and `damping` are in the motors' order, everything else in the policy's; joint k of the policy
    is motor `joint_ids_map[k]`. What unitree_rl_lab's controller cannot give is named in comments at the top.
    """
    joints = description.joints
    if set(joints.names) != set(MOTORS):
        return None
    content = {
        "joint_ids_map": [MOTORS.index(name) for name in joints.names],
        "step_dt": description.control_period_s,
        "stiffness": _by_motor(joints, joints.kp),
        "damping": _by_motor(joints, joints.kd),
        "default_joint_pos": _plain(joints.default_pos),
        "commands": {"base_velocity": {"ranges": {**_ranges(description), "heading": None}}},
        "actions": {
            "JointPositionAction": {
                "clip": [_clip(low, high) for low, high in zip(joints.lower, joints.upper, strict=True)],
                "joint_names": [".*"],
                "scale": _each(joints.action_scale, len(joints.names)),
                "offset": _plain(joints.default_pos),
                "joint_ids": None,
            }
        },
        "observations": {
            _NAMES.get(term.quantity, term.quantity): _term(group, term) for group, term in _terms(description)
        },
    }
    comments = "".join(f"# {line}\n" for line in _caveats(description))
    return comments + yaml.safe_dump(content, default_flow_style=None, sort_keys=False, width=120)


def _clip(low: float | None, high: float | None) -> list[float]:
    return _plain((-math.inf if low is None else low, math.inf if high is None else high))


def _each(value: float | Sequence[float], count: int) -> list[float]:
    return [value] * count if isinstance(value, int | float) else _plain(value)


def _by_motor(joints: Joints, value: float | Sequence[float]) -> list[float]:
    """A number of all joints, or one of each, in the order of the motors."""
    by_name = dict(zip(joints.names, _each(value, len(joints.names)), strict=True))
    return [by_name[name] for name in MOTORS]


def _terms(description: Description) -> list[tuple[Group, Term]]:
    return [(group, term) for group in description.observations for term in group.terms]


def _term(group: Group, term: Term) -> dict:
    params: dict[str, float | str] = {}
    if term.quantity == "command":
        params = {"command_name": "base_velocity"}
    if term.frequency is not None:
        params = {"period": 1.0 / term.frequency}
    return {"params": params, "clip": None, "scale": [term.scale] * term.size, "history_length": group.history}


def _ranges(description: Description) -> dict[str, list[float]]:
    return {name: _plain(limits) for name, limits in description.command.items()}


def _caveats(description: Description) -> list[str]:
    """What a controller that reads this file alone would do otherwise than training."""
    lines = ["Written beside policy.json, which says more; the network's input is named 'observations'."]
    if description.perception is not None:
        lines.append("It also reads 'frames' and 'frame_count' of a LiDAR, which this form has no place for.")
    if any(group.history > 1 and len(group.terms) > 1 for group in description.observations):
        lines.append("History is by time: all terms of the oldest step first, where Isaac Lab goes term by term.")
    every = [term.quantity for _, term in _terms(description)]
    if twice := repeated(every):
        lines.append(f"The network reads {', '.join(twice)} more than once; here each has one entry, its last.")
    own = [name for name in every if name not in _NAMES]
    if own:
        lines.append(f"Of unitree_rl_lab's observations none is {', '.join(own)}.")
    if "base_lin_vel" in every:
        lines.append("base_lin_vel is no observation of unitree_rl_lab's controller; a state estimator must give it.")
    if description.command_acceleration is not None:
        lines.append(
            f"velocity_commands follow the command at {list(description.command_acceleration)} m/s^2, rad/s^2."
        )
    for term in (term for _, term in _terms(description) if term.frequency is not None):
        lines.append(f"{term.quantity} is 0 once the command has been 0 for {term.rest_s:g} s.")
    lines.append(f"Actions, and last_action, are clipped to +-{description.joints.action_limit:g} before their scale.")
    if description.estimated:
        lines.append(f"The network's second output, 'estimate', is its {', '.join(description.estimated)}.")
    if description.max_acceleration is not None:
        lines.append("Its last output, 'asked', goes into its input 'last_asked' at the next step, 0 at the first.")
    if description.stepping is not None:
        lines.append("NOT TO BE USED AS IT IS: targets lack the stepping motion of policy.json, which this form has no")
        lines.append("place for.")
    return lines


def _plain(values: Sequence[float]) -> list[float]:
    """Numbers with 6 digits: more are float32's rounding."""
    return [float(f"{value:.6g}") for value in values]
