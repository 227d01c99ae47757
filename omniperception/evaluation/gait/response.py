"""How a gait answers to asked velocities: random steps of them in full physics, and its cycle at a few."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import torch

from omniperception.avoidance.velocity import COMMAND
from omniperception.common.rotations import matrix_of, yaw_quat
from omniperception.common.vectors import moved_towards
from omniperception.env.env import OmniEnv, Policy
from omniperception.env.mdp.commands import VelocityCommand
from omniperception.sim.response import AXES, Cycle
from omnirobot.common.errors import ConfigError
from omnirobot.common.figures import new_figure, save_figure

ACCELERATION = (6.0, 8.0)
"""How fast (m/s^2, rad/s^2) the asked velocity changes at most: as of policies that add V_avoid to their command."""
COMMANDS = (
    (0.0, 0.0, 0.0),
    (1.0, 0.0, 0.0),
    (-0.5, 0.0, 0.0),
    (0.0, 0.75, 0.0),
    (0.0, -0.75, 0.0),
    (0.0, 0.0, 1.0),
    (0.0, 0.0, -1.0),
)
"""v_x, v_y (m/s) and yaw rate (rad/s) whose cycles are measured, as far as the gait is for them."""
_AHEAD = 1
COPIES = 8
"""Robots that each of them is the mean of."""
STEP_S, SETTLES_S, CYCLES_S = 1.0, 3.0, 4.0
"""Time (s) between two targets, before a cycle is measured, and for which it is."""
PHASES, HARMONICS = 16, 6
"""Poses of a cycle, and harmonics of the curves that they are read from."""
JUMP = 0.5
"""Width (m/s) of the classes of jumps."""
_MODES = ((1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (1, 1, 0), (1, 1, 1), (1, 1, 1), (0, 0, 0))
"""Which axes a target has, each as likely as another."""

Ranges = Mapping[str, tuple[float, float]]
"""(low, high) by axis, m/s and rad/s."""


@dataclass(frozen=True)
class Recording:
    """n robots that were asked for new velocities every STEP_S, T control steps of `dt` (s).

    Attributes:
        asked: (T, n, 3) m/s, m/s, rad/s: asked for during each step, as fast as ACCELERATION lets it change.
        velocity: (T, n, 3) at the step's end, yaw-aligned frame.
        pose: (T, n, 3) height of the base above the ground (m), roll, pitch (rad), likewise.
        phase: (T, n) of the gait's clock, likewise, 0 to 1.
        done: (T, n) bool: whose episode ended in the step; what is said of its end is of the new one.
        jumps: (J,) m/s: changes of the target velocity, of robots that were walking for STEP_S.
        fell: (J,) bool: who fell before the next one.
        dt: s.
    """

    asked: torch.Tensor
    velocity: torch.Tensor
    pose: torch.Tensor
    phase: torch.Tensor
    done: torch.Tensor
    jumps: torch.Tensor
    fell: torch.Tensor
    dt: float


def driven(env: OmniEnv, policy: Policy, target: Callable[[int], torch.Tensor], steps: int) -> Iterator[torch.Tensor]:
    """Lets robots follow targets (num_envs, 3), by number of the step; yields what was asked for, after each step.

    Raises:
        ConfigError: the policy is not told a velocity command as it is.
    """
    if not isinstance(env.command, VelocityCommand) or not env.observes_command:
        raise ConfigError(
            f"what=response needs a run that follows velocity commands and observes them in a group '{COMMAND}' that"
            f" holds the command alone, trained with observations.groups.{COMMAND}.history=1"
        )
    linear, angular = (most * env.control_dt for most in ACCELERATION)
    asked = torch.zeros(env.num_envs, 3, device=env.device)
    for step in range(steps):
        wanted = target(step).to(env.device)
        env.command.value.copy_(wanted)  # for the clock, which rests once the command has been to stand
        env.command.time_left.fill_(torch.inf)
        turn = (wanted - asked)[:, 2:].clamp(-angular, angular)
        asked = torch.cat((moved_towards(asked[:, :2], wanted[:, :2], linear), asked[:, 2:] + turn), 1)
        observations = env.get_observations().clone(recurse=False)
        observations[COMMAND] = asked
        with torch.no_grad():
            env.step(policy(observations))
        yield asked
        asked = torch.where(env.done[:, None], 0.0, asked)


def record(env: OmniEnv, policy: Policy, ranges: Ranges, seconds: int) -> Recording:
    """Asks robots on flat ground for velocities within the ranges, one axis at a time and together.

    Args:
        env: freshly built with `EnvConfig.trials` and velocity commands, on flat ground; longer episodes.
        policy: from observations to actions.
        ranges: what may be asked for.
        seconds: for how long.
    """
    every, generator = round(STEP_S / env.control_dt), torch.Generator().manual_seed(0)
    low, high = torch.tensor([ranges[axis] for axis in AXES]).T
    aim, jumped = torch.zeros(env.num_envs, 3), torch.zeros(env.num_envs)
    calm, ended, fallen = torch.zeros(3, env.num_envs, dtype=torch.bool)
    jumps, falls, rows = [], [], []

    def target(step: int) -> torch.Tensor:
        nonlocal aim, calm, jumped
        if step % every == 0:
            modes = torch.tensor(_MODES)[torch.randint(len(_MODES), (env.num_envs,), generator=generator)]
            fresh = (low + torch.rand(env.num_envs, 3, generator=generator) * (high - low)) * modes
            jumped, calm, aim = (fresh - aim)[:, :2].norm(dim=1), ~ended & (step > 0), fresh
            ended.fill_(False)
            fallen.fill_(False)
        return aim

    for step, asked in enumerate(driven(env, policy, target, seconds * every)):
        k, done = env.state.kinematics, env.done.cpu()
        velocity = k.planar_velocity
        rows.append([one.cpu() for one in (asked, velocity, _pose(env), _phase(env))] + [done])
        ended |= done
        fallen |= done & ~env.outcomes["time_out"].cpu()
        aim = torch.where(done[:, None], 0.0, aim)
        if step % every == every - 1:
            jumps.append(jumped[calm])
            falls.append(fallen[calm])
    asked, velocity, pose, phase, over = (torch.stack(one) for one in zip(*rows, strict=True))
    return Recording(asked, velocity, pose, phase, over, torch.cat(jumps), torch.cat(falls), env.control_dt)


def cycles(env: OmniEnv, policy: Policy, ranges: Ranges) -> tuple[list[Cycle], tuple[float, float]]:
    """The cycle of each of COMMANDS, and the capsule of robots that walk ahead: radius and half length (m), as wide and
    long as they are in 95 % of the time. On a way aside feet reach further.

    Args:
        env: as of `record`, with nothing randomized; COPIES robots for each of COMMANDS.
        policy: from observations to actions.
        ranges: what may be asked for.

    Raises:
        ConfigError: all robots of a command fell.
    """
    low, high = torch.tensor([ranges[axis] for axis in AXES]).T
    wanted = torch.tensor(COMMANDS).clamp(low, high)
    steps, settles = round((SETTLES_S + CYCLES_S) / env.control_dt), round(SETTLES_S / env.control_dt)
    fell = torch.zeros(env.num_envs, dtype=torch.bool, device=env.device)
    poses, phases, extents = [], [], []
    for step, _ in enumerate(driven(env, policy, lambda _: wanted.repeat(COPIES, 1), steps)):
        fell |= env.done
        if step >= settles:
            poses.append(torch.cat((_pose(env), env.state.kinematics.joint_pos), 1).cpu().double())
            phases.append(_phase(env)[~fell][:1].cpu())  # all began together
            extents.append(reach(env).cpu())
    walked = ~fell.cpu().unflatten(0, (COPIES, -1))
    if not bool(walked.any(0).all()):
        failed = ", ".join(str(wanted[k].tolist()) for k in (~walked.any(0)).nonzero().flatten().tolist())
        raise ConfigError(f"all robots fell that were asked steadily for v_x, v_y, yaw rate = {failed}")
    share = (walked / walked.sum(0))[..., None]
    mean = (torch.stack(poses).unflatten(1, (COPIES, -1)) * share).sum(1)
    ahead = torch.stack(extents).unflatten(1, (COPIES, -1))[:, walked[:, _AHEAD], _AHEAD].flatten(0, 1)
    along, across = ahead.quantile(0.95, 0).tolist()
    found = []
    for command, curve in zip(
        wanted.tolist(), _periodic(torch.cat(phases), mean, gait_frequency(env) > 0).unbind(1), strict=True
    ):
        height, roll, pitch = curve[:, :3].T.tolist()
        found.append(Cycle(command, height, roll, pitch, curve[:, 3:].tolist()))
    return found, (across, max(along - across, 0.0))


def _periodic(phase: torch.Tensor, values: torch.Tensor, moves: bool) -> torch.Tensor:
    """(PHASES, ...) a periodic curve through values (T, ...) at phases (T,), 0 to 1; the mean where nothing moves."""
    if not moves:
        return values.mean(0, keepdim=True)
    basis, even = (_harmonics(at) for at in (phase.double(), torch.arange(PHASES, dtype=torch.float64) / PHASES))
    fitted = torch.linalg.lstsq(basis, values.flatten(1)).solution
    return (even @ fitted).unflatten(1, values.shape[1:])


def _harmonics(phase: torch.Tensor) -> torch.Tensor:
    angle = 2 * torch.pi * phase[:, None] * torch.arange(1, HARMONICS + 1)
    return torch.cat((torch.ones_like(angle[:, :1]), angle.sin(), angle.cos()), 1)


def around_cycle(recording: Recording, known: Sequence[Cycle], keep: torch.Tensor) -> tuple[float, tuple[float, float]]:
    """Standard deviations of the base's height (m), and of roll and pitch (rad), around the cycle of the command that
    is next to the asked one, in the steps (T, n) bool that count."""
    table = torch.tensor([[c.height, c.roll, c.pitch] for c in known]).transpose(1, 2)  # (commands, P, 3)
    nearest = torch.cdist(recording.asked, torch.tensor([list(c.command) for c in known])).argmin(2)
    at = (recording.phase * table.shape[1]).round().long() % table.shape[1]
    height, roll, pitch = (recording.pose - table[nearest, at])[keep].std(0, unbiased=False).tolist()
    return height, (roll, pitch)


def falls_by_jump(recording: Recording) -> list[tuple[float, float, int, int]]:
    """(low, high, jumps, falls) by size, m/s, up to the largest; see `ConditionResponse`."""
    size = (recording.jumps / JUMP).long()
    most = int(size.max()) + 1 if len(size) else 0
    jumps, falls = (torch.bincount(one, minlength=most).tolist() for one in (size, size[recording.fell]))
    return [(k * JUMP, (k + 1) * JUMP, jumps[k], falls[k]) for k in range(most)]


def reach(env: OmniEnv) -> torch.Tensor:
    """(num_envs, 2) m: how far the robot's geoms that can be touched reach from the base's origin along its x axis,
    to the front or back, and across, seen from above; but for those that begin above `robot.height`."""
    model, kinematics = env.world.model, env.state.kinematics
    own = model.body_rootid[model.geom_bodyid] == env.world.base_body
    geoms = np.flatnonzero(own & ((model.geom_conaffinity != 0) | (model.geom_contype != 0))).tolist()
    pos, mat = env.sim.geom_poses(tuple(geoms))
    bounds = torch.tensor(model.geom_aabb[geoms], dtype=torch.float32, device=env.device)
    pos = pos + (mat @ bounds[:, :3, None])[..., 0]
    to_yaw = matrix_of(yaw_quat(-kinematics.yaw))[:, None]
    offset = (to_yaw @ (pos - kinematics.base_pos_w[:, None])[..., None])[..., 0]
    half = _half_extents(model, geoms, bounds[:, 3:], to_yaw @ mat)
    low = pos[..., 2] - half[..., 2] < env.robot.height  # of a plane at 0
    return ((offset.abs() + half)[..., :2] * low[..., None]).amax(1)


def _half_extents(model: mujoco.MjModel, geoms: Sequence[int], bounds: torch.Tensor, mat: torch.Tensor) -> torch.Tensor:
    """(n, G, 3) m: half lengths of geoms along the axes of a frame in which they are turned by `mat` (n, G, 3, 3).

    Spheres and capsules are exact, others are taken as the boxes (G, 3) around them.
    """
    kinds = model.geom_type[geoms]
    round_ones = np.isin(kinds, (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE))
    radius = torch.tensor(model.geom_size[geoms, 0] * round_ones, dtype=torch.float32, device=mat.device)[:, None]
    return radius + (mat.abs() @ (bounds - radius)[..., None])[..., 0]


def _pose(env: OmniEnv) -> torch.Tensor:
    """(num_envs, 3) height (m), roll and pitch (rad) of the base."""
    x, y, z = env.state.kinematics.projected_gravity_b.unbind(1)
    return torch.stack((env.state.base_height, torch.atan2(-y, -z), torch.asin(x.clamp(-1.0, 1.0))), 1)


def gait_frequency(env: OmniEnv) -> float:
    """Of the gait's clock (Hz); 0 of a robot that has none."""
    return 0.0 if env.robot.gait is None else env.robot.gait.frequency


