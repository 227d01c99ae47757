"""Evaluation of a run in scenarios, beside baselines, for the evaluate command and the ablation."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from omniperception import build, config
from omniperception.build import RunConfig, TrainedPolicy, load_policy
from omniperception.common.figures import new_figure
from omniperception.common.provenance import provenance
from omniperception.config import ConfigError
from omniperception.deploy import ExportedPolicy
from omniperception.deploy.export import FOLDER as EXPORTED
from omniperception.evaluation.baselines import Limits, covered, steered
from omniperception.evaluation.episodes import Episodes, run_episodes
from omniperception.evaluation.exported import ExportedPolicies
from omniperception.evaluation.plots import draw_tracks
from omniperception.evaluation.report import DEFINITIONS, table, times_line, write_trials

FOLDER = "evaluation"
"""Folder of a run directory for the results."""

POLICIES = {
    "run": "the run's policy",
    "blind": "the same policy, its LiDAR covered: every ray a miss",
    "scripted": "a walking policy that follows V_cmd + V_avoid, V_avoid by the run's avoidance controller from"
    " ground-truth distances",
    "command": "a walking policy that follows V_cmd alone",
    "exported": "the run's exported policy on what a robot measures: onnxruntime",
}
"""Policies to evaluate; the walking policy is that of `walker`, or for `scripted` the run's own, LiDAR covered."""

ENVS = 256
"""Most environments at a time, unless `num_envs` is given."""


@dataclass(frozen=True)
class Evaluation:
    """Settings of an evaluation.

    Attributes:
        run_dir: the run.
        scenarios: names from conf/scenario.
        policies: names from POLICIES.
        trials: at least so many trials of each policy in each scenario.
        num_envs: environments at a time; None: as few rounds of at most ENVS as the trials need.
        walker: run directory of a policy that follows velocity commands, for the policies that walk; or None.
        plots: whether to draw the trajectories.
        overrides: changes to the configuration, on top of the scenario's.
        trust: packages of one's own whose names the run's configuration may build.
    """

    run_dir: Path
    scenarios: Sequence[str]
    policies: Sequence[str] = ("run",)
    trials: int = 1000
    num_envs: int | None = None
    walker: Path | None = None
    plots: bool = True
    overrides: Sequence[str] = ()
    trust: Sequence[str] = ()

    def __post_init__(self) -> None:
        folders = config.search_path(self.overrides, config.read(self.run_dir))
        known = config.presets("scenario", folders)
        for name in self.scenarios:
            if name not in known:
                raise ConfigError(f"scenario={name} is unknown; {config.suggest(name, known)}")
        if "command" in self.policies and self.walker is None:
            raise ConfigError(
                "policy=command needs a policy that walks without avoiding: walker=<run directory of experiment=walk>;"
                " the run's own without its LiDAR is policy=blind"
            )
        for override in self.overrides:
            if override.split("=", 1)[0] in ("scenario", "num_envs"):
                raise ConfigError(f"{override} is not an override here; it is an argument of its own")

    @property
    def envs(self) -> int:
        """Environments at a time."""
        if self.num_envs is not None:
            return self.num_envs
        return math.ceil(self.trials / math.ceil(self.trials / ENVS))


def evaluate(evaluation: Evaluation) -> dict[str, dict]:
    """Evaluates every policy in every scenario, prints tables and writes the run's evaluation folder.

    Returns:
        What <scenario>.json holds, by scenario.
    """
    if evaluation.plots:
        new_figure(1.0, 1.0)  # refuses now what would fail after hours
    folder = evaluation.run_dir / FOLDER
    folder.mkdir(exist_ok=True)
    reports = {}
    for scenario in evaluation.scenarios:
        report, episodes = evaluate_scenario(evaluation, scenario)
        (folder / f"{scenario}.json").write_text(json.dumps(report, indent=2) + "\n")
        write_trials(folder / f"{scenario}.csv", episodes)
        written = [f"{scenario}.json", f"{scenario}.csv"]
        if evaluation.plots:
            obstacles = _assemble(evaluation, scenario, evaluation.run_dir).env.obstacles
            draw_tracks(folder / f"{scenario}.png", scenario, episodes, obstacles)
            written.append(f"{scenario}.png")
        print(f"{scenario}, {report['num_envs']} environments, seed {report['seed']}:")
        print(table(report["policies"]))
        print(f"wrote {', '.join(str(folder / name) for name in written)}", flush=True)
        reports[scenario] = report
    return reports


