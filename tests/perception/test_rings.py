"""Rings seen from where the base is now, against places computed point by point, and both ways of computing them."""

import math

import pytest
import torch

from omniperception.perception import MotionMatch, RingPath
from omniperception.perception.networks.rings import RingShape, _moved_rings, moved_rings

SECTORS, BANDS, DECAY = 36, 2, 0.5
MATCH = MotionMatch(speeds=(1.0,), num_directions=8, width=0.4, period_s=0.1)


def cells_of(points, band=0):
    """(bands * S, 3) of one frame, as the sampler writes them, from (x, y) in the levelled base."""
    cells = torch.zeros(BANDS, SECTORS, 3)
    for x, y in points:
        distance = math.hypot(x, y)
        proximity = math.exp(-distance / DECAY)
        sector = int((math.atan2(y, x) + math.pi) / (2 * math.pi) * SECTORS)
        if proximity > cells[band, sector, 2]:
            cells[band, sector] = proximity * torch.tensor([x / distance, y / distance, 1.0])
    return cells.flatten(0, 1)


def test_what_stands_still_is_in_the_same_place_in_all_frames():
    """A robot that walks and turns past a pole: every frame shows the pole where it is from the last pose."""
    shape = RingShape(SECTORS, 3, DECAY, (1.0,))
    pole, poses = (2.0, 1.0), [(0.0, 0.0, 0.0), (0.1, 0.05, 0.3), (0.25, 0.0, 0.7)]
    frames, moved, before = [], [], poses[0]
    for x, y, yaw in poses:
        dx, dy = pole[0] - x, pole[1] - y
        frames.append(
            cells_of([(math.cos(yaw) * dx + math.sin(yaw) * dy, -math.sin(yaw) * dx + math.cos(yaw) * dy)], 1)
        )
        sx, sy = x - before[0], y - before[1]
        c, s = math.cos(before[2]), math.sin(before[2])
        moved.append([c * sx + s * sy, -s * sx + c * sy, yaw - before[2]])
        before = (x, y, yaw)
    rings = moved_rings(torch.stack(frames)[None], torch.tensor([moved]), torch.tensor([[3]]), shape)
    rings = rings.unflatten(2, (3, BANDS, 2))[0, 0]
    distance = math.hypot(2.0 - 0.25, 1.0)
    bearing = math.atan2(1.0, 1.75) - 0.7
    sector = int((bearing + math.pi) / (2 * math.pi) * SECTORS)
    within = (bearing + math.pi) / (2 * math.pi) * SECTORS - sector - 0.5
    for frame in range(3):
        assert rings[frame, 1, 0, sector].item() == pytest.approx(math.exp(-distance), abs=1e-5)
        expected = 5.0 * within * 2 * math.pi / SECTORS * math.exp(-distance)
        assert rings[frame, 1, 1, sector].item() == pytest.approx(expected, abs=1e-5)
        assert (rings[frame] != 0).sum() <= 2


def test_late_frames_show_what_stands_where_it_is_now():
    """As above, each frame taken a while before it comes, and the robot has moved on and turned meanwhile."""
    shape = RingShape(SECTORS, 3, DECAY, (1.0,))
    pole, poses = (2.0, 1.0), [(0.0, 0.0, 0.0), (0.1, 0.05, 0.3), (0.25, 0.0, 0.7)]
    now = (0.33, -0.06, 0.9)

    def seen_from(pose, point):
        c, s = math.cos(pose[2]), math.sin(pose[2])
        dx, dy = point[0] - pose[0], point[1] - pose[1]
        return c * dx + s * dy, -s * dx + c * dy

    moved = [[*seen_from(a, b), b[2] - a[2]] for a, b in zip([poses[0], *poses], poses, strict=False)]
    since = torch.zeros(1, 3, 3)
    since[0, 2] = torch.tensor([*seen_from(poses[2], now), now[2] - poses[2][2]])
    since[0, :2] = torch.randn(2, 3)  # of frames before the newest nobody asks
    cells = torch.stack([cells_of([seen_from(pose, pole)], 1) for pose in poses])[None]
    given = cells, torch.tensor([moved]), torch.tensor([[3]]), shape, since
    x, y = seen_from(now, pole)
    sector = int((math.atan2(y, x) + math.pi) / (2 * math.pi) * SECTORS)
    for rings in (moved_rings(*given), _moved_rings(*given)):
        found = rings.unflatten(2, (3, BANDS, 2))[0, 0, :, 1, 0]
        assert found[:, sector].tolist() == pytest.approx([math.exp(-math.hypot(x, y))] * 3, abs=1e-5)
        assert (found != 0).sum() == 3


def test_times_are_counted_back_from_the_newest_frame():
    path = RingPath(BANDS * SECTORS, 4, match=MATCH, times=True)
    times = torch.zeros(1, 5, 3)
    times[0, :, 1] = torch.tensor([9.0, 0.1, 0.05, 0.2, 0.12])
    assert path._ages(times)[0].tolist() == pytest.approx([0.35, 0.25, 0.2], abs=1e-5)
    assert path._ages(times)[1].tolist() == pytest.approx([0.37, 0.32, 0.12], abs=1e-5)


