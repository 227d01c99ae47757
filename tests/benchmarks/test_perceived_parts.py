"""Parts of what is perceived that are true: just those, in their sectors, and errors worked out by hand."""

from types import SimpleNamespace

import pytest
import torch

from benchmarks.perceived_parts import PartlyTrue, command
from omniperception.avoidance.sector_motion import decode, encode
from omniperception.avoidance.velocity_risk import VelocityRisk
from omniperception.learning.read_out import MotionReadOut

S, DIM = 12, 12 * 3
RISK = VelocityRisk(
    max_speed=1.5,
    num_rings=2,
    num_directions=8,
    times=[0.2, 1.0],
    robot_radius=0.3,
    decay=0.2,
    time_constant=2.0,
    weight=8.0,
    temperature=0.05,
)


def truth():
    """Two robots: something at 1 m that moves at 1 m/s along y, in sector 6 of the first and 3 of the second."""
    motion = torch.zeros(2, S, 3)
    motion[..., 0] = torch.inf
    motion[0, 6] = motion[1, 3] = torch.tensor([1.0, 0.0, 1.0])
    return motion


def read_out(parts, true=None):
    own = MotionReadOut(DIM, DIM, slice(0, DIM), RISK)
    true = truth() if true is None else true
    env = SimpleNamespace(num_envs=len(true), avoidance=SimpleNamespace(motion=true))
    return own, PartlyTrue(own, env, parts)


def said(embedding):
    return decode(embedding.unflatten(1, (S, 3)))


@pytest.fixture
def embedding():
    """What a network says: nearness 0.3 to 0.8 everywhere, slow motion."""
    generator = torch.Generator().manual_seed(0)
    values = torch.rand(2, S, 3, generator=generator)
    return torch.cat((0.3 + 0.5 * values[..., :1], values[..., 1:] - 0.5), -1).flatten(1)


def test_nothing_replaced_is_the_networks_own(embedding):
    own, partly = read_out(())
    torch.testing.assert_close(partly.extend(embedding), own.extend(embedding), rtol=0, atol=0)
    command = torch.tensor([[1.0, 0.0], [0.5, 0.2]])
    features = partly.extend(embedding)
    torch.testing.assert_close(partly.velocity(features, command), own.velocity(features, command), rtol=0, atol=0)


@pytest.mark.parametrize("parts", [("distance",), ("velocity",), ("distance", "velocity")])
def test_just_the_parts_are_true(embedding, parts):
    own, partly = read_out(parts)
    expected = embedding.unflatten(1, (S, 3)).clone()
    true = encode(truth())
    if "distance" in parts:
        expected[..., 0] = true[..., 0]
    if "velocity" in parts:
        expected[..., 1:] = true[..., 1:]
    risk = RISK.risk(decode(expected), own.candidates)
    torch.testing.assert_close(partly.extend(embedding)[:, DIM:], risk, rtol=0, atol=1e-6)
    assert (risk - own.extend(embedding)[:, DIM:]).abs().max() > 0.05


def test_without_a_frame_nothing_is_replaced(embedding):
    own, partly = read_out(("distance", "velocity"))
    nothing = torch.zeros(1, DIM)
    torch.testing.assert_close(partly.extend(nothing), own.extend(nothing), rtol=0, atol=0)
    assert partly.moving == 0


def test_errors(embedding):
    """The first robot's obstacle is said to be at 1.2 m and to stand; the second's is not noticed."""
    values = torch.zeros(2, S, 3)
    values[0, 6, 0] = 1.0 - 1.2 / 4.0
    _, partly = read_out(())
    partly.extend(values.flatten(1))
    assert (partly.moving, partly.noticed) == (2, 1) and partly.velocity_error == pytest.approx(1.0)
    still = truth()
    still[..., 1:] *= 0.2  # too slow to count
    _, partly = read_out((), still)
    partly.extend(values.flatten(1))
    assert partly.moving == 0


@pytest.mark.integration
def test_the_command(tmp_path, capsys):
    line = ["trials=2", "num_envs=2", "lidar.num_rays=200", "terminations.episode_length_s=0.5"]
    command([*line, f"folder={tmp_path}"])
    table = (tmp_path / "perceived_parts.md").read_text()
    rows = [row for row in table.splitlines() if row.startswith("| moving")]
    assert len(rows) == 5 and "all obstacles, at every step" in rows[-1]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (["run=pretrained/gait"], "has no motion by sector to replace"),
        (["obstacles.split=test"], "no study may see it"),
    ],
)
def test_what_cannot_be_is_refused(capsys, line, message):
    with pytest.raises(SystemExit):
        command([*line, "trials=1", "num_envs=1"])
    (said_,) = capsys.readouterr().err.splitlines()
    assert message in said_
