"""How a gait answers to asked velocities: measured in full physics, followed by robots without legs."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from omnirobot.common.shell import command_line

FILE = "response.json"
"""Name of the file in a run directory."""
VERSION = 1
DIGITS = 4
"""Significant digits of what is saved."""
AXES = ("x", "y", "yaw")
"""Of a velocity: ahead and to the left (m/s, yaw-aligned frame), and the yaw rate (rad/s)."""


class NoResponse(ValueError):
    """A run whose gait has not been measured, or by another version of this program."""


@dataclass(frozen=True)
class AxisResponse:
    """One axis of the velocity v under the asked one u: v follows gain * u(t - delay_s) + offset with a first-order lag
    of `lag_s`, plus an error that wanders. Pairs are mean and standard deviation between robots.

    v is the base's own at the end of a control step, and u what the gait is given for the step, after the limit of
    6 m/s^2 (of the vector v_x, v_y) and 8 rad/s^2: without a delay, u moves v within the same step.

    Attributes:
        gain: factor.
        lag_s: time constant (s) of the lag.
        delay_s: dead time (s).
        acceleration: largest |dv/dt| (m/s^2 or rad/s^2) that the gait was seen to reach: the 99th percentile over time
            of v smoothed over 0.1 s, the wandering error included.
        offset: m/s or rad/s, of an error that lasts while the robot steps; one whose clock rests stands.
        noise: standard deviation (m/s or rad/s) of the error that wanders (an Ornstein-Uhlenbeck process): of all that
            the rest does not explain, the swinging of the trunk with its steps included.
        noise_s: time (s) after which a fraction 1/e of it is left; such that its mean over one period of the gait
            varies as that of the gait's error does, so that a robot gets as far astray.
    """

    gain: Sequence[float]
    lag_s: Sequence[float]
    delay_s: Sequence[float]
    acceleration: float
    offset: Sequence[float]
    noise: float
    noise_s: float


@dataclass(frozen=True)
class ConditionResponse:
    """A gait under one condition of conf/condition.

    Attributes:
        version: of the condition.
        axes: by name of AXES.
        height_sd: standard deviation (m) of the base's height around the cycle of the command next to the asked one,
            while new velocities are asked for each second.
        tilt_sd: standard deviations (rad) of roll and pitch, likewise.
        falls: (low, high, jumps, falls): of jumps of the wanted (v_x, v_y) by `low` or more and less than `high` (m/s),
            before the limit of its change, how many were asked for and how many ended in a fall within a second.
    """

    version: int
    axes: Mapping[str, AxisResponse]
    height_sd: float
    tilt_sd: Sequence[float]
    falls: Sequence[Sequence[float]]


@dataclass(frozen=True)
class Cycle:
    """One period of the gait under a steady command, at P even phases p / P, where the phase is the gait's frequency
    times the time since the episode began (`EnvState.time_s`), without its whole part. P = 1 without a clock.

    Attributes:
        command: asked v_x, v_y (m/s) and yaw rate (rad/s).
        height: (P,) m, of the base's origin above flat ground.
        roll, pitch: (P,) rad.
        joints: (P, num_joints) rad, in the order of `robot.joints`.
    """

    command: Sequence[float]
    height: Sequence[float]
    roll: Sequence[float]
    pitch: Sequence[float]
    joints: Sequence[Sequence[float]]


@dataclass(frozen=True)
class GaitResponse:
    """What `omniperception gait what=response` writes beside a gait's weights.

    Attributes:
        frequency: of the cycle (Hz); 0: the gait has no clock.
        ranges: (low, high) of what may be asked for, by name of AXES.
        radius, half_length: m, of the capsule along the base's x axis that is as wide, and to either end as long, as
            trunk and moving legs are in 95 % of the time that the robot walks ahead, seen from above: what lies within
            `radius` of a line from -half_length to half_length is touched.
        conditions: by name.
        cycles: for a few commands, standing still among them.
    """

    frequency: float
    ranges: Mapping[str, Sequence[float]]
    radius: float
    half_length: float
    conditions: Mapping[str, ConditionResponse]
    cycles: Sequence[Cycle]

    def save(self, run_dir: Path) -> Path:
        """Writes it into a run directory; returns the file."""
        path = run_dir / FILE
        text = json.dumps({"version": VERSION, **_rounded(asdict(self))}, indent=1)
        path.write_text(re.sub(r"\[[^\[\]{}]*\]", lambda found: " ".join(found[0].split()), text) + "\n")
        return path

    @classmethod
    def load(cls, run_dir: Path) -> GaitResponse:
        """Reads a run directory's.

        Raises:
            NoResponse: there is none, or of another version, or it is damaged.
        """
        path, line = run_dir / FILE, command_line("gait", f"run={run_dir}", "what=response")
        if not path.is_file():
            raise NoResponse(f"{run_dir} has no measured response of its gait ({FILE}); measure it: {line}")
        try:
            given = json.loads(path.read_text())
            if given.pop("version", None) != VERSION:
                raise NoResponse(f"{path} is of another version of this program; measure it again: {line}")
            return cls._of(given)
        except (AttributeError, KeyError, TypeError, UnicodeDecodeError, json.JSONDecodeError):
            raise NoResponse(f"{path} is damaged; measure it again: {line}") from None

    @classmethod
    def _of(cls, given: dict[str, Any]) -> GaitResponse:
        conditions = {
            name: ConditionResponse(**{**own, "axes": {a: AxisResponse(**one) for a, one in own["axes"].items()}})
            for name, own in given.pop("conditions").items()
        }
        cycles = tuple(Cycle(**one) for one in given.pop("cycles"))
        return cls(**given, conditions=conditions, cycles=cycles)


def _rounded(value: Any) -> Any:
    """Plain data with DIGITS significant digits."""
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}")
    if isinstance(value, Mapping):
        return {key: _rounded(one) for key, one in value.items()}
    return [_rounded(one) for one in value] if isinstance(value, list | tuple) else value
