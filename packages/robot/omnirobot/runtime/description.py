"""Description of an exported policy: names, scales and rates, as written beside its network in policy.json."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path

from omnirobot.common.coverage import NUM_SECTORS
from omnirobot.common.errors import UserError, naming
from omnirobot.common.shell import command_line

FORMAT = "omniperception-policy"
VERSION = 9
FILE = "policy.json"
FINGERPRINT = "omniperception-description"
"""Key of the ONNX file's metadata: fingerprint of the description that belongs to it."""


class DeployError(UserError, ValueError):
    """An exported policy cannot be read or was given something else than it expects; the message is one line."""


def export_line(folder: Path) -> str:
    """The command that writes an exported policy there: of the run that the folder lies in, or of the newest."""
    of_run = [f"run={folder.parent}"] if (folder.parent / "config.yaml").is_file() else []
    return command_line("export", *of_run, f"out={folder}")


@dataclass(frozen=True)
class Joints:
    """Joints in the order of joint states, actions and targets.

    Attributes:
        names: of the joints.
        default_pos: default pose, rad.
        action_scale: joint target = default_pos + action_scale * action, rad; of all joints, or of each.
        action_limit: actions are clipped to +- this.
        kp: gain of the position controller that follows the targets, N m / rad, likewise.
        kd: its damping, N m s / rad, likewise.
        torque_limits: N m.
        lower: joint limits, rad; None without; the runtime clips targets to them, training does not.
        upper: rad.
        locked: rad (m of a slide), by joint: where the robot has to hold others, which the policy does not drive.
    """

    names: Sequence[str]
    default_pos: Sequence[float]
    action_scale: float | Sequence[float]
    action_limit: float
    kp: float | Sequence[float]
    kd: float | Sequence[float]
    torque_limits: Sequence[float]
    lower: Sequence[float | None]
    upper: Sequence[float | None]
    locked: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Term:
    """A quantity in an observation group.

    Attributes:
        quantity: one of `omnirobot.runtime.runtime.QUANTITIES`.
        size: numbers.
        scale: factor.
        frequency: of the clock (Hz), of gait_phase alone.
        rest_s: how long (s) the command has to be to stand until the clock rests.
    """

    quantity: str
    size: int
    scale: float = 1.0
    frequency: float | None = None
    rest_s: float = 0.0


@dataclass(frozen=True)
class Stepping:
    """A motion to which the policy's targets are added: the robot steps on the spot.

    Attributes:
        frequency: of the clock (Hz), which starts with the policy.
        rest_s: how long (s) the command has to be to stand until the motion rests.
        offsets: of the joint targets, rad, a row of numbers for each of equal parts of the clock's period; in between
            they are interpolated linearly.
    """

    frequency: float
    rest_s: float
    offsets: Sequence[Sequence[float]]


@dataclass(frozen=True)
class Group:
    """Terms concatenated in order, `history` control steps of them, newest last."""

    name: str
    history: int
    terms: Sequence[Term]

    @property
    def width(self) -> int:
        """Numbers of one control step."""
        return sum(term.size for term in self.terms)


@dataclass(frozen=True)
class Turn:
    """A joint between the base and the link that carries the LiDAR, the one nearer to the base first.

    Attributes:
        joint: its name, one of `Joints.names`.
        quat: orientation of its link in the one before at the angle `rest`, (w, x, y, z).
        axis: that it turns about, in its link's frame, of length 1.
        rest: rad.
    """

    joint: str
    quat: Sequence[float]
    axis: Sequence[float]
    rest: float


@dataclass(frozen=True)
class Lidar:
    """The sensor that the policy was trained with.

    Attributes:
        period_s: seconds between two frames.
        mount_pos: of the sensor in the frame of the link that carries it, m.
        mount_quat: of the sensor in that frame, (w, x, y, z).
        min_range: nearest distance that it measures, m; nearer points are misses.
        max_range: points beyond are misses, m.
        num_rays: rays of a frame that training used.
        points_per_frame: points that the device measures in a frame.
        keep_every: training used every keep_every-th point of a frame; None where it chose otherwise.
        least_bins: answered bins of elevation that cover each azimuth sector, see `coverage`; 0: it always counts.
        carried_by: the joints that turn the link that carries it against the base; none: the base carries it.
    """

    period_s: float
    mount_pos: Sequence[float]
    mount_quat: Sequence[float]
    min_range: float
    max_range: float
    num_rays: int
    points_per_frame: int
    keep_every: int | None
    least_bins: Sequence[int] = (0,) * NUM_SECTORS
    carried_by: Sequence[Turn] = ()


@dataclass(frozen=True)
class Perception:
    """Preprocessing from frames to the network's input.

    Attributes:
        history: frames that the network sees.
        num_points: rows of a frame, sampled points and the base's motion.
        sampler: kind and parameters of the sampler, see `omnirobot.runtime.sampling.make_sampler`.
        base_motion: whether a frame's last row is how the base moved since the frame before.
        times: whether its last three rows are those of `odometry.TimedOdometry`, which take the frame's age.
    """

    history: int
    num_points: int
    sampler: Mapping
    base_motion: bool = False
    times: bool = False


