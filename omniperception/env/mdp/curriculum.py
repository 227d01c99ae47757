"""Curricula: shares of what is asked of a robot, which rise while it walks well and fall while it does not."""

from __future__ import annotations

from omniperception.common.checked import Positive, Share, checked
from omniperception.common.stateful import Stateful


@checked("curriculum")
class CurriculumConfig:
    """When a share rises or falls, and how fast.

    Attributes:
        start: the share at the beginning, and the least.
        max_velocity_error: it rises while the error (m/s) of the linear velocity in calm moments is below, and falls as
            fast while it is above, so that robots learn at the edge of what they can do.
        rise: how much it changes per second of simulated time of each environment.
    """

    start: Share
    max_velocity_error: Positive
    rise: Positive


class Curriculum(Stateful):
    """A share that rises while robots walk well, and falls while they do not.

    Attributes:
        level: the share, 0 to 1; 1 from the beginning without a curriculum.
    """

    saved = ("level",)

    def __init__(self, config: CurriculumConfig | None) -> None:
        self._config = config
        self.level = 1.0 if config is None else config.start

    @property
    def rises(self) -> bool:
        """Whether there is a curriculum."""
        return self._config is not None

    def follow(self, velocity_error: float, seconds: float) -> None:
        """Takes in how robots have walked for `seconds`: with this error (m/s)."""
        config = self._config
        if config is not None:
            change = config.rise * seconds * (1.0 if velocity_error < config.max_velocity_error else -1.0)
            self.level = min(max(self.level + change, config.start), 1.0)


FULL = Curriculum(None)
"""No curriculum: everything from the first step on."""
