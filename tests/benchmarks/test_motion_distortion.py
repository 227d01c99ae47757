"""What de-skewing leaves, against motions of which it can be worked out by hand."""

import math

import pytest
import torch

from benchmarks import motion_distortion as study
from omniperception.common.rotations import yaw_quat

TIMES = torch.arange(0.0, 0.1, 0.001, dtype=torch.float64)
AHEAD = torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64).expand(len(TIMES), 3)
SCAN = study.Scan(AHEAD, TIMES, 0.1)


def walk(speed, turn):
    t = torch.arange(0.0, 0.4, 0.005, dtype=torch.float64)
    pos = torch.stack((speed * t, torch.zeros_like(t), torch.ones_like(t)), 1)
    return study.Walk(pos, yaw_quat(turn * t), 0.005, (speed, turn))


def test_going_straight_leaves_the_way_to_the_frames_end():
    left = study.left_over(walk(2.0, 0.0), SCAN, 0.1, gyro_bias=0.0, velocity_error=0.0)
    way = 2.0 * (0.1 - TIMES)
    for name in ("nothing", "gyroscope", "gyroscope, biased"):
        torch.testing.assert_close(left[name], way)
    assert left["gyroscope and velocity"].max() < 1e-9


def test_turning_is_what_a_gyroscope_undoes():
    """A chord of the turn since, at the distance of the wall that the ray hits; a bias leaves as much as it turned."""
    left = study.left_over(walk(0.0, 1.0), SCAN, 0.1, gyro_bias=0.05, velocity_error=0.0)
    distance = study.ROOM[0] / torch.cos(0.1 + TIMES)
    torch.testing.assert_close(left["nothing"], 2.0 * distance * torch.sin((0.1 - TIMES) / 2.0), rtol=1e-4, atol=1e-9)
    assert left["gyroscope"].max() < 1e-9
    chord = 2.0 * distance * torch.sin(0.05 * (0.1 - TIMES) / 2.0)
    torch.testing.assert_close(left["gyroscope, biased"], chord, rtol=1e-4, atol=1e-9)


def test_an_error_of_the_velocity_is_left_along_both_axes():
    left = study.left_over(walk(1.0, 0.0), SCAN, 0.1, gyro_bias=0.0, velocity_error=0.05)
    torch.testing.assert_close(left["gyroscope and velocity"], 0.05 * math.sqrt(2.0) * (0.1 - TIMES))


def test_the_command_walks_and_draws(tmp_path, capsys):
    study.command([f"out={tmp_path}", "speeds=1", "turns=0", "frames=2", "terminations.episode_length_s=20"])
    assert "walked: m/s" in capsys.readouterr().out and (tmp_path / "motion_distortion.png").is_file()
    with pytest.raises(SystemExit):
        study.command(["mount=tail", "frames=1", f"out={tmp_path}"])
    assert "mount=tail is unknown; known: head" in capsys.readouterr().err
