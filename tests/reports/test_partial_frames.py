"""Frames that hold a part of their points: what is missing is not free."""

import math

import numpy as np
import pytest
import torch

from omniperception.avoidance.coverage import Coverage, answered_bins, kept_to_covered, least_bins, levelled
from omniperception.common.random import EnvRandom
from omniperception.deploy.faults import Faults
from omniperception.env.partial_frames import PartialFrames, PartialFramesConfig
from omnirobot.common.coverage import NUM_BINS, NUM_SECTORS
from omnirobot.runtime.coverage import Coverage as RobotsCoverage
from omnirobot.runtime.sampling import Attitude
from omnirobot.wire.livox import read_points, write_points

TASK = (
    *("experiment=avoid", "terrain=flat", "obstacles=crowd", "obstacles.curriculum=null", "randomization=none"),
    *("lidar.num_rays=2000", "lidar.selection=every_kth", "lidar.period_s=0.04", "sim.num_threads=1"),
)
RAYS = 720
"""Of a ring of rays around the sensor, half a degree apart, the one ahead first."""
ANGLES = np.arange(RAYS) * math.pi / 360.0
RING = torch.tensor(np.stack((np.cos(ANGLES), np.sin(ANGLES), np.zeros(RAYS)), 1), dtype=torch.float32)


def partial(kind, num_envs=40, every_s=(0.0, 0.0), lasts_s=(1.0, 1.0)):
    config = PartialFramesConfig(every_s, lasts_s, (kind,), (90.0, 90.0), 0.1)
    frames = PartialFrames(config, 0.1, RAYS, num_envs, EnvRandom(3, num_envs).branch("partial_frames"))
    frames.reset(torch.arange(num_envs))
    return frames


def what_is_left(frames, count, num_envs=40):
    """(count, num_envs, RAYS) bool of frames that follow each other."""
    left = []
    for _ in range(count):
        frames.draw()
        ranges = torch.ones(num_envs, RAYS)
        for envs in (slice(0, 7), slice(7, num_envs)):
            frames.take_away(ranges[envs], RING.expand(num_envs, -1, -1)[envs], envs)
        left.append(ranges.isfinite())
    return torch.stack(left)


def runs(row):
    """How many contiguous parts a circle of bools has."""
    return int((row != row.roll(1)).sum()) // 2


class TestWhatIsTakenAway:
    @pytest.mark.parametrize(("kind", "share"), [("sector", 0.75), ("thin", 0.1), ("slice", 0.1), ("wedge", 0.1)])
    def test_a_share_is_left(self, kind, share):
        left = what_is_left(partial(kind), 5)
        assert left.float().mean(2).sub(share).abs().max() < 0.05
        parts = [runs(row) for row in left.flatten(0, 1)]
        assert all(part == 1 for part in parts) if kind != "thin" else min(parts) > 20

    @pytest.mark.parametrize(
        ("kind", "changes"), [("sector", False), ("thin", True), ("slice", False), ("wedge", True)]
    )
    def test_another_part_in_every_frame_or_the_same(self, kind, changes):
        left = what_is_left(partial(kind, lasts_s=(10.0, 10.0)), 4)
        assert (left[1:] != left[:-1]).any(2).float().mean() > 0.9 if changes else torch.equal(left[1:], left[:-1])

    def test_spells_begin_and_last_as_drawn(self):
        """0.5 to 1 s apart, 0.3 s long: 5 to 10 whole frames between spells of 3."""
        whole = what_is_left(partial("slice", every_s=(0.5, 1.0), lasts_s=(0.3, 0.3)), 200).all(2).T
        for row in whole.tolist():
            text = "".join(" x"[not frame] for frame in row)
            assert {len(spell) for spell in text.split()[1:-1]} == {3}
            gaps = [len(gap) for gap in text.split("xxx")[1:-1]]
            assert min(gaps) >= 5 and max(gaps) <= 10 and text.index("x") <= 10

    def test_episodes_of_others_change_nothing_and_a_state_goes_on(self):
        given = {"every_s": (0.2, 0.4), "lasts_s": (0.1, 0.5)}
        a, b = partial("wedge", **given), partial("wedge", **given)
        what_is_left(a, 5), what_is_left(b, 5)
        b.reset(torch.tensor([1]))
        left = what_is_left(a, 20), what_is_left(b, 20)
        others = torch.arange(40) != 1
        assert torch.equal(left[0][:, others], left[1][:, others])
        resumed = partial("wedge", **given)
        resumed._random.load_state_dict(a._random.state_dict())
        resumed.load_state_dict(a.state_dict())
        assert torch.equal(what_is_left(resumed, 20), what_is_left(a, 20))

    @pytest.mark.parametrize(
        ("override", "message"),
        [
            ("{every_s:[1],lasts_s:[1,2]}", "partial_frames.every_s"),
            ("{every_s:[1,2],lasts_s:[2,1]}", "partial_frames.lasts_s=[2, 1] must be [low, high]"),
            ("{every_s:[1,2],lasts_s:[1,2],kinds:[rain]}", "kinds=[rain] must be some of sector, thin, slice, wedge"),
            ("{every_s:[1,2],lasts_s:[1,2],keep:0}", "partial_frames.keep=0"),
            ("{every_s:[1,2],lasts_s:[1,2],width_deg:[0,400]}", "partial_frames.width_deg=[0, 400]"),
        ],
    )
    def test_settings_that_mean_nothing_are_refused(self, make_config, override, message):
        with pytest.raises(ValueError) as caught:
            make_config(f"randomization.partial_frames={override}")
        assert message in str(caught.value).replace("'", "") and "\n" not in str(caught.value)


