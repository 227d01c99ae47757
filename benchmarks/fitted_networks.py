"""What networks can learn to read off their points, with as many steps of regression as one likes.

    python -m benchmarks.fitted_networks                                          # PD-RiskNet and the FPS variants
    python -m benchmarks.fitted_networks networks=pd_risknet_small,polar_rings steps=6000

A gait walks among obstacles, half of the robots told V_avoid, the others blind, the same ways for every network. On
the recorded frames each network and a layer behind it, which reads embedding, command and base velocity as a policy's
first layer does, are regressed on what avoiding takes: nearness and velocity of obstacles by sector, and avoidance
velocities. So neither exploration nor rewards are in it. R^2 on the robots that were held out; the table goes into
`folder`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import nn

from benchmarks.harness.table import Table, about, report
from omniperception import build, config
from omniperception.avoidance.sector_motion import encode
from omniperception.avoidance.velocity import AVOIDANCE_TARGET, AvoidanceConfig, avoidance_velocity
from omniperception.build import RunConfig
from omniperception.env.env import OmniEnv
from omniperception.learning.config import PerceptionConfig
from omnirobot.common.cli import Command, argument

TASK = ("experiment=end_to_end", "obstacles.curriculum=null", "sim.num_threads=1")
WIDE = AvoidanceConfig(num_sectors=36, threshold=2.0, alpha=1.0, max_speed=1.5)
"""A V_avoid of the paper's form that reaches further."""
HIDDEN = 256
"""Width of the layer behind a network."""
FAR = 0.375
"""Nearness from which on an obstacle's velocity counts: 2.5 m."""


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """The command line."""

    networks: tuple[str, ...] = argument(
        ("pd_risknet_small", "fps_gru_small", "fps_mlp_small"), "presets of conf/perception"
    )
    walker: str = argument("pretrained/gait", "run directory of experiment=gait")
    num_envs: int = argument(128, "robots, a quarter of which is held out", least=4)
    frames: int = argument(250, "LiDAR frames of each", least=20)
    steps: int = argument(4000, "steps of Adam", least=1)
    batch: int = argument(256, "windows of each", least=1)
    learning_rate: float = argument(1.0e-3, "at first; it falls to a fiftieth")
    folder: Path = argument(Path("outputs/fitted_networks"), "where the table goes")


@dataclass(frozen=True)
class Recording:
    """Sampled frames of E robots and what is true of them, F frames each.

    Attributes:
        frames: (E, F, P, 3) as the network takes them.
        count: (E, F) how many of the newest frames are of the present episode.
        given: (E, F, 6) command and measured velocity of the base, which a policy reads as well.
        targets: (E, F, K) by name; `velocity` has K = 72 and counts by `nearness`.
    """

    frames: torch.Tensor
    count: torch.Tensor
    given: torch.Tensor
    targets: Mapping[str, torch.Tensor]


def record(run: RunConfig, walker: Path, frames: int) -> Recording:
    """The frames of robots of a run's task, driven by a blind gait of which half is told V_avoid of velocity risk."""
    build.seed_everything(run.env.seed)
    rules = (run.env.rewards.avoidance, WIDE)
    risky = build.assemble(config.compose(["rewards=velocity_risk"])).env.rewards.avoidance.risk
    rewards = replace(run.env.rewards, avoidance=replace(rules[0], risk=risky))
    env = OmniEnv(replace(run.env, rewards=rewards, targets=(AVOIDANCE_TARGET,), skip_curricula=True))
    assert env.sensing is not None and env.sensing.history is not None and env.avoidance is not None
    teacher = build.load_teacher(walker, env)
    told = (torch.arange(env.num_envs) % 2 == 0).float()[:, None]
    kept: list[list[torch.Tensor]] = []
    observations = env.get_observations()
    while len(kept) < frames:
        observations[AVOIDANCE_TARGET] = observations[AVOIDANCE_TARGET] * told
        observations = env.step(teacher.actions(observations))[0]
        if env.sensing.due(env.step_count):
            avoidance, kinematics = env.avoidance, env.state.kinematics
            assert avoidance.motion is not None and avoidance.sector_distance is not None
            motion = encode(avoidance.motion)
            row = [env.sensing.history.frames[:, -1], env.sensing.history.count[:, 0], observations["command"]]
            row += [kinematics.base_lin_vel_b.float(), motion[..., 0], motion[..., 1:].flatten(1)]
            row += [avoidance_velocity(avoidance.sector_distance, rule) for rule in rules]
            kept.append([value.clone() for value in (*row, avoidance.velocity)])
    points, count, command, velocity, *targets = (torch.stack(column, 1) for column in zip(*kept, strict=True))
    names = ("nearness", "velocity", "V_avoid, paper", "V_avoid, 2 m", "V_avoid, velocity risk")
    return Recording(points, count, torch.cat((command, velocity), -1), dict(zip(names, targets, strict=True)))


