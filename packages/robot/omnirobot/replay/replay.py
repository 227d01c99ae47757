"""A policy on a recording, open loop: what it would have seen and asked for, whatever the robot then did."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from omnirobot.common.figures import new_figure
from omnirobot.drive.control import Control
from omnirobot.drive.machine import Mode, Request
from omnirobot.drive.operator import Operator
from omnirobot.drive.recording import SECTORS, Step, levelled, nearest_by_sector
from omnirobot.replay.bags import Event
from omnirobot.runtime import DeployError, ExportedPolicy
from omnirobot.runtime.go2 import MOTORS
from omnirobot.wire.clouds import Frame, FrameCutter, Points
from omnirobot.wire.messages import Remote

VIEWS = 4
"""Frames that are drawn from above."""


@dataclass(frozen=True)
class Replayed:
    """A policy's steps on a recording.

    Attributes:
        steps: each of them.
        lidar: status of the LiDAR at each, as the policy judged it.
        recorded: (steps, 12) rad, targets of the recording, in the motors' order; nan where it has none.
        counts: what limits and frames have counted, by name.
    """

    steps: list[Step]
    lidar: list[str]
    recorded: np.ndarray
    counts: dict[str, int]

    @property
    def stops(self) -> list[Step]:
        """Steps at which the policy has stopped."""
        return [step for step in self.steps if step.stopped]

    def targets(self) -> np.ndarray:
        """(steps, 12) rad, in the motors' order; nan where the policy has stopped."""
        nothing = np.full(len(MOTORS), np.nan)
        return np.array([nothing if step.targets is None else step.targets for step in self.steps])

    def frames(self) -> list[Step]:
        """Steps with a new frame."""
        return [step for step in self.steps if step.seen is not None]

    def __str__(self) -> str:
        frames, seconds = self.frames(), self.steps[-1].time_s - self.steps[0].time_s
        hits = [int(step.seen.any(axis=1).sum()) for step in frames if step.seen is not None]
        lines = [f"{len(self.steps)} steps in {seconds:.1f} s, {len(frames)} frames"]
        if hits:
            lines[0] += f" of {min(hits)} to {max(hits)} points"
        lines += [f"stopped at {step.time_s:.2f} s: {step.stopped}" for step in self.stops[:3]]
        if len(self.stops) > 3:
            lines.append(f"... and {len(self.stops) - 3} times more")
        off = abs(self.targets() - self.recorded)
        if np.isfinite(off).any():
            worst = float(np.nanmax(off))
            lines.append(f"targets differ from the recorded ones by {worst:.3g} rad at most")
        lines.append(", ".join(f"{value} {name}" for name, value in self.counts.items() if value) or "no limit acted")
        return "\n".join(lines)


class _Recorded(Operator):
    """Stands in for the robot, its LiDAR and its operator."""

    def __init__(self, period_s: float | None, command: np.ndarray | None) -> None:
        self.state: np.ndarray | None = None
        self.command = np.zeros(3) if command is None else command
        self.received: list[Points] = []
        self._frames: list[Frame] = []
        self._cutter = None if period_s is None else FrameCutter(period_s)

    def take(self, points: Points, now: float) -> None:
        """Points as they came."""
        if self._cutter is not None:
            self._frames += self._cutter.add(points, now)

    def newest(self) -> np.ndarray | None:
        return self.state

    def new(self) -> list[Frame]:
        frames, self._frames = self._frames, []
        return frames

    def counts(self) -> dict[str, int]:
        """What went wrong with points, by name."""
        return {} if self._cutter is None else self._cutter.counts()

    def poll(self, now: float, remote: Remote, pose: np.ndarray) -> tuple[np.ndarray, list[Request]]:
        return self.command, []


class _Link:
    """The guard's end: its mode, as recorded; the rest leads nowhere."""

    def __init__(self) -> None:
        self.mode, self.reason = Mode.POLICY, ""

    def poll(self) -> None:
        """The recording says the mode."""

    def ask(self, request: Request) -> None:
        """Nobody is asked."""

    def send_targets(self, targets: np.ndarray) -> None:
        """Nobody follows."""


