"""Replays a run: counts what its policy does in whole episodes and films it.

    play run=latest obstacles=static num_envs=64 seed=3
    play run=pretrained/avoider scenario=moving viewer=none
    play run=pretrained/avoider scenario=corridor camera=side video_size=640,360 video_envs=0,1,2,3    # a grid of four
    play run=pretrained/avoider viewer=web    # live in the browser: drive it, disturb it, switch what it walks in

All obstacles are present from the first step. Writes replay.json and, with viewer=video, replay.mp4 and replay.png into
the run directory; with scenario=moving they are replay-moving.json and so on.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace

from omniperception import build, config
from omniperception.commands.filming import FILM, FilmArguments, file_stem, film
from omniperception.common.provenance import provenance
from omniperception.evaluation.report.tables import summary_table, times_line
from omniperception.evaluation.trials.episodes import run_episodes
from omniperception.learning.progress import ProgressLine
from omniperception.viewer import Shown, serve
from omniperception.viewer.options import PAGE, PageArguments
from omnirobot.common.cli import Command, argument, refuse_arguments, refuse_overrides, trust
from omnirobot.common.files import write_whole


@dataclass(frozen=True, kw_only=True)
class Arguments(FilmArguments, PageArguments):
    """The command's own arguments."""

    run: str = argument("latest", "run directory, or latest for the newest under outputs/")
    viewer: str = argument("video", "how it is shown", choices=("video", "web", "none"))
    trials: int = argument(200, "trials", least=1)
    trust: tuple[str, ...] = trust()


def main(arguments: Arguments, overrides: list[str]) -> None:
    """Runs the episodes, prints the table and writes the results."""
    run_dir = config.find_run(arguments.run)
    if arguments.viewer == "web":
        refuse_arguments(arguments, (*FILM, "trials"), "viewer=web counts and films nothing")
        refuse_overrides(overrides, {"num_envs": 1})
        shown = Shown(run_dir, tuple(overrides), trust=arguments.trust)
        return serve(shown, arguments.page)
    refuse_arguments(arguments, PAGE, f"viewer={arguments.viewer} has no page")
    if arguments.viewer == "none":
        refuse_arguments(arguments, FILM, "viewer=none films nothing")
    stem = file_stem("replay", overrides)
    run = build.load_run(run_dir, overrides, arguments.trust)
    build.check_split(run, "replay", run_dir)
    if not any(override.startswith("num_envs=") for override in overrides):
        run = replace(run, env=replace(run.env, num_envs=min(run.env.num_envs, arguments.trials)))
    films = arguments.viewer == "video"
    if films:
        arguments.check_fits(run.env.num_envs)
    trained = build.load_policy(run, run_dir)
    with ExitStack() as stack:
        movie = run_dir / f"{stem}.mp4"
        recorder = stack.enter_context(film(arguments, trained.env, trained.policy, movie)) if films else None
        progress = stack.enter_context(_progress(arguments.trials))
        episodes = run_episodes(trained.env, trained.policy, arguments.trials, on_step=recorder, on_left=progress)
    summary = episodes.summary()
    print(f"{trained.checkpoint} in {run.env.num_envs} environments, seed {run.env.seed}")
    print(summary_table(summary))
    print(times_line(summary))
    report = {"checkpoint": trained.checkpoint.name, "overrides": overrides, "seed": run.env.seed}
    report |= {"num_envs": run.env.num_envs, **summary, **provenance(trained.env.device)}
    write_whole(run_dir / f"{stem}.json", json.dumps(report, indent=2) + "\n")
    written = [run_dir / f"{stem}.{kind}" for kind in ("json", *(("mp4", "png") if films else ()))]
    print(f"wrote {', '.join(map(str, written))}")


@contextmanager
def _progress(trials: int) -> Iterator[Callable[[int], None]]:
    """A function that is told how many trials are left and says so every ten seconds."""
    line, begin = ProgressLine(), time.perf_counter()
    said = begin

    def show(left: int) -> None:
        nonlocal said
        now = time.perf_counter()
        if now - said > INTERVAL_S:
            said = now
            line.show(f"{trials - left} of {trials} trials have ended after {now - begin:.0f} s")

    try:
        yield show
    finally:
        line.end()


INTERVAL_S = 10.0
"""Between two lines of progress."""

command = Command(main, Arguments, __doc__, "of the run's configuration")