class Reader(nn.Module):
    """A network and a layer behind it that says all targets, in units of their spread."""

    def __init__(self, perception: PerceptionConfig, recording: Recording, chosen: torch.Tensor) -> None:
        """Args: perception: the network's; recording: gives the sizes; chosen: robots (E',) that give the spread."""
        super().__init__()
        self.network = perception.build_network()
        self.sizes = {name: target.shape[-1] for name, target in recording.targets.items()}
        inputs = self.network.feature_dim + recording.given.shape[-1]
        self.head = nn.Sequential(nn.Linear(inputs, HIDDEN), nn.ELU(), nn.Linear(HIDDEN, sum(self.sizes.values())))
        self.spread = {name: target[chosen].std() for name, target in recording.targets.items()}

    def forward(self, frames: torch.Tensor, count: torch.Tensor, given: torch.Tensor) -> dict[str, torch.Tensor]:
        """Targets (B, K) by name of windows (B, H, P, 3) of which the newest `count` (B,) frames count."""
        embedding = self.network(frames, count[:, None])[:, 0]
        said = self.head(torch.cat((embedding, given), -1)).split(tuple(self.sizes.values()), -1)
        return {name: value * self.spread[name] for name, value in zip(self.sizes, said, strict=True)}


def fit(reader: Reader, recording: Recording, learn: torch.Tensor, given: Arguments) -> None:
    """Regresses on the robots `learn` (E',)."""
    adam = torch.optim.Adam(reader.parameters(), lr=given.learning_rate)
    schedule = torch.optim.lr_scheduler.LinearLR(adam, 1.0, 0.02, given.steps)
    generator = torch.Generator().manual_seed(0)
    history = reader.network.history
    for _ in range(given.steps):
        robots = learn[torch.randint(len(learn), (given.batch,), generator=generator)]
        newest = torch.randint(history - 1, recording.count.shape[1], (given.batch,), generator=generator)
        said, truth, weight = _read(reader, recording, robots, newest)
        errors = (
            (weight[name] * (said[name] - truth[name]).square()).mean() / reader.spread[name].square() for name in truth
        )
        loss = torch.stack(list(errors)).mean()
        adam.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(reader.parameters(), 1.0)
        adam.step()
        schedule.step()


def scores(reader: Reader, recording: Recording, held_out: torch.Tensor) -> dict[str, float]:
    """R^2 by target on the robots `held_out` (E',)."""
    missed, spread = dict.fromkeys(reader.sizes, 0.0), dict.fromkeys(reader.sizes, 0.0)
    mean = {name: target[held_out].mean((0, 1)) for name, target in recording.targets.items()}
    with torch.inference_mode():
        for frame in range(reader.network.history - 1, recording.count.shape[1]):
            said, truth, weight = _read(reader, recording, held_out, torch.full_like(held_out, frame))
            for name in truth:
                missed[name] += float((weight[name] * (said[name] - truth[name]).square()).sum())
                spread[name] += float((weight[name] * (mean[name] - truth[name]).square()).sum())
    return {name: 1.0 - missed[name] / spread[name] for name in missed}


def _read(
    reader: Reader, recording: Recording, robots: torch.Tensor, newest: torch.Tensor
) -> tuple[dict[str, torch.Tensor], dict[str, torch.Tensor], dict[str, torch.Tensor]]:
    """What is said and what is true of robots (B,) at frames (B,), and how much each number counts."""
    history = reader.network.history
    window = newest[:, None] - torch.arange(history - 1, -1, -1)
    count = recording.count[robots, newest].clamp(max=history)
    said = reader(recording.frames[robots[:, None], window], count, recording.given[robots, newest])
    truth = {name: target[robots, newest] for name, target in recording.targets.items()}
    valid = (count > 0).float()[:, None]
    near = torch.where(truth["nearness"] > FAR, truth["nearness"], 0.0).repeat_interleave(2, -1)
    return said, truth, {name: valid * near if name == "velocity" else valid for name in truth}


def main(given: Arguments, overrides: list[str]) -> None:
    """Records, fits, prints and writes."""
    walker = config.find_run(given.walker, "walker")
    columns = ("network", "points", "frames", "parameters")
    table = Table("fitted_networks", f"R^2 on {given.num_envs // 4} other robots, {given.steps} steps", columns)
    for name in given.networks:
        task = [*TASK, f"perception={name}", *overrides, f"num_envs={given.num_envs}"]
        run = build.assemble(config.compose(task))
        if run.perception is None:
            raise config.ConfigError(f"networks={name} sees nothing; give presets of conf/perception with a network")
        recording = record(run, walker, given.frames)
        robots = torch.randperm(given.num_envs, generator=torch.Generator().manual_seed(0))
        held_out, learn = robots[: given.num_envs // 4], robots[given.num_envs // 4 :]
        torch.manual_seed(0)
        reader = Reader(run.perception, recording, learn)
        fit(reader, recording, learn, given)
        found = scores(reader, recording, held_out)
        size = sum(parameter.numel() for parameter in reader.network.parameters())
        table.columns = (*columns, *found)
        table.rows.append((name, reader.network.num_points, reader.network.history, size, *found.values()))
        print(name, {target: round(value, 3) for target, value in found.items()}, flush=True)
    report([table], about(1, walker=str(given.walker), overrides=overrides), given.folder)


command = Command(main, Arguments, __doc__, "of the task that is walked in")

if __name__ == "__main__":
    command()