def random_windows(generator, batch=5, frames=7, history=4):
    shape = (batch, frames, BANDS * SECTORS)
    bearing = (torch.arange(SECTORS) + torch.rand(batch, frames, BANDS, SECTORS, generator=generator)).flatten(2)
    bearing = -math.pi + bearing * 2 * math.pi / SECTORS
    proximity = torch.exp(-torch.rand(shape, generator=generator) * 8) * (torch.rand(shape, generator=generator) < 0.4)
    cells = torch.stack((bearing.cos() * proximity, bearing.sin() * proximity, proximity), -1)
    moved = 0.2 * torch.randn(batch, frames, 3, generator=generator)
    count = torch.randint(0, history + 1, (batch, frames - history + 1), generator=generator)
    return cells, moved, count


@pytest.mark.parametrize("seed", [0, 1])
def test_the_kernel_agrees_with_what_is_exported(seed):
    shape = RingShape(SECTORS, 4, DECAY, (0.5, 2.0))
    given = random_windows(torch.Generator().manual_seed(seed))
    rings, expected = moved_rings(*given, shape), _moved_rings(*given, shape)
    assert rings.shape == (5, 4, 4 * BANDS * 3, SECTORS)
    assert ((rings - expected).abs() > 1e-5).float().mean() < 1e-3  # a hit on the border of two sectors
    assert (rings > 0).float().mean() > 0.1


def some_path(**options):
    """Whose answer is not 0, as that of an untrained one."""
    torch.manual_seed(0)
    path = RingPath(BANDS * SECTORS, 4, match=MATCH, **options)
    torch.nn.init.normal_(path.layers[-1].weight)
    return path


def test_invalid_frames_and_other_windows_do_not_matter():
    path = some_path(channels=(8, 8), kernel_sizes=(5, 5))
    cells, moved, count = random_windows(torch.Generator().manual_seed(3))
    count[:] = 2
    out = path(cells, moved, count)
    assert out.shape == (5, 4, path.feature_dim) and path.feature_dim == 3 * SECTORS
    cells[:, :2] = torch.rand_like(cells[:, :2])  # the two oldest frames of window 0
    assert torch.equal(path(cells, moved, count)[:, 0], out[:, 0])
    one = path(cells[:, 3:], moved[:, 3:], count[:, 3:])
    assert torch.allclose(one[:, 0], out[:, 3], atol=1e-5)


def test_a_turned_world_gives_turned_motion():
    """Nothing tells one azimuth from another: a world turned by two sectors gives the answer turned by two."""
    path = some_path(channels=(8,), kernel_sizes=(5,))
    cells, moved, count = random_windows(torch.Generator().manual_seed(4))
    moved[:] = 0.0
    turn = 2 * 2 * math.pi / SECTORS
    turned = cells.unflatten(2, (BANDS, SECTORS)).roll(2, 3).flatten(2, 3).clone()
    x, y = turned[..., 0].clone(), turned[..., 1].clone()
    turned[..., 0], turned[..., 1] = math.cos(turn) * x - math.sin(turn) * y, math.sin(turn) * x + math.cos(turn) * y
    out = path(cells, moved, count).unflatten(2, (SECTORS, 3))
    assert out.abs().max() > 0.1
    assert torch.allclose(path(turned, moved, count).unflatten(2, (SECTORS, 3)), out.roll(2, 2), atol=1e-4)


@pytest.mark.parametrize(
    ("arguments", "options", "message"),
    [
        ((70, 4), {}, "num_cells=70 must be a multiple of num_sectors=36"),
        (
            (72, 4),
            {"channels": (8,), "kernel_sizes": (4,)},
            r"kernel_sizes=\[4\] must be one odd number, .* for each of",
        ),
        ((72, 1), {"match": MATCH}, r"perception\.history=1 shows no motion"),
    ],
)
def test_sizes_that_do_not_fit(arguments, options, message):
    with pytest.raises(ValueError, match=message):
        RingPath(*arguments, **options)


@pytest.mark.parametrize("wrong", [torch.float64, torch.float16])
def test_numbers_that_the_kernel_would_misread_are_refused(wrong):
    shape = RingShape(SECTORS, 2, DECAY, (1.0,))
    cells, moved = torch.zeros(1, 2, BANDS * SECTORS, 3), torch.zeros(1, 2, 3)
    rings = moved_rings(cells, moved, torch.ones(1, 1, dtype=torch.int32), shape)
    assert torch.equal(rings, moved_rings(cells, moved, torch.ones(1, 1, dtype=torch.int64), shape))
    with pytest.raises(ValueError, match=f"needs float32, got {wrong}"):
        moved_rings(cells.to(wrong), moved, torch.ones(1, 1, dtype=torch.int64), shape)
