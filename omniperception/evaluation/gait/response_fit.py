"""First-order lag, dead time and wandering error of a velocity under an asked one, of many robots at once."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch

from omniperception.sim.response import AXES, AxisResponse

DELAYS = torch.arange(0.0, 0.205, 0.01, dtype=torch.float64)
LAGS = torch.logspace(math.log10(0.01), math.log10(0.6), 32, dtype=torch.float64)
"""Dead times and time constants (s) that are tried."""
SETTLES_S = 1.0
"""Time (s) before and after the end of an episode that is left out."""
BLOCK_S, SMOOTHED_S = 2.0, 0.1
"""Length (s) of the pieces that are dealt to two halves of the data, and over which accelerations are smoothed."""


@dataclass(frozen=True)
class Fit:
    """What explains the velocities of n robots best: gain * x + offset, where x is the asked velocity late and lagged.

    Attributes:
        gain, offset, delay, lag: (n, 3): factor, m/s or rad/s, s, s; by robot and AXES.
    """

    gain: torch.Tensor
    offset: torch.Tensor
    delay: torch.Tensor
    lag: torch.Tensor


def fit(
    asked: torch.Tensor, velocity: torch.Tensor, done: torch.Tensor, dt: float, frequency: float
) -> tuple[dict[str, AxisResponse], torch.Tensor]:
    """The response of each axis, and the velocities that it predicts (T, n, 3) without the wandering error.

    Standard deviations between robots are those of what two halves of a robot's data agree on (their covariance over
    robots), so that the scatter of the estimates is not in them. The wandering error has the variance of all that is
    not explained, swinging with the steps included, and a time so short that the error's mean over a period of the gait
    varies as it does, which swinging brings nowhere: robots get as far astray.

    Args:
        asked, velocity: (T, n, 3) m/s, m/s, rad/s: asked for during each control step, and reached at its end.
        done: (T, n) bool: whose episode ended in the step; asked velocity and robot begin at 0 again.
        dt: control step (s).
        frequency: of the gait (Hz); 0: the period is taken for 0.4 s.

    Raises:
        ValueError: fewer than two robots walked long enough between their falls.
    """
    asked, velocity, keep = asked.double(), velocity.double(), kept(done, round(SETTLES_S / dt))
    half = (torch.arange(len(asked)) // round(BLOCK_S / dt)) % 2
    sums = _sums(asked, velocity, done, keep, half, dt)
    long_enough = torch.stack([keep[half == k].sum(0) * dt >= BLOCK_S for k in range(2)]).all(0)
    if int(long_enough.sum()) < 2:
        raise ValueError("fewer than two robots walked long enough without a fall to be measured")
    halves, whole = [_best(one) for one in sums], _best([a + b for a, b in zip(*sums, strict=True)])
    predicted = torch.stack(list(lagged(asked, done, dt, whole.delay, whole.lag))) * whole.gain + whole.offset
    keep &= long_enough
    noise = wander(velocity - predicted, keep, round(1 / ((frequency or 2.5) * dt)), dt)
    acceleration = _acceleration(velocity, keep, dt)
    axes = {}
    for k, name in enumerate(AXES):
        pairs = {}
        for key in ("gain", "lag", "delay", "offset"):
            mean = getattr(whole, key)[long_enough, k].mean()
            a, b = (getattr(one, key)[long_enough, k] for one in halves)
            shared = ((a - a.mean()) * (b - b.mean())).mean().clamp(min=0.0).sqrt()
            pairs[key] = float(mean), float(shared)
        pairs |= {"lag_s": pairs.pop("lag"), "delay_s": pairs.pop("delay")}
        axes[name] = AxisResponse(**pairs, acceleration=acceleration[k], noise=noise[k][0], noise_s=noise[k][1])
    return axes, predicted


def kept(done: torch.Tensor, steps: int) -> torch.Tensor:
    """(T, n) bool: whose episode began more than `steps` ago and ends more than `steps` later, from `done` (T, n)."""
    ended = torch.cat((torch.ones_like(done[:1]), done)).T[:, None].float()  # the recording begins with an episode
    near = torch.nn.functional.max_pool1d(ended, 2 * steps + 1, 1, steps)[:, 0, 1:]
    return near.T == 0


def lagged(
    asked: torch.Tensor, done: torch.Tensor, dt: float, delay: torch.Tensor, lag: torch.Tensor
) -> Iterator[torch.Tensor]:
    """The asked velocity (T, n, 3) through dead times and first-order lags, (..., n, 3) at the end of each step.

    Args:
        asked: held for one step each.
        done: (T, n) bool: in which steps it begins at 0 again.
        dt: control step (s).
        delay, lag: s, broadcastable to (..., n, 3).
    """
    whole = (delay / dt + 1e-9).floor().long()
    share, decay = delay / dt - whole, torch.exp(-dt / lag)
    before = int(whole.max()) + 1
    padded = torch.cat((torch.zeros(before, *asked.shape[1:], dtype=asked.dtype), asked))
    robots, axes = torch.arange(asked.shape[1])[:, None], torch.arange(asked.shape[2])
    x = torch.zeros(torch.broadcast_shapes(delay.shape, lag.shape, asked.shape[1:]), dtype=asked.dtype)
    for k in range(len(asked)):
        at = k + before - whole
        late = torch.lerp(padded[at, robots, axes], padded[at - 1, robots, axes], share)
        x = late + decay * (x - late)
        yield x
        if bool(done[k].any()):
            x = x * ~done[k, :, None]


def _sums(
    asked: torch.Tensor, velocity: torch.Tensor, done: torch.Tensor, keep: torch.Tensor, half: torch.Tensor, dt: float
) -> list[list[torch.Tensor]]:
    """Of each half of the data: how much there is (n, 1), sums of v and v^2 (n, 3), and sums of x, x^2 and x * v
    (delays, lags, n, 3), where x is the lagged velocity."""
    delay, lag = DELAYS[:, None, None, None], LAGS[:, None, None]
    weight = [(keep & (half == k)[:, None]).double()[..., None] for k in range(2)]
    of_v = [[w.sum(0), (w * velocity).sum(0), (w * velocity.square()).sum(0)] for w in weight]
    shape = (len(DELAYS), len(LAGS), *asked.shape[1:])
    of_x = [[torch.zeros(shape, dtype=torch.float64) for _ in range(3)] for _ in range(2)]
    for k, x in enumerate(lagged(asked, done, dt, delay, lag)):
        w, v = weight[half[k]][k], velocity[k]
        first, second, mixed = of_x[half[k]]
        first.addcmul_(x, w)
        second.addcmul_(x * x, w)
        mixed.addcmul_(x, w * v)
    return [own + rest for own, rest in zip(of_v, of_x, strict=True)]


def _best(sums: list[torch.Tensor]) -> Fit:
    """Least squares over gain and offset in closed form, over delay and lag by trying all."""
    n, v, vv, x, xx, xv = sums
    n = n.clamp(min=1.0)
    spread, shared, total = xx - x * x / n, xv - x * v / n, vv - v * v / n
    gain = shared / spread.clamp(min=1e-9)
    error = (total - gain * shared).flatten(0, 1)
    best = error.argmin(0, keepdim=True)
    gain, mean = (one.flatten(0, 1).gather(0, best)[0] for one in (gain, x / n))
    best = best[0]
    return Fit(gain, v / n - gain * mean, DELAYS[best // len(LAGS)], LAGS[best % len(LAGS)])


def wander(error: torch.Tensor, keep: torch.Tensor, window: int, dt: float) -> list[tuple[float, float]]:
    """Standard deviation and time (s) of an Ornstein-Uhlenbeck process that varies as much as an error (T, n, 3) does
    where it counts (T, n) bool, and whose means over `window` steps do, too; by axis."""
    means, whole = _means(error, keep, window)
    variance = error[keep].square().mean(0)
    time = torch.logspace(math.log10(dt), 1.0, 400, dtype=torch.float64)
    ratio = window * dt / time
    left = 2 / ratio - 2 / ratio**2 * -torch.expm1(-ratio)  # share of its variance that its means have
    share = means[whole].square().mean(0) / variance
    best = (left[:, None] - share).abs().argmin(0)
    return list(zip(variance.sqrt().tolist(), time[best].tolist(), strict=True))


def _means(values: torch.Tensor, keep: torch.Tensor, steps: int) -> tuple[torch.Tensor, torch.Tensor]:
    """(T - steps + 1, n, 3) means over windows, and (T - steps + 1, n) bool: whether all of one counts."""
    sums = torch.cat((torch.zeros_like(values[:1]), values)).cumsum(0)
    counts = torch.cat((torch.zeros_like(keep[:1]), keep)).long().cumsum(0)
    return (sums[steps:] - sums[:-steps]) / steps, counts[steps:] - counts[:-steps] == steps


def _acceleration(velocity: torch.Tensor, keep: torch.Tensor, dt: float) -> list[float]:
    """99th percentile of the change of the smoothed velocity per second, by axis."""
    means, whole = _means(velocity, keep, max(1, round(SMOOTHED_S / dt)))
    change = (means.diff(dim=0) / dt).abs()[whole[1:] & whole[:-1]]
    return [float(one.sort().values[int(0.99 * (len(one) - 1))]) for one in change.T]
