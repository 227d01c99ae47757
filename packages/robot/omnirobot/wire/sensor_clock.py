"""Times of a sensor's points against the clock by which they come: what drivers get wrong, and what is made of it."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from omnirobot.wire.saying import say

_WINDOW_S, _LEAST_MESSAGES = 1.0, 5
"""What times are judged by: so long, and so many messages."""
_GAP_S = 3.0
"""Without messages for so long, judging begins anew."""
BACK_NS = 20_000_000
"""Further back than messages may overtake each other, 20 ms."""
_FRAMES, _OTHER_TIME_S = 100, 1.0
"""Frames among which the least delay is looked for, and a change of the delay that is none."""
_MANY = 0.25
"""Share of messages whose times jump, from which on no time is believed."""
_SLOW, _FLAT = 0.01, 0.01
"""Shares of the time that passes: times that go on by less are wrong, and messages that span less have one time."""
_LONGEST_NS = 500_000_000
"""Between two messages whose points are spread over it."""


class FrameAges:
    """How old frames are when they come, beyond the least that was seen: the two clocks need not agree.

    Attributes:
        newest_s: of the newest frame.
    """

    def __init__(self) -> None:
        self.newest_s = 0.0
        self._behind: deque[int] = deque(maxlen=_FRAMES)

    def add(self, end_ns: int, now: float) -> None:
        """A frame comes `now` (s) whose last point was measured at `end_ns`, by the sensor's clock.

        Whole nanoseconds and an age in whole microseconds, so that a recording, whose clock begins elsewhere, has the
        same.
        """
        behind = round(1e9 * now) - end_ns
        if self._behind and abs(behind - self._behind[-1]) > 1e9 * _OTHER_TIME_S:
            self._behind.clear()  # the sensor has restarted
        self._behind.append(behind)
        self.newest_s = 1e-6 * round(1e-3 * (behind - min(self._behind)))


class SensorClock:
    """Makes the times of points go on as the clock does by which they come. Whatever it changes is said once.

    Times in another unit are taken in that unit. Where times stand still or go back and forth, messages are taken as
    measured when they came. Where the points of a message all have one time, they are taken as measured one after the
    other since the message before.

    Attributes:
        is_changed: whether the newest message is the first that is taken as something else than those before.
        untimed: messages that were taken as measured when they came.
    """

    def __init__(self) -> None:
        self.is_changed, self.untimed = False, 0
        self._scale: int | None = 1
        self._origin, self._origin_ns = 0, 0
        self._said: set[object] = set()
        self._before: int | None = None
        self._flat = False
        self._begin(-math.inf, 0)

    def _begin(self, now: float, newest: int) -> None:
        self._since = self._at = now
        self._newest, self._moved, self._spans, self._messages, self._jumps = newest, 0, 0, 0, 0

    def read(self, times_ns: np.ndarray, first: int, last: int, now: float) -> np.ndarray:
        """(n,) ns at which the points of a message were measured.

        Args:
            times_ns: (n,) that it says; itself given back where they are right.
            first, last: of them.
            now: when it came, s.
        """
        self.is_changed = False
        self._watch(first, last, len(times_ns), now)
        have_one_time = self._flat or first == last or self._scale is None
        if self._scale is None:
            self.untimed, last = self.untimed + 1, round(1e9 * now)
            times_ns = np.full(len(times_ns), last)
        elif self._scale != 1:
            times_ns = self._origin_ns + (times_ns - self._origin) * self._scale
            last = int(times_ns.max())
        step, self._before = 0 if self._before is None else last - self._before, last
        if len(times_ns) == 1 or not have_one_time or not 0 < step <= _LONGEST_NS:
            return times_ns
        if self._scale is not None:
            self._say("flat", "are one within a message: its points are taken as measured evenly since the one before")
        return last - step + step * np.arange(1, len(times_ns) + 1) // len(times_ns)

    def _watch(self, first: int, last: int, count: int, now: float) -> None:
        if now - self._at > _GAP_S:
            return self._begin(now, last)
        step, passed = last - self._newest, now - self._at
        jumps = step < -BACK_NS or step > 1e9 * (passed + 1.0)
        self._messages, self._jumps, self._at = self._messages + 1, self._jumps + jumps, now
        self._moved += 0 if jumps else max(step, 0)
        self._spans += last - first if count > 1 else step
        self._newest = last if jumps else max(last, self._newest)
        if now - self._since >= _WINDOW_S and self._messages >= _LEAST_MESSAGES:
            self._judge(now)
            self._begin(now, last)
        return None

    def _judge(self, now: float) -> None:
        wrong, scale = self._verdict(1e-9 * self._moved / (now - self._since))
        self._flat = self._spans < _FLAT * self._moved
        if scale == self._scale:
            return
        self.is_changed, self._scale, self._before = True, scale, None
        self._origin, self._origin_ns = self._newest, round(1e9 * now)
        self._say(scale, wrong)

    def _verdict(self, rate: float) -> tuple[str, int | None]:
        """What is wrong, and the unit of the times in ns; None: they say nothing. rate: their seconds to a real one."""
        by_arrival = "each message is taken as measured when it came"
        if self._jumps > _MANY * self._messages:
            return f"go back and forth ({self._jumps} jumps in {self._messages} messages): {by_arrival}", None
        if self._moved == 0:
            return f"stand still at {self._newest} ns: {by_arrival}", None
        if rate >= _SLOW:
            return "go on as they should", 1
        unit = {-3: "microseconds", -6: "milliseconds"}.get(power := round(math.log10(rate)))
        if unit is None:
            return f"go on {1 / rate:.0f} times too slowly: {by_arrival}", None
        return f"go on {1 / rate:.0f} times too slowly, as {unit} do: they are taken as {unit}", 10**-power

    def _say(self, kind: object, text: str) -> None:
        """Once of each kind."""
        if kind not in self._said:
            self._said.add(kind)
            say(f"LiDAR: the points' times {text}")
