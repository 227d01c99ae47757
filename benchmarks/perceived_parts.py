"""What better perception would bring: a policy's trials with parts of what it perceives replaced by the truth.

    python -m benchmarks.perceived_parts                                            # the published avoider, split=dev
    python -m benchmarks.perceived_parts scenarios=moving,corridor condition=ideal trials=200

The rows: as it perceives; with true distances; with true velocities; with both, of obstacles that a ray has hit within
the network's history; and all obstacles, seen or not, at every control step instead of every frame. The truth passes
through the same numbers by sector, frame rate and controller as what is perceived, so a row differs from the first by
the estimate alone. Beside them stand the errors of the estimate itself. It is for networks whose avoidance velocity
follows from nearness and motion by sector (`perception.motion_weight`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from benchmarks.harness.table import Table, about, report
from omniperception import build, config
from omniperception.avoidance.sector_motion import decode, encode
from omniperception.build import RunConfig
from omniperception.cli import Command, argument
from omniperception.config import ConfigError
from omniperception.env.env import OmniEnv
from omniperception.evaluation.baselines import baseline, prepared
from omniperception.evaluation.episodes import run_episodes
from omniperception.evaluation.outcomes import Episodes
from omniperception.evaluation.report import rate_cell
from omniperception.learning import CheckpointError
from omniperception.learning.models import PerceptionActor
from omniperception.learning.read_out import MotionReadOut

PARTS = {
    "as perceived": (),
    "true distances": ("distance",),
    "true velocities": ("velocity",),
    "both": ("distance", "velocity"),
}
"""Rows of the table, and what is true in each."""
ALL = "all obstacles, at every step"
NEAR_M, MOVES_M_S, NOTICED_M = 2.5, 0.3, 0.5
"""Sectors that count for the errors: their obstacle so near, so fast; noticed where its distance is known so well."""


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """The command line."""

    run: str = argument("pretrained/avoider", "run directory of experiment=avoid")
    scenarios: tuple[str, ...] = argument(("moving",), "presets of conf/scenario, on split=dev")
    terrain: str = argument("flat", "preset of conf/terrain")
    condition: str = argument("robot", "preset of conf/condition")
    trials: int = argument(80, "trials of each row", least=1)
    num_envs: int = argument(40, "environments at a time", least=1)
    folder: Path = argument(Path("outputs/perceived_parts"), "where the table goes")


class PartlyTrue(MotionReadOut):
    """A read-out of which parts of the motion by sector are the simulator's.

    Attributes:
        moving, noticed: sectors in which something moves near a robot, and how many of them are noticed.
        velocity_error: sum over those noticed (m/s).
    """

    def __init__(self, own: MotionReadOut, env: OmniEnv, parts: Sequence[str]) -> None:
        """Args: own: the policy's; env: knows the truth; parts: of "distance" and "velocity", those that are true."""
        assert env.avoidance is not None and env.avoidance.motion is not None  # the network is supervised with it
        super().__init__(own.feature_dim, env.avoidance.motion[0].numel(), own.part, own.velocity_risk)
        self.layers, self.candidates = own.layers, own.candidates
        self._avoidance, self._num_envs, self._parts = env.avoidance, env.num_envs, parts
        self.moving = self.noticed = 0
        self.velocity_error = 0.0

    def motion(self, embedding: torch.Tensor) -> torch.Tensor:
        """As of :class:`MotionReadOut`; an embedding that is not of all environments is that of no frames."""
        said, true = super().motion(embedding), self._avoidance.motion
        if len(said) != self._num_envs or true is None:
            return said
        self._count(decode(said), true)
        told = encode(true)
        distance = told if "distance" in self._parts else said
        velocity = told if "velocity" in self._parts else said
        return torch.cat((distance[..., :1], velocity[..., 1:]), -1)

    def _count(self, said: torch.Tensor, true: torch.Tensor) -> None:
        moves = (true[..., 0] < NEAR_M) & (true[..., 1:].norm(dim=-1) >= MOVES_M_S)
        noticed = moves & ((said[..., 0] - true[..., 0]).abs() < NOTICED_M)
        self.moving += int(moves.sum())
        self.noticed += int(noticed.sum())
        self.velocity_error += float((said[..., 1:] - true[..., 1:]).norm(dim=-1)[noticed].sum())


def run_with(run: RunConfig, run_dir: Path, parts: Sequence[str], trials: int) -> tuple[Episodes, PartlyTrue]:
    """Trials of a run with parts of what it perceives replaced by the truth, and the read-out that did it.

    Args:
        run: its configuration, in the world.
        run_dir: its folder.
        parts: see `PartlyTrue`.
        trials: how many.

    Raises:
        ConfigError: its avoidance velocity does not follow from motion by sector.
    """
    if run.perception is None or not run.perception.motion_weight:
        raise ConfigError(f"run={run_dir} has no motion by sector to replace; give a run of experiment=avoid")
    trained = build.load_policy(_prepared(run, "run"), run_dir)
    actor = trained.policy
    assert isinstance(actor, PerceptionActor) and isinstance(actor.read_out, MotionReadOut)  # as the weight asks for
    partly = actor.read_out = PartlyTrue(actor.read_out, trained.env, parts)
    return run_episodes(trained.env, actor, trials), partly


def run_with_all(run: RunConfig, run_dir: Path, trials: int) -> Episodes:
    """Trials of the gait that is told everything."""
    trained = build.load_policy(_prepared(run, "oracle"), run_dir)
    policy = baseline("oracle", trained.env, trained.policy, run.env.rewards.avoidance, None)
    return run_episodes(trained.env, policy, trials)


def _prepared(run: RunConfig, policy: str) -> RunConfig:
    return replace(run, env=prepared(policy, run.env, run.env.lidar))


def main(given: Arguments, overrides: list[str]) -> None:
    """Runs the trials, prints and writes."""
    torch.set_num_threads(1)
    run_dir = config.find_run(given.run)
    title = f"Reached untouched without a fall, {given.trials} trials each, condition {given.condition}, split dev"
    columns = ("world", "truth", "untouched, %", "falls, %", "noticed, %", "velocity error, m/s")
    table = Table("perceived_parts", title, columns)
    for scenario in given.scenarios:
        place = [f"scenario={scenario}", f"terrain={given.terrain}", f"condition={given.condition}"]
        place += ["sim.num_threads=1", *overrides, f"num_envs={given.num_envs}"]
        run = build.load_run(run_dir, place)
        build.check_split(run, "study")
        for name in (*PARTS, ALL):
            errors = ["", ""]
            if name == ALL:
                episodes = run_with_all(run, run_dir, given.trials)
            else:
                episodes, partly = run_with(run, run_dir, PARTS[name], given.trials)
                noticed, error = partly.noticed / max(partly.moving, 1), partly.velocity_error / max(partly.noticed, 1)
                errors = [f"{100 * noticed:.2f}", f"{error:.2f}"]
            falls = 100 * float(episodes.happened()["fall"].float().mean())
            table.rows.append((scenario, name, rate_cell([episodes.clean]), f"{falls:.2f}", *errors))
            print(f"{scenario}, {name}: {rate_cell([episodes.clean])}", flush=True)
    report([table], about(1, run=str(run_dir), overrides=overrides), given.folder)


command = Command(main, Arguments, __doc__, "of the run's configuration", (CheckpointError,))

if __name__ == "__main__":
    command()
