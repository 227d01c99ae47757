"""Keeps simulated time beside wall time, and says what of it was reached and what was left out."""

from __future__ import annotations

import time
from collections.abc import Callable

BEHIND_S = 0.3
"""A simulation that is this far (s) behind gives up catching up: it is slower than real time, and says so."""
LEAST_HZ = 4.0
"""Pictures a second that are drawn even where steps are late."""


class Clock:
    """Paces control steps and pictures.

    Attributes:
        speed: simulated seconds per second that are asked for.
        reached: simulated seconds per second over about the last second; 0 at first.
        pictures_hz, clouds_hz: pictures and clouds of points a second over about the last second.
        clouds: clouds shown within that second so far; whoever shows one counts it.
        dropped: pictures left out because steps were late, since the start.
    """

    def __init__(self, dt: float, picture_hz: float, now: Callable[[], float] = time.monotonic) -> None:
        """Args: dt: control step (s); picture_hz: pictures a second; now: s of some clock."""
        self.dt, self._period, self._now = dt, 1.0 / picture_hz, now
        self.speed, self.reached, self.pictures_hz, self.clouds_hz, self.dropped = 1.0, 0.0, 0.0, 0.0, 0
        self.start()

    def start(self) -> None:
        """Begins again, as after a pause."""
        now = self._now()
        self._due, self._picture_due, self._drawn = now, now, now
        self._begin_window(now)

    def _begin_window(self, now: float) -> None:
        self._window, self._steps, self._pictures, self.clouds = now, 0, 0, 0

    def stepped(self) -> float:
        """Notes a control step; returns for how long (s) to wait now."""
        now = self._now()
        self._steps += 1
        self._due += self.dt / self.speed
        if now - self._due > BEHIND_S:
            self._due = now
        elapsed = now - self._window
        if elapsed >= 1.0:
            self.reached = self._steps * self.dt / elapsed
            self.pictures_hz, self.clouds_hz = self._pictures / elapsed, self.clouds / elapsed
            self._begin_window(now)
        return max(self._due - now, 0.0)

    def picture_is_due(self) -> bool:
        """Tell whether to draw now; a picture that is due while steps are late is dropped."""
        now = self._now()
        if now < self._picture_due:
            return False
        late = now > self._due + self.dt
        self._picture_due = max(self._picture_due + self._period, now)
        if late and now - self._drawn < 1.0 / LEAST_HZ:
            self.dropped += 1
            return False
        self._drawn = now
        self._pictures += 1
        return True
