"""How obstacles move, from the nearest places by sector of successive frames: clusters, matched and filtered."""

from __future__ import annotations

import math

import torch
from torch.nn import functional

from omniperception.common.checked import AtLeastOne, Count, NonNegative, Positive, checked
from omniperception.common.rotations import rotate_yaw
from omniperception.common.sectors import FAR, sector_of, sums_by


@checked("TracksConfig")
class TracksConfig:
    """How frames are matched; the values were chosen on split=dev, see docs/lab/worlds.md.

    Attributes:
        link: places of neighbouring sectors belong to one cluster where they are at most this (m) and the width of a
            sector there apart.
        gate: a cluster is the one of the frame before that would by now be nearest to it, if within this (m).
        widest: clusters that reach farther (m) from their middle stand still: walls, whose middle moves with the view.
        gain: least gain of the velocity's filter, which starts as the straight line through all frames so far.
        turn: a cluster this far (m) off has turned, and its filter restarts.
        min_frames: matches before a cluster has a velocity.
        min_speed, max_speed: slower ones (m/s) stand still, faster ones move at this speed.
        look_back: frames after which a place that is taken again, to the width of a sector there, shows that something
            stands there.
        stands: a cluster stands still where this share of its places was taken.
        remember: frames for which a place that is not seen any more still counts.
        blind, remember_near: those nearer than `blind` (m) count for `remember_near` frames, because the sensor sees
            little of what is close.
    """

    link: NonNegative = 0.1
    gate: Positive = 0.5
    widest: Positive = 0.6
    gain: Positive = 0.1
    turn: Positive = 0.35
    min_frames: Count = 2
    min_speed: NonNegative = 0.3
    max_speed: Positive = 2.5
    look_back: AtLeastOne = 5
    stands: Positive = 0.95
    remember: Count = 1
    blind: NonNegative = 0.8
    remember_near: Count = 10