def dome(step_deg=3.0):
    """Rays in all directions, unit vectors (n, 3), and their azimuth and elevation in degrees."""
    azimuth, elevation = np.meshgrid(np.arange(-178.5, 180.0, step_deg), np.arange(-88.5, 90.0, step_deg))
    azimuth, elevation = azimuth.ravel(), elevation.ravel()
    a, e = np.radians(azimuth), np.radians(elevation)
    rays = np.stack((np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)), 1)
    return torch.tensor(rays, dtype=torch.float32), azimuth, elevation


class TestCoverage:
    def test_flat_ground_says_what_is_normal(self):
        """A dome 0.5 m above the ground sees it within 2 m from 14.5 degrees down on: 13 bins; half of them are 7."""
        rays, _, _ = dome()
        level = torch.tensor([1.0, 0.0, 0.0, 0.0])
        assert least_bins(rays, level, 0.5, 2.0).tolist() == [7] * NUM_SECTORS
        ahead = rays[rays[:, 0] > 0.1]
        least = least_bins(ahead, level, 0.5, 2.0)
        assert (least[10:26] > 0).all() and not least[:8].any() and not least[28:].any()

    def test_a_sector_is_covered_by_answers_of_two_frames_at_many_elevations(self):
        """Sector 18 lies ahead, left of the middle: 0 to 10 degrees; 6 bins are needed."""
        rays, azimuth, elevation = dome()
        coverage = Coverage(1, torch.full((NUM_SECTORS,), 6))
        assert coverage.covered.all()  # before the first frame, as training begins

        def see(answered, came=True):
            ranges = torch.where(torch.tensor(answered), 1.0, math.inf)[None]
            coverage.begin_frame()
            coverage.add_frame(ranges, rays[None], torch.tensor([came]), slice(0, 1))
            return set(coverage.covered[0].nonzero().flatten().tolist())

        everywhere = set(range(NUM_SECTORS))
        ahead = (azimuth > 0) & (azimuth < 10)
        assert see(elevation < 0) == everywhere
        assert see((elevation < 0) & ~ahead) == everywhere  # one frame may lack it
        assert see((elevation < 0) & ~ahead) == everywhere - {18}
        assert see(elevation < 0, came=False) == everywhere - {18}
        assert see(elevation < 0, came=False) == set()  # two in a row did not come
        band = (elevation > -29) & (elevation < -3)  # dense, but 5 bins only
        assert see(band) == set() and see(band) == set()
        assert see(elevation < -50) == everywhere  # 7 more of the one before
        coverage.reset(torch.tensor([0]))
        assert coverage.covered.all()

    def test_the_robots_own_is_the_same(self):
        """In NumPy, on random clouds under random attitudes; misses as zeros, nan and beyond the range."""
        generator = torch.Generator().manual_seed(1)
        mount = torch.nn.functional.normalize(torch.randn(4, generator=generator), dim=0)
        least = torch.randint(0, 9, (NUM_SECTORS,), generator=generator)
        ours, theirs = Coverage(1, least), RobotsCoverage(least.tolist(), 6.0)
        seen = []
        for _ in range(12):
            rays = torch.nn.functional.normalize(torch.randn(1, 150, 3, generator=generator), dim=-1)
            ranges = 9.0 * torch.rand(1, 150, generator=generator)
            tilt = torch.tensor([[1.0, 0.0, 0.0, 0.0]]) + 0.4 * torch.randn(1, 4, generator=generator)
            quat = torch.nn.functional.normalize(tilt, dim=1)
            ours.begin_frame()
            answered = torch.where(ranges <= 6.0, ranges, math.inf)
            ours.add_frame(answered, levelled(rays, quat, mount), torch.tensor([True]), slice(0, 1))
            points = (ranges[..., None] * rays)[0].numpy()
            points[ranges[0].numpy() > 8.0] = np.nan
            points[(ranges[0].numpy() > 6.0) & (ranges[0].numpy() < 7.0)] = 0.0
            theirs.add_frame(points, Attitude(quat[0].numpy(), (0.0, 0.0, 0.0), mount.numpy()))
            assert theirs.covered.tolist() == ours.covered[0].tolist()
            seen.append(theirs.covered.copy())
            for velocity in torch.randn(5, 2, generator=generator):
                kept = kept_to_covered(velocity[None], ours.covered)[0].numpy()
                assert theirs.kept_to_covered(velocity.numpy()) == pytest.approx(kept, abs=1e-6)
        assert 0.1 < np.mean(seen) < 0.9

    def test_a_velocity_ends_before_what_is_not_covered(self):
        """Sector 27 alone, centred 95 degrees left of ahead: 0 up to 30 degrees from it, whole from 60 on; in between
        by the cosine, at 45 degrees (0.8660 - 0.7071) / (0.8660 - 0.5)."""
        covered = torch.ones(1, NUM_SECTORS, dtype=torch.bool)
        covered[0, 27] = False
        for away_deg, share in ((0, 0), (29, 0), (45, 0.4342), (61, 1), (180, 1), (-29, 0), (-61, 1)):
            angle = math.radians(95.0 + away_deg)
            velocity = 0.8 * torch.tensor([[math.cos(angle), math.sin(angle)]])
            torch.testing.assert_close(kept_to_covered(velocity, covered), share * velocity, atol=1e-4, rtol=0.0)
        nothing = torch.zeros(1, NUM_SECTORS, dtype=torch.bool)
        assert not kept_to_covered(torch.tensor([[1.0, 0.3]]), nothing).any()
        assert torch.equal(kept_to_covered(torch.zeros(1, 2), covered), torch.zeros(1, 2))

    def test_bins_are_counted_once(self):
        rays = torch.tensor([[[1.0, 0.01, 0.0], [1.0, 0.02, 0.0], [1.0, 0.01, -1.0], [-1.0, -0.01, 0.0]]])
        rays = torch.nn.functional.normalize(rays, dim=-1)
        found = answered_bins(rays, torch.tensor([[True, True, True, False]]))
        assert found.shape == (1, NUM_SECTORS, NUM_BINS)
        assert found[0].nonzero().tolist() == [[18, 7], [18, 15]]


