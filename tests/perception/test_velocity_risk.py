"""The choice between candidate velocities, against sums by hand."""

import math

import pytest
import torch

from omniperception.perception import VelocityRisk

GIVEN = {
    "max_speed": 1.0,
    "num_rings": 2,
    "num_directions": 4,
    "times": (0.5, 1.0),
    "robot_radius": 0.3,
    "decay": 0.2,
    "time_constant": 2.0,
    "weight": 8.0,
    "temperature": 0.05,
}


def test_candidates_are_standing_still_and_rings():
    expected = [[0, 0], [0.5, 0], [0, 0.5], [-0.5, 0], [0, -0.5], [1, 0], [0, 1], [-1, 0], [0, -1]]
    law = VelocityRisk(**GIVEN)
    assert law.num_candidates == 9
    assert torch.allclose(law.candidates(), torch.tensor(expected, dtype=torch.float32), atol=1e-6)


def test_no_risk_and_equal_risks_change_nothing():
    law, command = VelocityRisk(**GIVEN), torch.tensor([[0.7, -0.2], [0.0, 0.0], [2.0, 1.0]])
    for risk in (0.0, 0.6):
        velocity = law.avoidance(torch.full((3, 9), risk), command, law.candidates())
        assert torch.allclose(velocity, torch.zeros(3, 2), atol=1e-6)


def test_choice_is_the_weighted_mean_by_hand():
    law = VelocityRisk(**GIVEN | {"num_rings": 1, "num_directions": 2, "weight": 2.0, "temperature": 0.5})
    risk = torch.tensor([[0.1, 0.9, 0.0]])  # standing still, ahead, back
    weights = [math.exp(-(cost) / 0.5) for cost in (1.0 + 0.2, 0.0 + 1.8, 4.0)]
    free = [math.exp(-(cost) / 0.5) for cost in (1.0, 0.0, 4.0)]
    expected = (weights[1] - weights[2]) / sum(weights) - (free[1] - free[2]) / sum(free)
    velocity = law.avoidance(risk, torch.tensor([[1.0, 0.0]]), law.candidates())
    assert velocity[0].tolist() == pytest.approx([expected, 0.0], abs=1e-6)


def test_what_lies_ahead_is_passed_on_the_free_side():
    law = VelocityRisk(**GIVEN)
    risk = torch.zeros(1, 9)
    risk[0, [0, 1, 5, 2, 6]] = 1.0  # here, ahead and to the left
    command = torch.tensor([[1.0, 0.0]])
    velocity = command + law.avoidance(risk, command, law.candidates())
    assert velocity[0, 1] < -0.1 and velocity[0, 0] < 0.3


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"temperature": 0.0}, r"risk\.temperature=0\.0 must be positive"),
        ({"robot_radius": -0.1}, r"robot_radius=-0\.1 must not be negative"),
        ({"times": []}, r"times=\[\] must be times"),
        ({"times": [-1.0]}, r"times=\[-1\.0\] must be times"),
    ],
)
def test_impossible_settings_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        VelocityRisk(**GIVEN | change)
