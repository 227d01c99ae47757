"""Velocities from frames of nearest places by sector: circles that move and stand, seen from a base that walks."""

import math

import pytest
import torch

from omniperception.avoidance.sector_motion import sector_bearings
from omniperception.avoidance.sector_tracks import SectorTracks, TracksConfig, _Clusters

S, PERIOD = 72, 0.1
CONFIG = TracksConfig()


def seen(*circles):
    """(1, S) distance and (1, S, 2) place where the sectors' middles meet circles (x, y, radius) around the origin."""
    bearings = sector_bearings(S).double()
    distance = torch.full((S,), math.inf, dtype=torch.float64)
    for x, y, radius in circles:
        along = bearings @ torch.tensor([x, y], dtype=torch.float64)
        under = along**2 - (x * x + y * y - radius**2)
        hit = torch.where((under > 0) & (along > 0), along - under.clamp(min=0).sqrt(), math.inf)
        distance = torch.minimum(distance, hit)
    place = torch.where(distance.isfinite(), distance, 0.0)[:, None] * bearings
    return distance[None].float(), place[None].float()


def as_seen(x, y, pose):
    """A place of the world from a base at `pose` (x, y, yaw)."""
    dx, dy, (cos, sin) = x - pose[0], y - pose[1], (math.cos(pose[2]), math.sin(pose[2]))
    return cos * dx + sin * dy, -sin * dx + cos * dy


class Walk:
    """A base that walks straight and turns, and tracks that follow it."""

    def __init__(self, speed=(0.0, 0.0), turn=0.0, config=CONFIG):
        self.tracks = SectorTracks(config, 1, S, PERIOD, torch.device("cpu"))
        self.speed, self.turn, self.pose, self.time = speed, turn, (0.0, 0.0, 0.0), 0.0

    def frame(self, *movers, fresh=True):
        """Five control steps and a frame of movers (x, y, radius, v_x, v_y) in the world; the tracks' (S, 3) motion."""
        for _ in range(5):
            dt, (vx, vy), yaw = PERIOD / 5, self.speed, self.pose[2]
            moved = vx * dt, vy * dt, self.turn * dt
            ahead = (
                math.cos(yaw) * moved[0] - math.sin(yaw) * moved[1],
                math.sin(yaw) * moved[0] + math.cos(yaw) * moved[1],
            )
            self.pose = self.pose[0] + ahead[0], self.pose[1] + ahead[1], yaw + moved[2]
            self.time += dt
            self.tracks.advance(torch.tensor([moved]), dt)
        now = [(x + vx * self.time, y + vy * self.time, radius) for x, y, radius, vx, vy in movers]
        circles = [(*as_seen(x, y, self.pose), radius) for x, y, radius in now]
        self.tracks.update(*seen(*circles), torch.tensor([fresh]))
        return self.tracks.motion()[0]


def around(motion):
    """Mean velocity (2,) over the sectors with an obstacle."""
    known = motion[:, 0].isfinite()
    return motion[known, 1:].mean(0)


@pytest.mark.parametrize("turn", [0.0, 1.0])
def test_what_stands_stands_from_a_base_that_walks(turn):
    walk = Walk((0.8, 0.1), turn)
    for frame in range(14):
        motion = walk.frame((2.5, 0.8, 0.25, 0, 0), (-1.5, 1.5, 0.2, 0, 0))
        assert not motion[:, 1:].any() or frame <= CONFIG.look_back
    expected = seen((*as_seen(2.5, 0.8, walk.pose), 0.25), (*as_seen(-1.5, 1.5, walk.pose), 0.2))[0][0]
    there = expected.isfinite()
    torch.testing.assert_close(motion[there, 0], expected[there], atol=1e-4, rtol=0.0)


@pytest.mark.parametrize("turn", [0.0, -0.6])
@pytest.mark.parametrize("velocity", [(-1.2, 0.0), (0.3, -0.9), (0.0, 2.0)])
def test_velocity_of_what_moves(velocity, turn):
    walk = Walk((0.3, 0.0), turn)
    for _ in range(10):
        motion = walk.frame((2.2, 0.5, 0.3, *velocity))
    yaw = walk.pose[2]
    true = torch.tensor(as_seen(*velocity, (0.0, 0.0, yaw)))
    assert (around(motion) - true).norm() < 0.3 * true.norm()  # what is seen of it has another middle


