"""How a video is taken."""

from __future__ import annotations

from dataclasses import dataclass

from omniperception.evaluation.film.camera import CAMERAS
from omnirobot.common.cli import argument
from omnirobot.common.errors import ConfigError


@dataclass(frozen=True)
class VideoOptions:
    """How a video is taken; several environments make a grid, row by row."""

    video_size: tuple[int, ...] = argument((960, 540), "width and height of the video (pixels)", least=2)
    video_envs: tuple[int, ...] = argument((0,), "environments in the video; several make a grid", least=0)
    camera: str = argument("chase", "where the video is taken from", choices=tuple(CAMERAS))

    def __post_init__(self) -> None:
        if len(self.video_size) != 2 or any(n % 2 for n in self.video_size):
            given = ",".join(map(str, self.video_size))
            raise ConfigError(f"video_size={given} must be width,height, two even numbers such as 1280,720")
        given, (width, height) = ",".join(map(str, self.video_envs)), self.panel
        if len(set(self.video_envs)) < len(self.video_envs):
            raise ConfigError(f"video_envs={given} must be different numbers from 0 on, such as 0,1,2,3")
        if min(width, height) < LEAST_PANEL:
            raise ConfigError(
                f"video_envs={given} leaves {width} x {height} pixels for each; give fewer, or a larger video_size"
            )

    @property
    def grid(self) -> tuple[int, int]:
        """Columns and rows of the panels."""
        columns = next(n for n in range(1, len(self.video_envs) + 1) if n * n >= len(self.video_envs))
        return columns, -(-len(self.video_envs) // columns)

    @property
    def panel(self) -> tuple[int, int]:
        """Width and height (pixels) of each environment's picture."""
        (width, height), (columns, rows) = self.video_size, self.grid
        return width // columns, height // rows

    def check_fits(self, num_envs: int) -> None:
        """Refuses environments that do not exist."""
        if (last := max(self.video_envs)) >= num_envs:
            given = ",".join(map(str, self.video_envs))
            raise ConfigError(
                f"video_envs={given}: there are {num_envs} environments, from 0 on; num_envs={last + 1} would do"
            )


LEAST_PANEL = 16
"""Pixels, of the picture of one environment."""