class _Steps:
    """Takes down what Control does."""

    def __init__(self) -> None:
        self.steps: list[Step] = []

    def points(self, now: float, points: Points) -> None:
        """They are known."""

    def step(self, step: Step) -> None:
        self.steps.append(step)


def replay(policy: ExportedPolicy, events: Iterable[Event], command: np.ndarray | None = None) -> Replayed:
    """Runs a policy on what a robot has heard.

    Steps are due once per control period, and made when a state comes. The policy begins when the recorded guard's mode
    says so, or at once where no mode is recorded.

    Args:
        policy: with limits.
        events: in order of time.
        command: (3,) in place of the recorded ones.

    Raises:
        DeployError: there is no state in the recording, or the policy moves another robot.
    """
    described = policy.description
    sees = described.perception is not None and described.lidar is not None
    ends = _Recorded(described.lidar.period_s if sees and described.lidar is not None else None, command)
    link, taken = _Link(), _Steps()
    control = Control(policy, ends, ends if sees else None, ends, link, taken)
    recorded: list[np.ndarray] = []
    lidar: list[str] = []
    period, due = described.control_period_s, -np.inf
    for event in events:
        if event.points is not None:
            ends.take(event.points, event.time_s)
        if event.command is not None and command is None:
            ends.command = event.command
        if event.mode is not None:
            link.mode = Mode(event.mode.partition(":")[0])
        if event.targets is not None and recorded:
            recorded[-1] = event.targets
        if event.state is None or event.time_s < due - period / 2:
            continue
        due = max(due + period, event.time_s - period) if np.isfinite(due) else event.time_s + period
        ends.state = event.state
        control.step(event.time_s)
        recorded.append(np.full(len(MOTORS), np.nan))
        lidar.append(str(policy.safety.lidar_status) if policy.safety is not None else "fresh")
    if not taken.steps:
        raise DeployError("the recording holds no state of the robot")
    counts = ({} if policy.safety is None else dict(policy.safety.counts)) | ends.counts()
    return Replayed(taken.steps, lidar, np.array(recorded), counts)