class SectorTracks:
    """Nearest obstacles by sector with their velocities, over frames: `advance` at each control step, `update` at each
    frame.

    All places are in the yaw-aligned frame of the base as it is now. There are 2 S tracks: the clusters of the newest
    frame, and those of the one before that it did not match.
    """

    def __init__(
        self, config: TracksConfig, num_envs: int, num_sectors: int, period_s: float, device: torch.device
    ) -> None:
        """Args: config: settings; num_sectors: S; period_s: s, from frame to frame."""
        self.config, self._sectors, self._period = config, num_sectors, period_s
        self._pos = torch.zeros(num_envs, 2 * num_sectors, 2, device=device)
        self._vel = torch.zeros_like(self._pos)
        self._matches = torch.full(self._pos.shape[:2], -1, device=device)  # -1: no track
        self._past = torch.full((num_envs, config.look_back, num_sectors, 2), FAR, device=device)
        self._place = torch.full((num_envs, num_sectors, 2), FAR, device=device)  # what counts as an obstacle
        self._place_vel = torch.zeros_like(self._place)
        self._unseen = torch.zeros(num_envs, num_sectors, dtype=torch.int64, device=device)

    def reset(self, ended: torch.Tensor) -> None:
        """Forgets everything in environments (n,) bool."""
        self._matches = self._matches.masked_fill(ended[:, None], -1)
        self._past = self._past.masked_fill(ended[:, None, None, None], FAR)
        self._place = self._place.masked_fill(ended[:, None, None], FAR)

    def advance(self, moved: torch.Tensor, dt: float) -> None:
        """Takes in that the base has moved by (n, 3) x, y (m), yaw (rad), in its frame before, in `dt` (s)."""
        back, turn = moved[:, None, :2], -moved[:, 2]
        self._pos = rotate_yaw(turn, self._pos + dt * self._vel - back)
        self._vel = rotate_yaw(turn, self._vel)
        self._past = rotate_yaw(turn, self._past - back[:, None])
        self._place = rotate_yaw(turn, self._place + dt * self._place_vel - back)
        self._place_vel = rotate_yaw(turn, self._place_vel)

    def motion(self) -> torch.Tensor:
        """(n, S, 3) distance (m, infinite without an obstacle) and velocity (m/s) of the nearest by sector, now."""
        distance = self._place.norm(dim=-1)
        nearest, who = _nearest(self._place, distance, self._sectors)
        velocity = torch.where(nearest.isfinite()[..., None], self._place_vel.gather(1, _pairs(who)), 0.0)
        return torch.cat((nearest[..., None], velocity), -1)

    def update(self, distance: torch.Tensor, place: torch.Tensor, fresh: torch.Tensor) -> None:
        """Takes in a frame.

        Args:
            distance: (n, S) m, infinite without an obstacle.
            place: (n, S, 2) m.
            fresh: (n,) bool: which have a new frame; the others' obstacles go on as they did.
        """
        distance = torch.where(fresh[:, None], distance, math.inf)
        seen = distance.isfinite()
        place = torch.where(seen[..., None], place, FAR)
        clusters = _Clusters(place, seen, self.config.link + self._width(distance))
        velocity = self._match(clusters, fresh)
        moves = (clusters.extent < self.config.widest) & ~self._stands(clusters, distance)
        self._past = torch.where(
            fresh[:, None, None, None], torch.cat((self._past[:, 1:], place[:, None]), 1), self._past
        )
        velocity = (velocity * moves[..., None]).gather(1, _pairs(clusters.label))
        self._merge(distance, place, velocity, self._unseen + fresh[:, None])

    def _width(self, distance: torch.Tensor) -> torch.Tensor:
        """(n, S) m: width of sectors at a distance (m)."""
        return 2.0 * math.pi / self._sectors * distance.clamp(max=FAR)

    def _match(self, clusters: _Clusters, fresh: torch.Tensor) -> torch.Tensor:
        """(n, S, 2) velocities of the clusters, which become the tracks."""
        config = self.config
        gap = torch.cdist(clusters.middle, self._pos).masked_fill((self._matches < 0)[:, None], math.inf)
        nearest, track = gap.min(2)
        matched = clusters.exists & (nearest < config.gate)
        expected, before = self._pos.gather(1, _pairs(track)), self._vel.gather(1, _pairs(track))
        error = torch.where(matched[..., None], clusters.middle - expected, 0.0)
        matches = torch.where(matched, self._matches.gather(1, track) + 1, 0)
        matches = torch.where(nearest > config.turn, matches.clamp(max=2), matches)
        alpha, beta = _gains(matches, config.gain)
        pos = torch.where(matched[..., None], expected + alpha[..., None] * error, clusters.middle)
        vel = torch.where(matched[..., None], before + (beta / self._period)[..., None] * error, 0.0)
        taken = torch.zeros_like(self._matches).scatter_reduce_(1, track, matched.long(), "amax")
        s = self._sectors
        left = torch.where(taken[:, :s] > 0, -1, self._matches[:, :s])
        tracks = (pos, self._pos[:, :s]), (vel, self._vel[:, :s]), (torch.where(clusters.exists, matches, -1), left)
        self._pos = torch.where(fresh[:, None, None], torch.cat(tracks[0], 1), self._pos)
        self._vel = torch.where(fresh[:, None, None], torch.cat(tracks[1], 1), self._vel)
        self._matches = torch.where(fresh[:, None], torch.cat(tracks[2], 1), self._matches)
        speed = vel.norm(dim=-1)
        moves = (matches >= config.min_frames) & (speed > config.min_speed)
        return vel * (moves * (config.max_speed / speed.clamp(min=config.max_speed)))[..., None]

    def _stands(self, clusters: _Clusters, distance: torch.Tensor) -> torch.Tensor:
        """(n, S) bool: clusters most of whose places were taken `look_back` frames ago."""
        off = torch.cdist(clusters.place, self._past[:, 0]).amin(2)
        near = off < self._width(distance)
        stood = sums_by(clusters.label, (clusters.seen & near).float(), self._sectors)
        return stood >= self.config.stands * clusters.members

    def _merge(self, distance: torch.Tensor, place: torch.Tensor, velocity: torch.Tensor, age: torch.Tensor) -> None:
        """The nearest by sector of what is seen now and what is remembered, of `age` (n, S) frames ago."""
        config, was = self.config, self._place.norm(dim=-1)
        there = distance.gather(1, sector_of(self._place, self._sectors))
        is_near = was < config.blind
        lasts = age <= torch.where(is_near, config.remember_near, config.remember)
        lasts &= torch.where(is_near, there > was + config.link, there.isinf())  # nothing is seen in its stead
        places = torch.cat((place, self._place), 1)
        ages = torch.cat((torch.zeros_like(age), age), 1)
        far = torch.cat((distance, torch.where(lasts, was, math.inf)), 1)
        nearest, who = _nearest(places, far, self._sectors)
        self._place = torch.where(nearest.isfinite()[..., None], places.gather(1, _pairs(who)), FAR)
        self._place_vel = torch.cat((velocity, self._place_vel), 1).gather(1, _pairs(who))
        self._unseen = ages.gather(1, who)


