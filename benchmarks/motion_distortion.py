"""What de-skewing by IMU leaves of motion distortion on a walking robot, by speed and turning.

    python -m benchmarks.motion_distortion run=pretrained/gait

A Go2 walks under MuJoCo on its trained gait, with a Mid-360 at its head, in the middle of a room. Every ray is cast
from where the sensor is at the ray's own time, of poses at every physics step with lines between them. The points of a
frame are then brought to the frame's end by what a robot knows of its motion, and compared with where they are:

- nothing: points as if all were measured at the frame's end
- gyroscope: turned by the true rotation since each point's time (an ideal IMU)
- gyroscope, biased: the same with a constant bias about the vertical
- gyroscope and velocity: the biased one, and moved by a constant velocity, the frame's mean plus an error

Errors are distances in the room, mm; a treatment is judged at the frame's end, where policies are shown the points.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from pathlib import Path

import torch

from benchmarks.harness.table import Table, about, report
from omniperception import build, config
from omniperception.cli import Command, argument
from omniperception.common.figures import new_figure
from omniperception.common.rotations import multiply, rotate, yaw_quat
from omniperception.config import ConfigError
from omniperception.env.mdp.commands import VelocityCommand
from omniperception.learning import CheckpointError
from omniperception.lidar import DEVICES
from omniperception.lidar.sensor import quat_from_rpy

ROOM = (4.0, 4.0, 3.0)
"""Half length, half width and height, metres, about the robot; it stands on the floor."""
EVERY = 11
"""Of a frame's shots, those that are cast."""
SETTLES_S = 3.0
"""Time before the first frame."""
TREATMENTS = ("nothing", "gyroscope", "gyroscope, biased", "gyroscope and velocity")


@dataclass(frozen=True)
class Walk:
    """Poses of a robot's sensor.

    Attributes:
        pos: m, (T, 3) float64.
        quat: (w, x, y, z), (T, 4) float64.
        dt: Between poses, s.
        velocity: What the robot did on average: m/s ahead and rad/s, base frame.
    """

    pos: torch.Tensor
    quat: torch.Tensor
    dt: float
    velocity: tuple[float, float]


@dataclass(frozen=True)
class Scan:
    """Rays of every frame.

    Attributes:
        directions: Unit vectors in the sensor frame, (N, 3).
        times_s: Since the frame began, (N,).
        period_s: Of a frame.
    """

    directions: torch.Tensor
    times_s: torch.Tensor
    period_s: float