def evaluate_scenario(evaluation: Evaluation, scenario: str) -> tuple[dict, dict[str, Episodes]]:
    """The report of one scenario and the episodes it was made from, by policy."""
    episodes, summaries = {}, {}
    for name in evaluation.policies:
        trained = _contender(name, evaluation, scenario)
        episodes[name] = run_episodes(trained.env, trained.policy, evaluation.trials, keep_tracks=evaluation.plots)
        summaries[name] = {
            "what": POLICIES[name],
            "checkpoint": str(trained.checkpoint),
            **episodes[name].summary(),
        }
        print(f"{scenario} {name}:{times_line(summaries[name])}", flush=True)
    report = {
        "scenario": scenario,
        "run": str(evaluation.run_dir),
        "overrides": list(evaluation.overrides),
        "seed": trained.env.config.seed,
        "num_envs": trained.env.num_envs,
        "time_limit_s": trained.env.config.terminations.episode_length_s,
        "policies": summaries,
        "definitions": DEFINITIONS,
        **provenance(trained.env.device),
    }
    return report, episodes


def _contender(name: str, evaluation: Evaluation, scenario: str) -> TrainedPolicy:
    """One of POLICIES in a fresh environment of the scenario."""
    walks = name in ("scripted", "command")
    run_dir = evaluation.walker if walks and evaluation.walker is not None else evaluation.run_dir
    run = _assemble(evaluation, scenario, run_dir)
    trained = load_policy(run, run_dir)
    policy, checkpoint = trained.policy, trained.checkpoint
    try:
        if name == "blind":
            policy = covered(trained.env, policy)
        if name == "scripted":
            avoidance = build.assemble(config.load(evaluation.run_dir), evaluation.trust).env.rewards.avoidance
            own = run_dir == evaluation.run_dir and avoidance.risk is not None  # the run's commands follow from it
            policy = steered(trained.env, policy, avoidance, None if own else _learned_commands(run_dir))
        if name == "exported":
            checkpoint = run_dir / EXPORTED
            policy = ExportedPolicies(trained.env, ExportedPolicy.load(checkpoint))
    except ValueError as error:
        raise ConfigError(f"policy={name}: {error}") from None
    return TrainedPolicy(trained.env, policy, checkpoint)


def _assemble(evaluation: Evaluation, scenario: str, run_dir: Path) -> RunConfig:
    """The run with the scenario's scene; a walker takes the overrides that change the scene, and finds the presets."""
    overrides = list(evaluation.overrides)
    if run_dir != evaluation.run_dir:
        overrides += config.as_override(config.search_path((), config.read(evaluation.run_dir)))
        scene = (*config.FIXED_BY_SCENARIO, "sim", "hydra")
        overrides = [o for o in overrides if o.lstrip("+~").split("=", 1)[0].split(".", 1)[0] in scene]
    composed = config.load(run_dir, [f"scenario={scenario}", *overrides, f"num_envs={evaluation.envs}"])
    return build.assemble(composed, evaluation.trust)


def _learned_commands(run_dir: Path) -> Limits | None:
    """The ranges of v_x and v_y (m/s) that a run has been trained with, or None where it was given goals."""
    commands = config.read(run_dir).commands
    if "lin_vel_x" not in commands:
        return None
    return tuple(commands.lin_vel_x), tuple(commands.lin_vel_y)
