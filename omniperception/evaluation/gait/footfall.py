"""Gait diagrams: when each foot of a walking robot is on the ground."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from omniperception.avoidance.velocity import COMMAND
from omniperception.env.env import OmniEnv, Policy
from omniperception.env.mdp.commands import VelocityCommand, VelocityCommandConfig
from omnirobot.common.errors import ConfigError
from omnirobot.common.figures import new_figure, save_figure

COMMANDS = (
    (0.0, 0.0, 0.0),
    (0.5, 0.0, 0.0),
    (1.0, 0.0, 0.0),
    (2.0, 0.0, 0.0),
    (-1.0, 0.0, 0.0),
    (0.0, 1.0, 0.0),
    (0.0, 0.0, 1.5),
)
"""What robots are commanded, as far as they are meant for it: v_x, v_y (m/s), yaw rate (rad/s)."""
SETTLES_S, SHOWN_S = 3.0, 2.0
"""Time (s) before a diagram begins, and its length."""


@dataclass(frozen=True)
class Footfall:
    """Feet of robots that each follow one command.

    Attributes:
        commands: (len(COMMANDS), 3) m/s, m/s, rad/s, base frame.
        fell: (len(COMMANDS),) bool: which fell, or left their ground, and have no figures.
        contact: (T, len(COMMANDS), F) bool: which feet are down in each control step.
        velocity: (len(COMMANDS), 3) mean v_x, v_y (m/s) and yaw rate (rad/s), base frame.
        dt: control step (s).
        feet: names.
    """

    commands: torch.Tensor
    fell: torch.Tensor
    contact: torch.Tensor
    velocity: torch.Tensor
    dt: float
    feet: Sequence[str]

    def names(self) -> list[str]:
        """Of the commands."""
        return [_name(*command) for command in self.commands.tolist()]

    def duty(self) -> torch.Tensor:
        """(len(COMMANDS), F) share of the time that each foot is down."""
        return self.contact.double().mean(0)

    def frequency(self) -> torch.Tensor:
        """(len(COMMANDS), F) touch-downs per second."""
        down = self.contact[1:] & ~self.contact[:-1]
        return down.double().sum(0) / (len(down) * self.dt)


def watch(env: OmniEnv, policy: Policy) -> Footfall:
    """Lets each of as many robots as there are COMMANDS follow one of them.

    Args:
        env: freshly built, with velocity commands, whose ranges the robots are meant for, and the sensor "foot_force".
        policy: from observations to actions.

    Raises:
        ValueError: it has other commands.
        ConfigError: the policy is not told them as they are.
    """
    command, config = env.command, env.config.commands
    if not isinstance(config, VelocityCommandConfig) or env.num_envs != len(COMMANDS):
        raise ValueError(f"a gait diagram needs velocity commands and num_envs={len(COMMANDS)}")
    if not env.observes_command:
        raise ConfigError(
            f"what=feet needs a run whose observations have a group '{COMMAND}' that holds the command alone, trained"
            f" with observations.groups.{COMMAND}.history=1"
        )
    assert isinstance(command, VelocityCommand)
    least, most = torch.tensor([config.lin_vel_x, config.lin_vel_y, config.ang_vel_z]).T
    wanted = torch.tensor(COMMANDS).clamp(least, most).to(env.device)
    fell = torch.zeros(len(COMMANDS), dtype=torch.bool)
    contact, velocity = [], []
    with torch.no_grad():
        for step in range(round((SETTLES_S + SHOWN_S) / env.control_dt)):
            command.value.copy_(wanted)  # observed from the next step on, as fast as the task lets it change
            command.time_left.fill_(torch.inf)  # none is drawn, so that what follows from the command stays, too
            env.step(policy(env.get_observations()))
            fell |= env.done.cpu()
            if step * env.control_dt >= SETTLES_S:
                k = env.state.kinematics
                contact.append(env.state.foot_contact.cpu())
                velocity.append(k.planar_velocity.cpu())
    mean = torch.stack(velocity).mean(0)
    return Footfall(wanted.cpu(), fell, torch.stack(contact), mean, env.control_dt, env.robot.foot_names)


def draw_footfall(footfall: Footfall, path: Path) -> None:
    """A panel for each command with a bar for each foot while it is down."""
    columns = 2
    lines = -(-len(COMMANDS) // columns)
    figure = new_figure(9.0, 1.35 * lines + 0.5)
    axes = figure.subplots(lines, columns, squeeze=False, sharex=True).ravel()
    duty, frequency = footfall.duty(), footfall.frequency()
    for k, name in enumerate(footfall.names()):
        axis = axes[k]
        if footfall.fell[k]:
            axis.set_title(f"{name}: fell, or left its ground", fontsize=7.5)
            axis.set_yticks([])
            continue
        for foot in range(len(footfall.feet)):
            axis.broken_barh(_bars(footfall.contact[:, k, foot], footfall.dt), (-foot - 0.4, 0.8), color="#35618f")
        axis.set_yticks([-f for f in range(len(footfall.feet))], [n.removesuffix("_foot") for n in footfall.feet])
        axis.tick_params(labelsize=7)
        x, y, turn = footfall.velocity[k].tolist()
        feet = f"{frequency[k].mean():.1f} Hz, down {100 * duty[k].mean():.0f} %"
        axis.set_title(f"{name}: {x:.2f}, {y:.2f} m/s, {turn:.2f} rad/s; {feet}", fontsize=7.5)
    for axis in axes[len(COMMANDS) :]:
        axis.set_axis_off()
    for axis in axes[-columns:]:
        axis.set_xlabel("time (s)", fontsize=8)
    save_figure(figure, path)


def _name(forward: float, aside: float, turn: float) -> str:
    """Of a command that has one component, or none."""
    if forward:
        return f"{abs(forward):.3g} m/s {'ahead' if forward > 0 else 'back'}"
    if aside:
        return f"{abs(aside):.3g} m/s to the {'left' if aside > 0 else 'right'}"
    return f"{abs(turn):.3g} rad/s to the {'left' if turn > 0 else 'right'}" if turn else "stand"


def _bars(contact: torch.Tensor, dt: float) -> list[tuple[float, float]]:
    """(start, length) in s of the phases in which a foot (T,) bool is down."""
    padded = torch.nn.functional.pad(contact.int(), (1, 1)).diff()
    begins, ends = (padded == 1).nonzero().flatten(), (padded == -1).nonzero().flatten()
    return [(float(b) * dt, float(e - b) * dt) for b, e in zip(begins, ends, strict=True)]
