"""Curricula: shares of what is asked of a robot, which rise while it walks well."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class CurriculumConfig:
    """When a share rises, and how fast.

    Attributes:
        start: the share at the beginning.
        max_velocity_error: it rises while the error (m/s) of the linear velocity in calm moments is below.
        rise: how much it rises per second of simulated time of each environment.
    """

    start: float
    max_velocity_error: float
    rise: float

    def __post_init__(self) -> None:
        if not 0 <= self.start <= 1:
            raise ValueError(f"curriculum.start={self.start} must be a share, 0 to 1")
        for key in ("max_velocity_error", "rise"):
            if getattr(self, key) <= 0:
                raise ValueError(f"curriculum.{key}={getattr(self, key)} must be positive")


class Curriculum:
    """A share that rises while robots walk well.

    Attributes:
        level: the share, 0 to 1; 1 from the beginning without a curriculum.
    """

    def __init__(self, config: CurriculumConfig | None) -> None:
        self._config = config
        self.level = 1.0 if config is None else config.start

    def raise_level(self, velocity_error: float, seconds: float) -> None:
        """Raises it if robots have walked well for `seconds`, with this error (m/s)."""
        config = self._config
        if config is not None and velocity_error < config.max_velocity_error:
            self.level = min(1.0, self.level + config.rise * seconds)

    def state_dict(self) -> dict:
        return {"level": self.level}

    def load_state_dict(self, state: dict) -> None:
        self.level = state["level"]


FULL = Curriculum(None)
"""No curriculum: everything from the first step on."""
