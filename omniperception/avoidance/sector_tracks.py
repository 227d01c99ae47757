"""How obstacles move, from the nearest places by sector of successive frames: clusters, matched and filtered."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from omniperception.avoidance.sector_motion import nothing_near
from omniperception.common.rotations import rotate_yaw


@dataclass(frozen=True)
class TracksConfig:
    """How frames are matched.

    Attributes:
        period_s: s, from frame to frame.
        link: places of neighbouring sectors at most this far (m) apart belong to one cluster.
        gate: a cluster is the one of the frame before that would by now be nearest to it, if within this (m).
        widest: clusters that reach farther (m) from their middle stand still: walls, whose middle moves with the view.
        beta: least gain of the velocity filter; it starts as the least-squares line through all frames so far.
        min_frames: matches before a cluster has a velocity.
        min_speed: slower ones (m/s) stand still: what range noise makes of standing ones.
        max_speed: bound of speeds (m/s).
        remember: frames for which a place that is not seen any more still counts.
        blind: those nearer than this (m) count for `remember_near` frames: the sensor sees little of what is close.
        remember_near: see `blind`.
    """

    period_s: float = 0.1
    link: float = 0.35
    gate: float = 0.5
    widest: float = 0.6
    beta: float = 0.15
    min_frames: int = 2
    min_speed: float = 0.35
    max_speed: float = 2.5
    remember: int = 1
    blind: float = 0.8
    remember_near: int = 10


class SectorTracks:
    """Nearest obstacles by sector with their velocities, over frames.

    All tensors are in the yaw-aligned frame of the base at the newest frame and hold 2 S tracks: the clusters of the
    newest frame and those of the one before that it did not match.
    """

    def __init__(self, config: TracksConfig, num_envs: int, num_sectors: int, device: torch.device) -> None:
        self.config, self._sectors = config, num_sectors
        self._pos = torch.zeros(num_envs, 2 * num_sectors, 2, device=device)
        self._vel = torch.zeros_like(self._pos)
        self._age = torch.full(self._pos.shape[:2], -1, device=device)  # matches so far; -1: no track
        self.motion = nothing_near(num_envs, num_sectors, device)
        self._place = torch.zeros(num_envs, num_sectors, 2, device=device)
        self._unseen = torch.zeros(num_envs, num_sectors, dtype=torch.int64, device=device)

    def reset(self, ended: torch.Tensor) -> None:
        """Forgets everything in environments (n,) bool."""
        self._age = self._age.masked_fill(ended[:, None], -1)
        self.motion = torch.where(ended[:, None, None], nothing_near(1, self._sectors, ended.device), self.motion)

    def update(
        self, distance: torch.Tensor, place: torch.Tensor, moved: torch.Tensor, fresh: torch.Tensor
    ) -> torch.Tensor:
        """Takes in a frame.

        Args:
            distance: (n, S) m, infinite without an obstacle.
            place: (n, S, 2) m.
            moved: (n, 3) own motion since the frame before: x, y (m) and yaw (rad), in that one's frame.
            fresh: (n,) bool: which have a new frame; the others' obstacles go on as they did.

        Returns:
            (n, S, 3) distance (m, infinite without an obstacle) and velocity (m/s).
        """
        self._move(moved)
        distance = torch.where(fresh[:, None], distance, math.inf)
        label = self._clusters(distance, place)
        velocity = self._match(distance, place, label, fresh)
        self._merge(distance, place, velocity)
        return self.motion

    def _move(self, moved: torch.Tensor) -> None:
        """Tracks and remembered places as they would be seen now."""
        dt, back, turn = self.config.period_s, moved[:, None, :2], -moved[:, 2]
        self._pos = rotate_yaw(turn, self._pos + dt * self._vel - back)
        self._vel = rotate_yaw(turn, self._vel)
        velocity = self.motion[..., 1:]
        self._place = rotate_yaw(turn, self._place + dt * velocity - back)
        self.motion = torch.cat((self.motion[..., :1], rotate_yaw(turn, velocity)), -1)

    def _clusters(self, distance: torch.Tensor, place: torch.Tensor) -> torch.Tensor:
        """(n, S) int64 cluster of each sector; neighbours on either side of the ring's ends belong together too."""
        seen = distance.isfinite()
        apart = (place - place.roll(1, 1)).norm(dim=-1) > self.config.link
        linked = seen & seen.roll(1, 1) & ~apart  # to the sector before
        label = (~linked).long().cumsum(1).clamp(max=self._sectors - 1)
        closes = linked[:, :1] & (label == label[:, -1:])
        return torch.where(closes, label[:, :1], label)

    def _match(
        self, distance: torch.Tensor, place: torch.Tensor, label: torch.Tensor, fresh: torch.Tensor
    ) -> torch.Tensor:
        """(n, S, 2) velocities of the sectors' clusters, which become the tracks."""
        config, seen = self.config, distance.isfinite()
        members = _sums(seen.float(), label)
        exists = members > 0
        middle = torch.stack([_sums(torch.where(seen, x, 0.0), label) for x in place.unbind(-1)], -1)
        middle = middle / members.clamp(min=1.0)[..., None]
        off = torch.where(seen, (place - middle.gather(1, _pairs(label))).norm(dim=-1), 0.0)
        extent = torch.zeros_like(off).scatter_reduce_(1, label, off, "amax")
        gap = torch.cdist(middle, self._pos).masked_fill((self._age < 0)[:, None], math.inf)
        nearest, track = gap.min(2)
        matched = exists & (nearest < config.gate)
        expected, before = self._pos.gather(1, _pairs(track)), self._vel.gather(1, _pairs(track))
        matches = torch.where(matched, self._age.gather(1, track) + 1, 0)
        alpha, beta = _gains(matches, config.beta)
        error = torch.where(matched[..., None], middle - expected, 0.0)
        pos = torch.where(matched[..., None], expected + alpha[..., None] * error, middle)
        vel = torch.where(matched[..., None], before + (beta / config.period_s)[..., None] * error, 0.0)
        age = torch.where(exists, matches, -1)
        self._keep(pos, vel, age, track, matched, fresh)
        speed = vel.norm(dim=-1)
        moves = (extent < config.widest) & (matches >= config.min_frames) & (speed > config.min_speed)
        vel = vel * (moves * (config.max_speed / speed.clamp(min=config.max_speed)))[..., None]
        return vel.gather(1, _pairs(label))

    def _keep(
        self,
        pos: torch.Tensor,
        vel: torch.Tensor,
        age: torch.Tensor,
        track: torch.Tensor,
        matched: torch.Tensor,
        fresh: torch.Tensor,
    ) -> None:
        """The clusters become tracks, beside the unmatched ones of the frame before."""
        taken = torch.zeros_like(self._age).scatter_reduce_(1, track, matched.long(), "amax").bool()
        s = self._sectors
        left = torch.where(taken[:, :s], -1, self._age[:, :s])
        kept = torch.cat((pos, self._pos[:, :s]), 1), torch.cat((vel, self._vel[:, :s]), 1), torch.cat((age, left), 1)
        self._pos = torch.where(fresh[:, None, None], kept[0], self._pos)
        self._vel = torch.where(fresh[:, None, None], kept[1], self._vel)
        self._age = torch.where(fresh[:, None], kept[2], self._age)

    def _merge(self, distance: torch.Tensor, place: torch.Tensor, velocity: torch.Tensor) -> None:
        """The nearest by sector of what is seen now and what is remembered."""
        config, s = self.config, self._sectors
        was, age = self._place.norm(dim=-1), self._unseen + 1
        lasts = age <= torch.where(was < config.blind, config.remember_near, config.remember)
        was = torch.where(self.motion[..., 0].isfinite() & lasts, was, math.inf)
        far = torch.cat((distance, was), 1)
        places, speeds = torch.cat((place, self._place), 1), torch.cat((velocity, self.motion[..., 1:]), 1)
        ages = torch.cat((torch.zeros_like(age), age), 1)
        turned = (torch.atan2(places[..., 1], places[..., 0]) + math.pi) * (s / (2.0 * math.pi))
        sector = turned.long().clamp(0, s - 1)
        nearest = far.new_full((len(far), s), math.inf).scatter_reduce_(1, sector, far, "amin")
        wins = far.isfinite() & (far <= nearest.gather(1, sector))
        who = torch.zeros_like(sector[:, :s]).scatter_reduce_(
            1, sector, torch.where(wins, torch.arange(2 * s, device=far.device), 0), "amax"
        )
        self._place, self._unseen = places.gather(1, _pairs(who)), ages.gather(1, who)
        speeds = torch.where(nearest.isfinite()[..., None], speeds.gather(1, _pairs(who)), 0.0)
        self.motion = torch.cat((nearest[..., None], speeds), -1)


def _gains(matches: torch.Tensor, least: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Gains of position and velocity of a line fitted to `matches` + 1 frames, until the latter falls to `least`."""
    k = matches.float().clamp(min=1.0)
    beta = (6.0 / ((k + 1.0) * (k + 2.0))).clamp(max=1.0)
    alpha = (2.0 * (2.0 * k + 1.0) / ((k + 1.0) * (k + 2.0))).clamp(max=1.0)
    steady = math.sqrt(2.0 * least) - 0.5 * least  # critically damped
    return alpha.clamp(min=steady), beta.clamp(min=least)


def _pairs(index: torch.Tensor) -> torch.Tensor:
    """(n, k, 2) index of both coordinates."""
    return index[..., None].expand(-1, -1, 2)


def _sums(values: torch.Tensor, label: torch.Tensor) -> torch.Tensor:
    """(n, S) sums by label."""
    return torch.zeros_like(values).scatter_add_(1, label, values)