def _phase(env: OmniEnv) -> torch.Tensor:
    """(num_envs,) of the gait's clock, 0 to 1."""
    return gait_frequency(env) * env.state.time_s % 1.0


def draw_response(recordings: Mapping[str, tuple[Recording, torch.Tensor]], path: Path, shown_s: float = 8.0) -> None:
    """A column for each condition, a row for each axis: asked, reached and predicted velocity (T, n, 3) of a robot."""
    figure = new_figure(1.0 + 3.6 * len(recordings), 6.0)
    panels = figure.subplots(len(AXES), len(recordings), squeeze=False, sharex=True, sharey="row")
    for column, (name, (recording, predicted)) in enumerate(recordings.items()):
        robot = int(recording.done.sum(0).argmin())
        steps = min(round(shown_s / recording.dt), len(recording.asked))
        time = (torch.arange(1, steps + 1) * recording.dt).tolist()
        lines = ("asked", recording.asked, "#999999", "-"), ("reached", recording.velocity, "#35618f", "-")
        for row, axis in enumerate(AXES):
            panel = panels[row, column]
            for label, values, colour, style in (*lines, ("fitted", predicted, "#c8553d", "--")):
                shown = values[:steps, robot, row].tolist()
                panel.plot(time, shown, label=label, color=colour, linestyle=style, linewidth=1.0)
            panel.set_ylabel("yaw rate, rad/s" if axis == "yaw" else f"v_{axis}, m/s", fontsize=8)
            panel.tick_params(labelsize=7)
        panels[0, column].set_title(f"{name}, one of {recording.asked.shape[1]} robots", fontsize=8)
        panels[-1, column].set_xlabel("time (s)", fontsize=8)
    panels[0, 0].legend(fontsize=7)
    save_figure(figure, path)