@dataclass(frozen=True)
class Description:
    """All that a robot needs besides the network's weights.

    Attributes:
        control_period_s: seconds between two control steps.
        joints: names, gains and limits.
        observations: groups in the order in which they are concatenated.
        command: range of each commanded value that training drew from, by name (m/s, rad/s).
        command_acceleration: how fast (m/s^2, rad/s^2) the command that is observed follows the one given; None: at
            once.
        stepping: added to the targets; None: nothing is.
        lidar: the sensor; None for a blind policy.
        perception: what is made of its frames; None for a blind policy.
        estimated: quantities of the robot's state that the network gives in the output `estimate` and nobody measures:
            base_lin_vel (m/s, base frame), or none.
        max_acceleration: at most as fast (m/s^2) changes the velocity that the network gives in its last output `asked`
            and reads in its last input `last_asked` at the next step, 0 at the first; None: it has neither.
        turns: whether that velocity has a yaw rate (rad/s) besides v_x and v_y.
        files: name of the network's file by kind, "onnx" or "torchscript".
        checksums: SHA-256 of each of these files.
        provenance: run, checkpoint, iteration, date and versions.
    """

    control_period_s: float
    joints: Joints
    observations: Sequence[Group]
    command: Mapping[str, Sequence[float]]
    command_acceleration: Sequence[float] | None = None
    stepping: Stepping | None = None
    lidar: Lidar | None = None
    perception: Perception | None = None
    estimated: Sequence[str] = ()
    max_acceleration: float | None = None
    turns: bool = False
    files: Mapping[str, str] = field(default_factory=dict)
    checksums: Mapping[str, str] = field(default_factory=dict)
    provenance: Mapping = field(default_factory=dict)

    @property
    def observation_size(self) -> int:
        """Numbers of the network's flat observation."""
        return sum(group.history * group.width for group in self.observations)

    @property
    def inputs(self) -> dict[str, tuple[int, ...]]:
        """Shape of each input of the network without the batch: float32, `frame_count` int64."""
        shapes: dict[str, tuple[int, ...]] = {"observations": (self.observation_size,)}
        if self.perception is not None:
            shapes["frames"] = (self.perception.history, self.perception.num_points, 3)
            shapes["frame_count"] = (1,)
        if self.max_acceleration is not None:
            shapes["last_asked"] = (3,) if self.turns else (2,)
        return shapes

    @property
    def outputs(self) -> dict[str, int]:
        """Numbers of each output of the network, in their order."""
        sizes = {"actions": len(self.joints.names)}
        if self.estimated:
            sizes["estimate"] = 3
        if self.max_acceleration is not None:
            sizes["asked"] = 3 if self.turns else 2
        return sizes

    @property
    def fingerprint(self) -> str:
        """SHA-256 of everything that the network depends on: all but its files and where it comes from."""
        content = {key: value for key, value in asdict(self).items() if key not in ("files", "checksums", "provenance")}
        return hashlib.sha256(json.dumps(content, sort_keys=True, allow_nan=False).encode()).hexdigest()

    def write(self, folder: Path) -> None:
        """Write policy.json."""
        shapes = {name: ["batch", *shape] for name, shape in self.inputs.items()}
        outputs = {name: ["batch", size] for name, size in self.outputs.items()}
        network = {"inputs": shapes, "outputs": outputs}
        content = {"format": FORMAT, "version": VERSION, "network": network, **asdict(self)}
        with naming(folder / FILE):
            (folder / FILE).write_text(json.dumps(content, indent=2, allow_nan=False) + "\n")

    @classmethod
    def read(cls, folder: Path) -> Description:
        """Read policy.json from a folder."""
        path = Path(folder) / FILE
        if not path.is_file():
            raise DeployError(f"{folder} holds no exported policy ({FILE}); write it: {export_line(folder)}")
        try:
            content = json.loads(path.read_text())
        except ValueError as error:
            raise DeployError(f"{path} is no JSON ({error}); export the policy again") from None
        if not isinstance(content, dict) or content.get("format") != FORMAT:
            raise DeployError(f"{path} describes no exported policy: it has no format '{FORMAT}'")
        if content.get("version") != VERSION:
            raise DeployError(
                f"{path} has format version {content.get('version')}, this program reads {VERSION}; export again"
            )
        try:
            return cls._of(content)
        except (KeyError, TypeError) as error:
            raise DeployError(f"{path} is incomplete ({error}); export the policy again") from None

    @classmethod
    def _of(cls, content: Mapping) -> Description:
        parts = {item.name: content[item.name] for item in fields(cls)}
        groups = [
            Group(group["name"], group["history"], tuple(Term(**term) for term in group["terms"]))
            for group in parts.pop("observations")
        ]
        parts["joints"] = Joints(**parts["joints"])
        if parts["lidar"] is not None:
            turns = tuple(Turn(**turn) for turn in parts["lidar"]["carried_by"])
            parts["lidar"] = {**parts["lidar"], "carried_by": turns}
        for name, kind in (("lidar", Lidar), ("perception", Perception), ("stepping", Stepping)):
            parts[name] = kind(**parts[name]) if parts[name] is not None else None
        return cls(observations=tuple(groups), **parts)


def checksum(path: Path) -> str:
    """SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()