def draw(replayed: Replayed, policy: ExportedPolicy, path: Path) -> None:
    """A picture: frames from above with what is near by sector, commands, hits, and joint targets over time."""
    figure = new_figure(14.0, 11.0)
    grid = figure.add_gridspec(3, VIEWS, height_ratios=(1.3, 1.0, 1.3))
    frames = replayed.frames()
    frames = [step for step in frames if step.mode.startswith(Mode.POLICY)] or frames
    chosen = np.unique(np.linspace(0, len(frames) - 1, VIEWS).astype(int)) if frames else np.zeros(0, int)
    for k in range(VIEWS):
        axes = figure.add_subplot(grid[0, k])
        if k < len(chosen):
            _draw_view(axes, frames[chosen[k]], policy)
        else:
            axes.set_axis_off()
    times = np.array([step.time_s for step in replayed.steps])
    _draw_commands(figure.add_subplot(grid[1, : VIEWS // 2]), times, replayed)
    _draw_hits(figure.add_subplot(grid[1, VIEWS // 2 :]), replayed.frames(), times, replayed)
    for k, joint in enumerate(("hip", "thigh", "calf")):
        axes = figure.add_subplot(grid[2, k])
        _draw_joint(axes, times, replayed, joint)
    _draw_error(figure.add_subplot(grid[2, 3]), times, replayed)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90)


def _draw_view(axes, step: Step, policy: ExportedPolicy) -> None:
    """Left is up: x ahead points to the right."""
    lidar = policy.description.lidar
    assert lidar is not None and step.seen is not None
    quat = step.state["imu_state"]["quaternion"].astype(float)
    points = levelled(step.seen[step.seen.any(axis=1)], quat, lidar.mount_pos, lidar.mount_quat)
    shown = axes.scatter(points[:, 0], points[:, 1], c=points[:, 2], s=2, cmap="viridis", vmin=-0.4, vmax=1.0)
    nearest = nearest_by_sector(step.seen, quat, lidar.mount_pos, lidar.mount_quat)
    edges = -np.pi + 2 * np.pi / SECTORS * np.arange(SECTORS + 1)
    for k in np.flatnonzero(np.isfinite(nearest)):
        arc = np.linspace(edges[k], edges[k + 1], 5)
        axes.plot(nearest[k] * np.cos(arc), nearest[k] * np.sin(arc), color="tab:red", linewidth=1.2)
    vx, vy = step.command[:2]
    axes.annotate("", (vx, vy), (0, 0), arrowprops={"arrowstyle": "->", "color": "tab:green", "linewidth": 2})
    axes.set(
        xlim=(-4, 4), ylim=(-4, 4), aspect="equal", title=f"{step.time_s:.1f} s", xlabel="x ahead, m", ylabel="y, m"
    )
    axes.figure.colorbar(shown, ax=axes, label="height over base, m", location="bottom", shrink=0.8)


def _draw_commands(axes, times: np.ndarray, replayed: Replayed) -> None:
    commands = np.array([step.command for step in replayed.steps])
    for k, label in enumerate(("v_x, m/s", "v_y, m/s", "yaw rate, rad/s")):
        axes.plot(times, commands[:, k], label=label)
    walking = np.array([step.mode.startswith(Mode.POLICY) for step in replayed.steps])
    axes.fill_between(times, 0, 1, where=walking, transform=axes.get_xaxis_transform(), color="tab:green", alpha=0.1)
    axes.set(title="command (green: the policy moves the robot)", xlabel="s")
    axes.legend(loc="upper right", fontsize="small")


def _draw_hits(axes, frames: list[Step], times: np.ndarray, replayed: Replayed) -> None:
    hits = [int(step.seen.any(axis=1).sum()) for step in frames if step.seen is not None]
    axes.plot([step.time_s for step in frames], hits, ".", label=f"points of {len(frames)} frames")
    for kind, color in (("slowing", "tab:orange"), ("stopped", "tab:red")):
        is_so = np.array([lidar == kind for lidar in replayed.lidar])
        if is_so.any():
            look = {"color": color, "alpha": 0.3, "label": f"lidar: {kind}"}
            axes.fill_between(times, 0, 1, where=is_so, transform=axes.get_xaxis_transform(), **look)
    for k, step in enumerate(replayed.stops[:20]):
        axes.axvline(step.time_s, color="black", linewidth=0.8, label=None if k else "the policy stops")
    axes.set(title="what it saw", xlabel="s", ylabel="points", ylim=(0, None))
    axes.legend(loc="lower right", fontsize="small")


def _draw_joint(axes, times: np.ndarray, replayed: Replayed, joint: str) -> None:
    """Both front legs: what the policy asks for, and where the joint was."""
    targets = replayed.targets()
    positions = np.array([step.state["motor_state"]["q"][:12] for step in replayed.steps])
    for leg, color in (("FL", "tab:blue"), ("FR", "tab:orange")):
        k = MOTORS.index(f"{leg}_{joint}_joint")
        axes.plot(times, targets[:, k], color=color, linewidth=1.0, label=f"{leg}, asked for")
        axes.plot(times, positions[:, k], color=color, linewidth=0.8, linestyle=":", label=f"{leg}, was")
    axes.set(title=f"{joint} joints, rad", xlabel="s")
    axes.legend(loc="upper right", fontsize="xx-small", ncols=2)


def _draw_error(axes, times: np.ndarray, replayed: Replayed) -> None:
    off = abs(replayed.targets() - replayed.recorded)
    if np.isfinite(off).any():
        axes.plot(times, np.nan_to_num(off, nan=np.nan).max(1), color="tab:purple")
        axes.set(title="largest difference to\nrecorded targets, rad", xlabel="s")
    else:
        positions = np.array([step.state["motor_state"]["q"][:12] for step in replayed.steps])
        axes.plot(times, abs(replayed.targets() - positions).max(1), color="tab:purple")
        axes.set(title="largest distance of a\ntarget from its joint, rad", xlabel="s")
