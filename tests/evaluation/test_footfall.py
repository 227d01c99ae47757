"""Gait diagrams, of contacts that are known."""

import pytest
import torch

from omniperception.commands.gait import feet_table
from omniperception.evaluation.gait.footfall import COMMANDS, Footfall, _bars, draw_footfall, watch

BLIND = ("lidar=none", "perception=none", "rewards=walk", "observations=walk")
TASK = (*BLIND, "scenario=walk", f"num_envs={len(COMMANDS)}")


def test_shares_frequencies_and_bars_of_a_known_pattern():
    down = torch.tensor([True, True, False, False, True, False, False, False, True, True])
    contact = torch.zeros(10, len(COMMANDS), 2, dtype=torch.bool)
    contact[:, 0, 0], contact[:, 1, 1] = down, True
    nothing = torch.zeros(len(COMMANDS), 3)
    footfall = Footfall(nothing, nothing[:, 0].bool(), contact, nothing, 0.1, ("a_foot", "b_foot"))
    assert footfall.duty()[0].tolist() == [0.5, 0.0] and footfall.duty()[1].tolist() == [0.0, 1.0]
    assert footfall.frequency()[0, 0].item() == pytest.approx(2 / 0.9)
    assert footfall.frequency()[1, 1].item() == 0.0
    bars = torch.tensor(_bars(down, 0.1))
    torch.testing.assert_close(bars, torch.tensor([[0.0, 0.2], [0.4, 0.1], [0.8, 0.2]]))
    assert _bars(torch.zeros(4, dtype=torch.bool), 0.1) == []


def test_robots_that_stand_have_all_feet_down_and_each_is_commanded_its_own(make_env, tmp_path):
    env = make_env(*TASK, "+observations.command_acceleration=[4,8]", extra_requirements=("foot_force",))
    seen = []

    def stand(observations):
        seen.append(observations["command"].clone())
        return torch.zeros(len(COMMANDS), 12)

    footfall = watch(env, stand)
    told, most = torch.stack(seen), torch.tensor([4.0, 4.0, 8.0]) * env.control_dt
    assert torch.equal(told[-1], torch.tensor(COMMANDS)) and not told[0].any()
    assert (told.diff(dim=0).abs() <= most + 1e-6).all()  # they change as fast as in the task
    assert footfall.contact.shape == (100, len(COMMANDS), 4) and footfall.contact.all()
    assert footfall.velocity.abs().max() < 0.05 and not footfall.fell.any()
    assert footfall.names()[-3:] == ["1 m/s back", "1 m/s to the left", "1.5 rad/s to the left"]
    draw_footfall(footfall, tmp_path / "feet.png")
    assert (tmp_path / "feet.png").stat().st_size > 10_000


def test_one_that_falls_has_no_figures_and_none_is_asked_for_more_than_it_is_for(make_env, tmp_path):
    """Legs folded by the one that is to walk back; commands of a robot that goes 0.8 m/s at most, never back."""
    env = make_env(*TASK, "robot.gait.lin_vel_x=[0.0,0.8]", extra_requirements=("foot_force",))
    folded = torch.zeros(len(COMMANDS), 12)
    folded[4, 0::3] = 6.0
    footfall = watch(env, lambda _: folded)
    assert footfall.fell.tolist() == [k == 4 for k in range(len(COMMANDS))]
    assert footfall.names()[1:5] == ["0.5 m/s ahead", "0.8 m/s ahead", "0.8 m/s ahead", "stand"]
    rows = [[cell.strip() for cell in row.split("|")] for row in feet_table(footfall).splitlines()]
    assert [row[2].startswith("fell") for row in rows[2:9]] == footfall.fell.tolist()
    draw_footfall(footfall, tmp_path / "feet.png")
