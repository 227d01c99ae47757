"""Replays a run: counts what its policy does in whole episodes and films it.

python play.py run=latest [viewer=video|none] [episodes=200] [video_s=20] [overrides]

Overrides change the run's own configuration, e.g. obstacles=static num_envs=64 seed=3. Obstacles are all
there from the first step. Writes replay.json and, with viewer=video, replay.mp4 and replay.png into the run
directory.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from omniperception import build, config
from omniperception.build import load_policy
from omniperception.env.env import OmniEnv
from omniperception.evaluation.episodes import Episodes, Policy, run_episodes
from omniperception.evaluation.report import provenance, table, times_line
from omniperception.learning import CheckpointError

ARGUMENTS = {"run": "latest", "viewer": "video", "episodes": "200", "video_s": "20"}
VIEWERS = ("video", "none")


@dataclass(frozen=True)
class Replay:
    """What to replay and how.

    Attributes:
        run_dir: the run.
        viewer: 'video' or 'none'.
        episodes: at least so many episodes.
        video_s: length of the video (s).
        overrides: changes to the run's configuration.
    """

    run_dir: Path
    viewer: str
    episodes: int
    video_s: float
    overrides: tuple[str, ...]

    @classmethod
    def parse(cls, arguments: Sequence[str]) -> Replay:
        """From the command line."""
        own, overrides = config.split_arguments(arguments, ARGUMENTS)
        if own["viewer"] not in VIEWERS:
            raise config.ConfigError(f"viewer={own['viewer']} is unknown; known: {', '.join(VIEWERS)}")
        episodes = config.positive("episodes", own["episodes"], int)
        video_s = config.positive("video_s", own["video_s"], float)
        return cls(config.find_run(own["run"]), own["viewer"], episodes, video_s, tuple(overrides))

    def configuration(self) -> build.RunConfig:
        """The run's configuration as it is replayed."""
        composed = config.load(self.run_dir, self.overrides)
        if not any(override.startswith("num_envs=") for override in self.overrides):
            composed.num_envs = min(composed.num_envs, self.episodes)
        return build.assemble(composed)


def play(replay: Replay) -> None:
    """Runs the episodes, prints the table and writes the figures."""
    run = replay.configuration()
    trained = load_policy(run, replay.run_dir)
    if replay.viewer == "video":
        episodes = _film(replay, trained.env, trained.policy)
    else:
        episodes = run_episodes(trained.env, trained.policy, replay.episodes)
    summary = episodes.summary()
    print(f"{trained.checkpoint} in {run.env.num_envs} environments, seed {run.env.seed}")
    print(table({"run": summary}))
    print(times_line(summary))
    report = {
        "checkpoint": trained.checkpoint.name,
        "overrides": list(replay.overrides),
        "seed": run.env.seed,
        "num_envs": run.env.num_envs,
        **summary,
        **provenance(trained.env.device),
    }
    (replay.run_dir / "replay.json").write_text(json.dumps(report, indent=2) + "\n")
    written = ["replay.json"] + (["replay.mp4", "replay.png"] if replay.viewer == "video" else [])
    print(f"wrote {', '.join(str(replay.run_dir / name) for name in written)}")


def _film(replay: Replay, env: OmniEnv, policy: Policy) -> Episodes:
    """Runs the episodes and films the first environment; the only user of the video modules."""
    from omniperception.evaluation.video import Recorder

    recorder = Recorder(env, replay.run_dir / "replay.mp4", replay.video_s)
    try:
        episodes = run_episodes(env, policy, replay.episodes, on_step=recorder)
    finally:
        recorder.close()
    recorder.write_still(replay.run_dir / "replay.png")
    return episodes


def main() -> None:
    if {"-h", "--help"} & set(sys.argv[1:]):
        print(__doc__)
        return
    with config.one_line_errors(CheckpointError):
        play(Replay.parse(sys.argv[1:]))


if __name__ == "__main__":
    main()
