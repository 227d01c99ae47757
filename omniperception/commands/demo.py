"""Shows the published policy among moving obstacles: live in the browser, or as a film where there is none.

    demo
    demo scenario=corridor condition=robot     # overrides, as play takes them
    demo viewer=video video_s=10 camera=side

A film is demo.mp4 and demo.png in the current folder; with scenario=corridor, demo-corridor.mp4 and demo-corridor.png.
"""

from __future__ import annotations

import importlib.util
import os
import sys
from dataclasses import dataclass
from pathlib import Path

import torch

from omniperception import build, config
from omniperception.commands.filming import FILM, FilmArguments, file_stem, film
from omniperception.viewer import PageOptions, Shown, serve
from omniperception.viewer.options import PAGE, PageArguments
from omnirobot.common.cli import Command, argument, refuse_arguments, refuse_overrides

RUN, SCENARIO = "avoider", "scenario=moving"


@dataclass(frozen=True, kw_only=True)
class Arguments(FilmArguments, PageArguments):
    """The command's own arguments. The film is short and small: set-up and film take two minutes on two cores."""

    video_s: float = argument(8.0, "length of the video (s)", positive=True)
    video_size: tuple[int, ...] = argument((640, 360), "width and height of the video (pixels)", least=2)

    viewer: str | None = argument(
        None, "how it is shown; null: in the browser where there is a display", choices=("web", "video")
    )
    stop_after_s: float | None = argument(None, "s after which the page is taken down; null: by Ctrl-C", positive=True)


def main(arguments: Arguments, overrides: list[str]) -> None:
    """Opens the page, or writes the film."""
    run_dir, path = config.SHIPPED_RUNS / RUN, Path(f"{file_stem('demo', overrides)}.mp4")
    num_envs = max(arguments.video_envs) + 1
    refuse_overrides(overrides, {"num_envs": num_envs})
    if not any(override.startswith(("scenario=", "obstacles=", "commands=")) for override in overrides):
        overrides = [SCENARIO, *overrides]
    viewer = arguments.viewer or ("web" if has_display() and importlib.util.find_spec("viser") else "video")
    if viewer == "web":
        refuse_arguments(arguments, FILM, "viewer=web films nothing")
        given = {name: getattr(arguments, name) for name in (*PAGE, "stop_after_s")}
        options = PageOptions(**given, open_browser=has_display())
        return serve(Shown(run_dir, tuple(overrides)), options)
    if arguments.viewer == "video":
        refuse_arguments(arguments, (*PAGE, "stop_after_s"), "viewer=video has no page")
    run = build.load_run(run_dir, [*overrides, f"num_envs={num_envs}"])
    build.check_split(run, "film", run_dir)
    trained = build.load_policy(run, run_dir)
    with film(arguments, trained.env, trained.policy, path) as recorder, torch.no_grad():
        observations = trained.env.get_observations()
        while recorder.frames_left:
            observations = trained.env.step(trained.policy(observations))[0]
            recorder()
    print(f"wrote {path} and {path.with_suffix('.png')}")
    if arguments.viewer is None:
        why = (
            "viser is not installed (pip install 'omniperception[viewer]')" if has_display() else "there is no display"
        )
        print(f"a film, because {why}; viewer=web serves the page on {arguments.host}:{arguments.port}")


def has_display() -> bool:
    """Tell whether a browser could be opened here."""
    return sys.platform in ("darwin", "win32") or any(os.environ.get(n) for n in ("DISPLAY", "WAYLAND_DISPLAY"))


command = Command(main, Arguments, __doc__, "of the run's configuration")