def poses_at(walk: Walk, times_s: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Positions (N, 3) and quaternions (N, 4) at times since the walk began, with lines between what is known."""
    at = (times_s / walk.dt).clamp(0.0, len(walk.pos) - 1.0)
    k = at.long().clamp(max=len(walk.pos) - 2)
    part = (at - k)[:, None]
    first, second = walk.quat[k], walk.quat[k + 1]
    second = torch.where((first * second).sum(1, keepdim=True) < 0.0, -second, second)
    quat = torch.nn.functional.normalize(torch.lerp(first, second, part), dim=1)
    return torch.lerp(walk.pos[k], walk.pos[k + 1], part), quat


def to_walls(start: torch.Tensor, direction: torch.Tensor, middle: torch.Tensor) -> torch.Tensor:
    """Distance (m) from starts (N, 3) inside the room around `middle` (x, y) to its walls, floor or ceiling."""
    half = torch.tensor(ROOM[:2], dtype=start.dtype)
    high = torch.cat((middle + half, torch.tensor(ROOM[2:], dtype=start.dtype)))
    low = torch.cat((middle - half, torch.zeros(1, dtype=start.dtype)))
    ahead = torch.where(direction > 0.0, high - start, low - start) / direction
    return ahead.where(direction != 0.0, torch.inf).amin(dim=1)


def left_over(
    walk: Walk, scan: Scan, begin_s: float, gyro_bias: float, velocity_error: float
) -> dict[str, torch.Tensor]:
    """Distances (m) between de-skewed points and where they are, (N,) by treatment, of the frame at `begin_s`.

    Args:
        walk: With the whole frame in it.
        scan: The rays.
        begin_s: When the frame begins.
        gyro_bias: rad/s about the vertical.
        velocity_error: m/s along the world's x and y axes each.
    """
    pos, quat = poses_at(walk, begin_s + scan.times_s)
    ends = torch.tensor([begin_s, begin_s + scan.period_s], dtype=torch.float64)
    end_pos, end_quat = poses_at(walk, ends)
    direction = rotate(quat, scan.directions)
    offset = to_walls(pos, direction, end_pos[1, :2])[:, None] * direction
    point, age = pos + offset, scan.period_s - scan.times_s
    untouched = rotate(multiply(end_quat[1:], _conjugate(quat)), offset)
    biased = rotate(yaw_quat(-gyro_bias * age), offset)
    velocity = (end_pos[1] - end_pos[0]) / scan.period_s
    velocity = velocity + torch.tensor([velocity_error, velocity_error, 0.0], dtype=torch.float64)
    estimates = (untouched, offset, biased, biased - age[:, None] * velocity)
    return {
        name: (end_pos[1] + estimate - point).norm(dim=1) for name, estimate in zip(TREATMENTS, estimates, strict=True)
    }


def _conjugate(quat: torch.Tensor) -> torch.Tensor:
    return quat * torch.tensor([1.0, -1.0, -1.0, -1.0], dtype=quat.dtype)


def whole_scan(device: str) -> Scan:
    """Some shots of a device's first frame."""
    spec = DEVICES[device]
    pattern = spec.pattern()
    rows = torch.arange(0, pattern.points_per_frame(spec.period_s), EVERY)
    return Scan(pattern.directions_s[rows].double(), rows.double() / spec.points_per_second, spec.period_s)


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """The command line."""

    run: str = argument("pretrained/gait", "run directory of a gait that follows velocity commands")
    speeds: tuple[float, ...] = argument((0.0, 0.5, 1.0, 1.5, 2.0), "m/s ahead")
    turns: tuple[float, ...] = argument((0.0, 0.75, 1.5), "rad/s to the left")
    frames: int = argument(30, "frames of each walk", least=1)
    gyro_bias: float = argument(0.02, "rad/s")
    velocity_error: float = argument(0.05, "m/s along both horizontal axes")
    device: str = argument("mid360", "sensor", choices=tuple(DEVICES))
    mount: str = argument("head", "which of the robot's mounts")
    out: Path = argument(Path("outputs/motion_distortion"), "folder of the results")


def walks(given: Arguments, overrides: list[str]) -> list[Walk]:
    """A walk of the trained gait for each speed and turn, after it has settled."""
    run_dir = config.find_run(given.run)
    commands = torch.tensor(list(product(given.speeds, given.turns)))
    free = ["scenario=walk", "randomization=none", "randomization.latency_s=[0,0]", f"num_envs={len(commands)}"]
    run = build.assemble(config.load(run_dir, [*free, *overrides]))
    trained = build.load_policy(run, run_dir)
    env, policy = trained.env, trained.policy
    if not isinstance(env.command, VelocityCommand):
        raise ConfigError(f"run={given.run} follows no velocity commands; give one that does, such as pretrained/gait")
    if given.mount not in env.robot.mounts:
        raise ConfigError(f"mount={given.mount} is unknown; known: {', '.join(env.robot.mounts)}")
    wanted = torch.cat((commands[:, :1], torch.zeros(len(commands), 1), commands[:, 1:]), 1).to(env.device)
    poses, velocities = [], []
    with torch.no_grad():
        for step in range(round((SETTLES_S + given.frames * DEVICES[given.device].period_s) / env.control_dt) + 1):
            env.command.value.copy_(wanted)
            env.command.time_left.fill_(torch.inf)
            env.observations["command"].copy_(wanted)
            _, _, done, _ = env.step(policy(env.get_observations()))
            if bool(done.any()):
                raise ConfigError(
                    f"run={given.run} fell or ended its episode at {commands[done.cpu().bool()].tolist()}"
                )
            if step * env.control_dt >= SETTLES_S:
                poses.append(env.sim.recorded_states()[0][:, :, :7].to("cpu", torch.float64, copy=True))
                k = env.state.kinematics
                velocities.append(torch.cat((k.base_lin_vel_yaw[:, :1], k.base_ang_vel_b[:, 2:]), 1).cpu())
    base, mean = torch.cat(poses, dim=1), torch.stack(velocities).mean(0)
    mount = env.robot.mounts[given.mount]
    quat = torch.tensor(quat_from_rpy(*mount.rpy), dtype=torch.float64).expand(base.shape[1], 4)
    at = torch.tensor(tuple(mount.pos), dtype=torch.float64)
    dt = env.control_dt / poses[0].shape[1]
    return [
        Walk(one[:, :3] + rotate(one[:, 3:], at), multiply(one[:, 3:], quat), dt, (float(v[0]), float(v[1])))
        for one, v in zip(base, mean, strict=True)
    ]


def rows_of(given: Arguments, walked: list[Walk]) -> list[dict]:
    """Mean and 95 % errors in mm for each walk."""
    scan, rows = whole_scan(given.device), []
    for (speed, turn), walk in zip(product(given.speeds, given.turns), walked, strict=True):
        frames = [
            left_over(walk, scan, k * scan.period_s, given.gyro_bias, given.velocity_error) for k in range(given.frames)
        ]
        row: dict[str, object] = {
            "command: m/s": speed,
            "rad/s": turn,
            "walked: m/s": walk.velocity[0],
            "turned: rad/s": walk.velocity[1],
        }
        for name in TREATMENTS:
            all_of = torch.cat([frame[name] for frame in frames])
            row[f"{name}: mean, mm"] = 1e3 * float(all_of.mean())
            row[f"{name}: 95 %"] = 1e3 * float(all_of.quantile(0.95))
        rows.append(row)
    return rows


def draw(rows: list[dict], given: Arguments, path: Path) -> None:
    """A panel for each turn: what is left over the speed."""
    figure = new_figure(3.0 * len(given.turns), 3.0)
    axes = figure.subplots(1, len(given.turns), squeeze=False, sharey=True)[0]
    for axis, turn in zip(axes, given.turns, strict=True):
        own = [row for row in rows if row["rad/s"] == turn]
        for name, style in zip(TREATMENTS, ("o-", "s-", "^--", "d-"), strict=True):
            axis.plot([r["walked: m/s"] for r in own], [r[f"{name}: mean, mm"] for r in own], style, label=name, ms=4)
        axis.set_title(f"{turn:g} rad/s commanded", fontsize=9)
        axis.set_xlabel("walked speed (m/s)", fontsize=8)
        axis.grid(alpha=0.3)
        axis.tick_params(labelsize=7)
    axes[0].set_ylabel(f"mean error (mm), {given.frames} frames", fontsize=8)
    axes[0].set_ylim(bottom=0.0)
    axes[0].legend(fontsize=7)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)


def main(given: Arguments, overrides: list[str]) -> None:
    """Walks, measures, prints, draws."""
    rows = rows_of(given, walks(given, overrides))
    notes = [f"gyroscope's bias {given.gyro_bias:g} rad/s, velocity off by {given.velocity_error:g} m/s on both axes"]
    title = f"{given.device} on {given.run}: what is left of motion distortion"
    report([Table.of("motion", title, rows, notes)], about(1, run=given.run, overrides=overrides), given.out)
    draw(rows, given, given.out / "motion_distortion.png")
    print(f"wrote {given.out / 'motion_distortion.png'}")


command = Command(main, Arguments, __doc__, "of the run's configuration", (CheckpointError, ValueError))

if __name__ == "__main__":
    command()
