"""Videos of a policy while it learns."""

from __future__ import annotations

from pathlib import Path

from omniperception.env.mixed import families_of
from omniperception.evaluation.film.video import Recorder
from omniperception.evaluation.film.video_options import VideoOptions
from omniperception.learning import Runner

FOLDER = "videos"
OPTIONS = VideoOptions((640, 360))
"""Small, since the training waits for each picture."""


class TrainingVideos:
    """Films environment 0, of the first family, every so many iterations, with the actions as they are explored."""

    def __init__(self, runner: Runner, run_dir: Path, interval: int, duration_s: float) -> None:
        """
        Args:
            runner: of the run, before its first step.
            run_dir: run directory; videos are in its folder `videos`.
            interval: iterations between the beginnings of two videos.
            duration_s: length of each (s); one that is still being made puts the next off.
        """
        self._runner, self._folder = runner, run_dir / FOLDER
        self._interval, self._duration_s = interval, duration_s
        self._recorder: Recorder | None = None
        self._path, self._begun = self._folder, -1

    def step(self) -> None:
        """Begins a video, or takes a picture; call it after each control step."""
        iteration = self._runner.current_learning_iteration
        if self._recorder is None and iteration % self._interval == 0 and iteration > self._begun:
            self._begun = iteration
            self._path = self._folder / f"{iteration}.mp4"
            self._folder.mkdir(exist_ok=True)
            film = next(iter(families_of(self._runner.env).values()))
            self._recorder = Recorder(film, self._path, self._duration_s, OPTIONS)
        if self._recorder is not None:
            self._recorder()
            if not self._recorder.frames_left:
                self.close()

    def close(self) -> None:
        """Completes a video that is being made."""
        if self._recorder is not None:
            self._recorder.close()
            self._recorder = None
            self._runner.logger.save_video(self._path, self._begun)
