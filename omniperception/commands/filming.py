"""What the commands that film have in common: their arguments and the names of their files."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING

from omniperception.env.env import OmniEnv, Policy
from omniperception.evaluation.film.video_options import VideoOptions
from omnirobot.common.cli import argument

if TYPE_CHECKING:
    from omniperception.evaluation.film.video import Recorder


@dataclass(frozen=True, kw_only=True)
class FilmArguments(VideoOptions):
    """Arguments that say what a film shows."""

    video_s: float = argument(20.0, "length of the video (s)", positive=True)


FILM = tuple(field.name for field in fields(FilmArguments))
"""Names of these arguments."""


@contextmanager
def film(arguments: FilmArguments, env: OmniEnv, policy: Policy, path: Path) -> Iterator[Recorder]:
    """Writes a film, of what is done before the context ends, and beside it a still of it.

    Args:
        arguments: what it shows.
        env: freshly built.
        policy: who acts.
        path: the mp4 file; the still has the suffix png.

    Yields:
        What is to be called after every control step.
    """
    from omniperception.evaluation.film.video import Recorder

    recorder = Recorder(env, path, arguments.video_s, arguments, policy)
    try:
        yield recorder
    finally:
        recorder.close()
    recorder.write_still(path.with_suffix(".png"))


def file_stem(name: str, overrides: Sequence[str]) -> str:
    """`name`, or name-scenario where overrides give one, so that one scenario's file does not replace another's."""
    given = [override.partition("=")[2] for override in overrides if override.startswith("scenario=")]
    return "-".join([name, *given]).replace("/", "-")
