"""How a gait answers to the velocity that it is asked for: measured in full physics, followed by robots without legs."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

FILE = "response.json"
"""Name of the file in a run directory."""
VERSION = 1
AXES = ("x", "y", "yaw")
"""Of a velocity: ahead and to the left (m/s, yaw-aligned frame), and the yaw rate (rad/s)."""


class NoResponse(ValueError):
    """A run whose gait has not been measured, or by another version of this program."""


@dataclass(frozen=True)
class AxisResponse:
    """One axis of the velocity v under the asked one u: v follows gain * u(t - delay_s) + offset with a first-order lag
    of `lag_s`, plus an error that wanders. Pairs are mean and standard deviation between robots.

    Attributes:
        gain: factor.
        lag_s: time constant (s) of the lag.
        delay_s: dead time (s).
        acceleration: largest |dv/dt| (m/s^2 or rad/s^2) that the gait was seen to reach, its 99th percentile.
        offset: standard deviation (m/s or rad/s) between robots of an error that lasts.
        noise: standard deviation (m/s or rad/s) of the error that wanders (an Ornstein-Uhlenbeck process).
        noise_s: time (s) after which a fraction 1/e of it is left.
    """

    gain: Sequence[float]
    lag_s: Sequence[float]
    delay_s: Sequence[float]
    acceleration: float
    offset: float
    noise: float
    noise_s: float


@dataclass(frozen=True)
class ConditionResponse:
    """A gait under one condition of conf/condition.

    Attributes:
        version: of the condition.
        axes: by name of AXES.
        height_sd: standard deviation (m) of the base's height around its cycle.
        tilt_sd: standard deviations (rad) of roll and pitch around their cycles.
        falls: (low, high, jumps, falls): of jumps of the asked velocity between `low` and `high` (m/s), how many were
            asked for and how many ended in a fall within a second.
    """

    version: int
    axes: Mapping[str, AxisResponse]
    height_sd: float
    tilt_sd: Sequence[float]
    falls: Sequence[Sequence[float]]


@dataclass(frozen=True)
class Cycle:
    """One period of the gait under a command, from the phase at which its clock begins, in P even steps.

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
        frequency: of the cycle (Hz).
        ranges: (low, high) of what may be asked for, by axis.
        radius, half_length: m, of the capsule along the base's x axis that holds trunk and moving legs, seen from
            above: what lies within `radius` of a line from -half_length to half_length is touched.
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
        path.write_text(json.dumps({"version": VERSION, **asdict(self)}, indent=1) + "\n")
        return path

    @classmethod
    def load(cls, run_dir: Path) -> GaitResponse:
        """Reads a run directory's.

        Raises:
            NoResponse: there is none, or of another version.
        """
        path = run_dir / FILE
        command = f"omniperception gait run={run_dir} what=response"
        if not path.is_file():
            raise NoResponse(f"{run_dir} has no measured response of its gait ({FILE}); measure it: {command}")
        given = json.loads(path.read_text())
        if given.pop("version", None) != VERSION:
            raise NoResponse(f"{path} is of another version of this program; measure it again: {command}")
        conditions = {
            name: ConditionResponse(**{**own, "axes": {a: AxisResponse(**one) for a, one in own["axes"].items()}})
            for name, own in given.pop("conditions").items()
        }
        cycles = tuple(Cycle(**one) for one in given.pop("cycles"))
        return cls(**given, conditions=conditions, cycles=cycles)
