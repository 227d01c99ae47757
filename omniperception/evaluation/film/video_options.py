"""How a video is taken."""

from __future__ import annotations

from dataclasses import dataclass

from omniperception.evaluation.film.camera import CAMERAS
from omnirobot.common.errors import ConfigError


@dataclass(frozen=True)
class VideoOptions:
    """How a video is taken.

    Attributes:
        size: its width and height (pixels), even numbers.
        env_ids: the environments that are filmed; several make a grid, row by row.
        camera: one of `CAMERAS`.
    """

    size: tuple[int, ...] = (960, 540)
    env_ids: tuple[int, ...] = (0,)
    camera: str = "chase"

    def __post_init__(self) -> None:
        if len(self.size) != 2 or any(n < 2 or n % 2 for n in self.size):
            given = ",".join(map(str, self.size))
            raise ConfigError(f"video_size={given} must be width,height, two even numbers such as 1280,720")
        given, (width, height) = ",".join(map(str, self.env_ids)), self.panel
        if not self.env_ids or min(self.env_ids) < 0 or len(set(self.env_ids)) < len(self.env_ids):
            raise ConfigError(f"video_envs={given} must be different numbers from 0 on, such as 0,1,2,3")
        if min(width, height) < LEAST_PANEL:
            raise ConfigError(
                f"video_envs={given} leaves {width} x {height} pixels for each; give fewer, or a larger video_size"
            )
        if self.camera not in CAMERAS:
            raise ConfigError(f"camera={self.camera} must be one of {', '.join(CAMERAS)}")

    @property
    def grid(self) -> tuple[int, int]:
        """Columns and rows of the panels."""
        columns = next(n for n in range(1, len(self.env_ids) + 1) if n * n >= len(self.env_ids))
        return columns, -(-len(self.env_ids) // columns)

    @property
    def panel(self) -> tuple[int, int]:
        """Width and height (pixels) of each environment's picture."""
        (width, height), (columns, rows) = self.size, self.grid
        return width // columns, height // rows

    def check_fits(self, num_envs: int) -> None:
        """Refuses environments that do not exist."""
        if (last := max(self.env_ids)) >= num_envs:
            given = ",".join(map(str, self.env_ids))
            raise ConfigError(
                f"video_envs={given}: there are {num_envs} environments, from 0 on; num_envs={last + 1} would do"
            )


LEAST_PANEL = 16
"""Pixels, of the picture of one environment."""
