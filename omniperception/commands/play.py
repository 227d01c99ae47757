"""Replays a run: counts what its policy does in whole episodes and films it.

    play run=latest obstacles=static num_envs=64 seed=3
    play run=pretrained/avoider scenario=moving viewer=none
    play run=pretrained/avoider viewer=web    # live in the browser: drive it, disturb it, switch what it walks in

All obstacles are present from the first step. Writes replay.json and, with viewer=video, replay.mp4 and replay.png into
the run directory.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

from omniperception import build, config
from omniperception.cli import Command, argument, trust
from omniperception.common.provenance import provenance
from omniperception.env.env import OmniEnv
from omniperception.evaluation.episodes import Policy, run_episodes
from omniperception.evaluation.outcomes import Episodes
from omniperception.evaluation.report import summary_table, times_line
from omniperception.learning import CheckpointError
from omniperception.viewer import PageOptions, Shown, ViewerError, serve
from omniperception.viewer.options import LOCALHOST, PORT


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """The command's own arguments."""

    run: str = argument("latest", "run directory, or latest for the newest under outputs/")
    viewer: str = argument("video", "how it is shown", choices=("video", "web", "none"))
    trials: int = argument(200, "trials", least=1)
    video_s: float = argument(20.0, "length of the video (s)", positive=True)
    host: str = argument(
        LOCALHOST, "address at which viewer=web listens; the default is reached from this machine alone"
    )
    port: int = argument(PORT, "port at which viewer=web listens", least=1)
    trust: tuple[str, ...] = trust()


def main(arguments: Arguments, overrides: list[str]) -> None:
    """Runs the episodes, prints the table and writes the results."""
    run_dir = config.find_run(arguments.run)
    if arguments.viewer == "web":
        shown = Shown(run_dir, tuple(overrides), trust=arguments.trust)
        return serve(shown, PageOptions(arguments.host, arguments.port))
    run = build.load_run(run_dir, overrides, arguments.trust)
    if not any(override.startswith("num_envs=") for override in overrides):
        run = replace(run, env=replace(run.env, num_envs=min(run.env.num_envs, arguments.trials)))
    trained = build.load_policy(run, run_dir)
    if arguments.viewer == "video":
        episodes = _film(arguments, run_dir, trained.env, trained.policy)
    else:
        episodes = run_episodes(trained.env, trained.policy, arguments.trials)
    summary = episodes.summary()
    print(f"{trained.checkpoint} in {run.env.num_envs} environments, seed {run.env.seed}")
    print(summary_table(summary))
    print(times_line(summary))
    report = {
        "checkpoint": trained.checkpoint.name,
        "overrides": overrides,
        "seed": run.env.seed,
        "num_envs": run.env.num_envs,
        **summary,
        **provenance(trained.env.device),
    }
    (run_dir / "replay.json").write_text(json.dumps(report, indent=2) + "\n")
    written = ["replay.json"] + (["replay.mp4", "replay.png"] if arguments.viewer == "video" else [])
    print(f"wrote {', '.join(str(run_dir / name) for name in written)}")


def _film(arguments: Arguments, run_dir: Path, env: OmniEnv, policy: Policy) -> Episodes:
    """Runs the episodes and films the first environment; the only user of the video modules."""
    from omniperception.evaluation.video import Recorder

    recorder = Recorder(env, run_dir / "replay.mp4", arguments.video_s)
    try:
        episodes = run_episodes(env, policy, arguments.trials, on_step=recorder)
    finally:
        recorder.close()
    recorder.write_still(run_dir / "replay.png")
    return episodes


command = Command(main, Arguments, __doc__, "of the run's configuration", (CheckpointError, ViewerError))