def test_the_first_frames_have_no_velocity():
    walk = Walk()
    for _ in range(CONFIG.min_frames):
        assert not walk.frame((2.0, 0.0, 0.3, -1.0, 0.0))[:, 1:].any()


def test_a_wall_stands_however_it_is_seen():
    """Beside a base that walks along it, the middle of what is seen of it walks along."""
    walk = Walk((1.0, 0.0))
    for _ in range(10):
        motion = walk.frame((walk.pose[0] + 0.1, 20.8, 20.0, 0, 0))
    near = motion[:, 0] < 1.5  # beyond, neighbouring sectors see it at places far apart
    assert near.sum() > 15 and not motion[near, 1:].any()


def test_a_lost_frame_lets_things_go_on():
    walk = Walk()
    for _ in range(10):
        before = walk.frame((2.5, 0.0, 0.3, -1.0, 0.0))
    after = walk.frame(fresh=False)
    assert abs((before[:, 0].min() - after[:, 0].min()) - 0.1) < 0.02
    torch.testing.assert_close(around(after), around(before))


def test_any_number_of_lost_frames_ages_nothing():
    walk, far = Walk(), (2.0, 0.0, 0.1, 0.0, 0.0)
    first = walk.frame(far)
    for _ in range(3):
        kept = walk.frame(fresh=False)
    torch.testing.assert_close(kept, first)
    assert walk.frame()[:, 0].isfinite().any() and not walk.frame()[:, 0].isfinite().any()  # as without a loss


def test_what_is_near_is_remembered_and_what_is_far_is_not():
    walk = Walk()
    walk.frame((0.6, 0.0, 0.1, 0, 0), (0.0, 2.0, 0.1, 0, 0))
    counts = [int(walk.frame()[:, 0].isfinite().sum()) for _ in range(CONFIG.remember_near + 2)]
    assert counts[0] > counts[CONFIG.remember] > 0 and counts[CONFIG.remember_near - 1] > 0
    assert counts[CONFIG.remember_near] == 0


def test_between_frames_places_come_nearer():
    walk = Walk((1.0, 0.0))
    near = walk.frame((2.0, 0.0, 0.2, 0, 0))[:, 0].min()
    walk.tracks.advance(torch.tensor([[0.05, 0.0, 0.0]]), 0.05)
    assert abs(near - walk.tracks.motion()[0, :, 0].min() - 0.05) < 1e-3


def test_a_cluster_across_the_ends_of_the_ring_is_one():
    walk = Walk()
    for _ in range(10):
        motion = walk.frame((-2.5, 0.02, 0.3, 1.0, 0.0))
    known = motion[:, 0].isfinite()
    assert known[0] and known[-1]
    assert (motion[known, 1:] - motion[0, 1:]).abs().max() < 1e-6 and abs(motion[0, 1] - 1.0) < 0.15


@pytest.mark.parametrize("first", [0, 5, S - 2])
def test_places_apart_are_clusters_apart_wherever_they_are(first):
    seen, distance = torch.zeros(1, S, dtype=torch.bool), torch.tensor([1.0, 3.0])
    place = torch.zeros(1, S, 2)
    seen[0, first : first + 2], place[0, first : first + 2, 0] = True, distance
    clusters = _Clusters(place, seen, torch.tensor(0.5))
    assert clusters.label[0, first] != clusters.label[0, first + 1]
    assert clusters.exists.sum() == 2 and clusters.extent.max() == 0.0


def test_resetting_an_environment_leaves_the_others():
    tracks = SectorTracks(CONFIG, 2, S, PERIOD, torch.device("cpu"))
    for k in range(5):
        distance, place = seen((2.0 - 0.1 * k, 0.0, 0.3))
        tracks.update(distance.repeat(2, 1), place.repeat(2, 1, 1), torch.ones(2, dtype=torch.bool))
    before = tracks.motion()
    tracks.reset(torch.tensor([True, False]))
    after = tracks.motion()
    assert after[0, :, 0].isinf().all() and not after[0, :, 1:].any() and torch.equal(after[1], before[1])
    distance, place = seen((1.5, 0.0, 0.3))
    tracks.update(distance.repeat(2, 1), place.repeat(2, 1, 1), torch.ones(2, dtype=torch.bool))
    assert not tracks.motion()[0, :, 1:].any() and tracks.motion()[1, :, 1:].any()