class _Clusters:
    """Places of neighbouring sectors that are close to each other.

    Attributes:
        place, seen: (n, S, 2) and (n, S), as given.
        label: (n, S) int64: cluster of each sector; the numbers are below S.
        members, exists, middle, extent: (n, S), (n, S) bool, (n, S, 2) m, (n, S) m by cluster: sectors, whether there
            are any, their mean place, and the largest distance from it.
    """

    def __init__(self, place: torch.Tensor, seen: torch.Tensor, link: torch.Tensor) -> None:
        self.place, self.seen = place, seen
        apart = (place - place.roll(1, 1)).norm(dim=-1) > link
        linked = seen & seen.roll(1, 1) & ~apart  # to the sector before
        label = functional.pad((~linked[:, 1:]).long().cumsum(1), (1, 0))
        self.label = torch.where(linked[:, :1] & (label == label[:, -1:]), 0, label)  # closes the ring
        self.members = sums_by(self.label, seen.float(), seen.shape[1])
        self.exists = self.members > 0
        total = torch.stack(
            [sums_by(self.label, torch.where(seen, x, 0.0), seen.shape[1]) for x in place.unbind(-1)], -1
        )
        self.middle = total / self.members.clamp(min=1.0)[..., None]
        off = (place - self.middle.gather(1, _pairs(self.label))).norm(dim=-1)
        self.extent = torch.zeros_like(off).scatter_reduce_(1, self.label, torch.where(seen, off, 0.0), "amax")


def _gains(matches: torch.Tensor, least: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Gains of position and velocity of a line fitted to `matches` + 1 frames, until the latter falls to `least`."""
    k = matches.float().clamp(min=1.0)
    alpha = 2.0 * (2.0 * k + 1.0) / ((k + 1.0) * (k + 2.0))
    beta = 6.0 / ((k + 1.0) * (k + 2.0))
    steady = math.sqrt(2.0 * least) - 0.5 * least
    return alpha.clamp(min=steady, max=1.0), beta.clamp(min=least, max=1.0)


def _nearest(places: torch.Tensor, distance: torch.Tensor, num_sectors: int) -> tuple[torch.Tensor, torch.Tensor]:
    """(n, S) distance to the nearest of places (n, k, 2) by sector, infinite without one, and which it is, int64.

    Args:
        places: (n, k, 2) m.
        distance: (n, k) m; `FAR` and beyond, for what is not there.
        num_sectors: S.
    """
    distance = torch.where(distance < 0.5 * FAR, distance, math.inf)
    sector = sector_of(places, num_sectors)
    nearest = distance.new_full((len(distance), num_sectors), math.inf).scatter_reduce_(1, sector, distance, "amin")
    wins = distance.isfinite() & (distance <= nearest.gather(1, sector))
    index = torch.arange(distance.shape[1], device=distance.device)
    who = torch.zeros_like(nearest, dtype=torch.int64)
    return nearest, who.scatter_reduce_(1, sector, torch.where(wins, index, 0), "amax")


def _pairs(index: torch.Tensor) -> torch.Tensor:
    """(n, k, 2) index of both coordinates."""
    return index[..., None].expand(-1, -1, 2)
