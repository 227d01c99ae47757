"""What a perception network reads of a walking robot's frames, over the windows that it has learned from.

    python -m benchmarks.perceived_windows runs=outputs/perceive                # every checkpoint of a training
    python -m benchmarks.perceived_windows runs=outputs/narrow,outputs/wide scenarios=moving,hold

A gait walks among the obstacles of `scenarios` (split=dev), driven by the velocity risk of the true obstacles. On its
frames the network of each checkpoint of runs of `experiment=perceive` says nearness and velocity by sector; R^2 of
both, velocities where an obstacle is within 2.5 m. Table and figure go into `folder`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from benchmarks.fitted_networks import Recording, record, scores
from benchmarks.harness.table import Table, about, report
from omniperception import build, config
from omniperception.avoidance.velocity import MOTION_TARGET
from omniperception.learning import list_checkpoints, load_checkpoint
from omniperception.perception import PerceptionNetwork
from omnirobot.common.cli import Command, argument
from omnirobot.common.figures import new_figure, plain, save_figure


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """The command line."""

    runs: tuple[str, ...] = argument(("latest",), "run directories of experiment=perceive")
    scenarios: tuple[str, ...] = argument(("moving", "corridor", "hold", "moving_hard"), "presets of conf/scenario")
    condition: str = argument("robot", "preset of conf/condition")
    walker: str = argument("pretrained/gait", "run directory of experiment=gait")
    num_envs: int = argument(64, "robots in each world", least=2)
    frames: int = argument(60, "LiDAR frames of each", least=20)
    folder: Path = argument(Path("outputs/perceived_windows"), "where table and figure go")


class Said(torch.nn.Module):
    """What a supervised network says of nearness and velocity by sector, by name as a `Recording` has them."""

    sizes = ("nearness", "velocity")

    def __init__(self, network: PerceptionNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, frames: torch.Tensor, count: torch.Tensor, given: torch.Tensor) -> dict[str, torch.Tensor]:
        """(B, S) nearness and (B, 2 S) velocity of windows (B, H, P, 3), whose newest `count` (B,) frames count."""
        motion = self.network(frames, count[:, None])[:, 0, self.network.supervised[MOTION_TARGET]].unflatten(
            1, (-1, 3)
        )
        return {"nearness": motion[..., 0], "velocity": motion[..., 1:].flatten(1)}


def recordings(timed: bool, given: Arguments, overrides: list[str]) -> dict[str, Recording]:
    """Frames by scenario on legs, with the times at which they were taken or without."""
    walker = config.find_run(given.walker, "walker")
    task = ["experiment=navigator", f"perception={'timed_rings' if timed else 'polar_rings'}"]
    task += [f"condition={given.condition}", f"num_envs={given.num_envs}", "obstacles.curriculum=null", *overrides]
    worlds = {}
    for scenario in given.scenarios:
        recorded = record(build.assemble(config.compose([*task, f"scenario={scenario}"])), walker, given.frames)
        targets = {name: recorded.targets[name] for name in Said.sizes}
        worlds[scenario] = Recording(recorded.frames, recorded.count, recorded.given, targets)
    return worlds


def main(given: Arguments, overrides: list[str]) -> None:
    """Records, compares, prints, writes and draws."""
    columns = ("run", "windows", "world", "nearness", "velocity")
    table = Table("perceived_windows", f"R^2 on frames of a walking robot, condition={given.condition}", columns)
    curves: dict[str, list[tuple[int, float, float]]] = {}
    by_frames: dict[bool, dict[str, Recording]] = {}  # frames with and without times are other rows
    for name in given.runs:
        run_dir = config.find_run(name, "runs")
        run = build.load_run(run_dir)
        if run.perception is None or not run.families:
            raise config.ConfigError(f"runs={name} is no run of experiment=perceive")
        timed = run.env.frame_times
        if timed not in by_frames:
            by_frames[timed] = recordings(timed, given, overrides)
        steps = run.ppo.num_steps_per_env // build.steps_per_frame(run)
        for checkpoint in list_checkpoints(run_dir):
            state = load_checkpoint(checkpoint, "cpu")
            network = run.perception.build_network()
            weights = state["actor_state_dict"]
            own = {key.removeprefix("perception."): v for key, v in weights.items() if key.startswith("perception.")}
            network.load_state_dict(own)
            windows = state["iteration"] * steps * run.env.num_envs
            steered = torch.arange(0, given.num_envs, 2)  # the others walk blind, into things
            found = {world: scores(Said(network), frames, steered) for world, frames in by_frames[timed].items()}
            for world, score in found.items():
                table.rows.append((name, windows, world, score["nearness"], score["velocity"]))
            means = [sum(score[key] for score in found.values()) / len(found) for key in Said.sizes]
            curves.setdefault(name, []).append((windows, *means))
            print(name, f"{windows:,} windows", [round(mean, 3) for mean in means], flush=True)
    report([table], about(1, walker=given.walker, overrides=overrides), given.folder)
    draw(curves, given.folder / "perceived_windows.png")


def draw(curves: dict[str, list[tuple[int, float, float]]], path: Path) -> None:
    """R^2 over windows, a line for each run."""
    figure = new_figure(8, 3)
    axes = figure.subplots(1, 2)
    for name, points in curves.items():
        windows, *columns = zip(*points, strict=True)
        for axis, column, what in zip(axes, columns, Said.sizes, strict=True):
            axis.semilogx(windows, column, "o-", label=plain(name))
            axis.set(xlabel="windows", ylabel=f"$R^2$ of {what}")
    axes[0].legend()
    save_figure(figure, path)


command = Command(main, Arguments, __doc__, "of the task that is walked in")

if __name__ == "__main__":
    command()