def covered_of(env):
    return env.sensing.consumers["CoveredSectors"].coverage.covered


class TestInTheTask:
    def test_a_command_does_not_lead_where_frames_lack_points(self, make_env):
        """Whole frames leave all as it is; a sector that is lost in the direction of the command ends it."""
        lost = "randomization.partial_frames={every_s:[0,0],lasts_s:[9,9],kinds:[sector],width_deg:[120,120]}"
        never = lost.replace("[0,0]", "[900,901]")
        whole, part, plain = (make_env(*TASK, *given, num_envs=8) for given in ((never,), (lost,), ()))
        for _ in range(12):
            for env in (whole, part, plain):
                env.step(torch.zeros(8, 12))
        assert covered_of(whole).float().mean() > 0.99 and "CoveredSectors" not in plain.sensing.consumers
        assert torch.equal(plain.state.command, part.state.command)
        torch.testing.assert_close(whole.state.reference, plain.state.reference)
        covered = covered_of(part)
        assert (covered.float().mean(1) < 0.85).all() and (covered.float().mean(1) > 0.4).all()
        kept = kept_to_covered(part.state.command[:, :2], covered)
        assert torch.equal(part.state.allowed_command, torch.cat((kept, part.state.command[:, 2:]), 1))
        slower = kept.norm(dim=1) < 0.5 * part.state.command[:, :2].norm(dim=1)
        assert 0 < slower.sum() < 8

    def test_it_goes_on_from_its_state(self, make_env):
        given = ("randomization.partial_frames={every_s:[0.1,0.2],lasts_s:[0.05,0.3]}", "randomization.frames_lost=0.1")
        a, b = (make_env(*TASK, *given, num_envs=4) for _ in range(2))
        for _ in range(15):
            a.step(torch.zeros(4, 12))
        b.load_state_dict(a.state_dict())
        for _ in range(15):
            for env in (a, b):
                env.step(torch.zeros(4, 12))
            assert torch.equal(covered_of(a), covered_of(b))
            assert torch.equal(a.observations["frames"], b.observations["frames"])
            assert torch.equal(a.state.reference, b.state.reference)
        assert not covered_of(a).all()


def circle(name, times_ns):
    """What a fault leaves of packets of 36 points around the sensor, (packets, 36) bool."""
    angles = np.radians(np.arange(5.0, 360.0, 10.0))
    points = np.stack((np.cos(angles), np.sin(angles), np.zeros(36)), 1)
    faults = Faults(name, lasts_s=10.0)
    faults.begin(0.0)
    came = faults.packets(1.0, [write_points(points, at, k, 48000) for k, at in enumerate(times_ns)])
    return np.array([read_points(packet).points.any(1) for packet in came])


def test_the_wire_has_frames_in_part():
    times = np.arange(2000) * 480_000  # 0.96 s
    assert 150 < len(circle("thin", times)) < 250
    sliced = circle("slice", times)
    assert 200 <= len(sliced) <= 215 and sliced.all()  # 21 packets in each of ten tenths of a second
    covered = circle("covered", times)
    assert len(covered) == 2000 and covered[:, :18].all() and not covered[:, 18:].any()
    wedge = circle("wedge", times)
    assert set(wedge.sum(1)) <= {3, 4} and wedge.any(0).sum() > 18
