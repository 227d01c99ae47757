"""The choice between candidate velocities, against sums by hand."""

import math

import numpy as np
import pytest
import torch

from omniperception.avoidance.velocity_risk import VelocityRisk

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
    controller = VelocityRisk(**GIVEN)
    assert controller.num_candidates == 9
    assert torch.allclose(controller.candidates(), torch.tensor(expected, dtype=torch.float32), atol=1e-6)


def test_no_risk_and_equal_risks_change_nothing():
    controller, command = VelocityRisk(**GIVEN), torch.tensor([[0.7, -0.2], [0.0, 0.0], [2.0, 1.0]])
    for risk in (0.0, 0.6):
        velocity = controller.avoidance(torch.full((3, 9), risk), command, controller.candidates())
        assert torch.allclose(velocity, torch.zeros(3, 2), atol=1e-6)


def test_choice_is_the_weighted_mean_by_hand():
    controller = VelocityRisk(**GIVEN | {"num_rings": 1, "num_directions": 2, "weight": 2.0, "temperature": 0.5})
    risk = torch.tensor([[0.1, 0.9, 0.0]])  # standing still, ahead, back
    weights = [math.exp(-(cost) / 0.5) for cost in (1.0 + 0.2, 0.0 + 1.8, 4.0)]
    free = [math.exp(-(cost) / 0.5) for cost in (1.0, 0.0, 4.0)]
    expected = (weights[1] - weights[2]) / sum(weights) - (free[1] - free[2]) / sum(free)
    velocity = controller.avoidance(risk, torch.tensor([[1.0, 0.0]]), controller.candidates())
    assert velocity[0].tolist() == pytest.approx([expected, 0.0], abs=1e-6)


@pytest.mark.parametrize("sideways", [1.0, 0.3])
def test_a_deviation_counts_by_its_direction(sideways):
    controller, rng = VelocityRisk(**GIVEN, sideways=sideways), np.random.default_rng(3)
    for command in (*rng.normal(size=(20, 2)), np.array([0.0, 0.0]), np.array([0.0, -0.02])):
        risk = rng.uniform(size=9)
        heading = command / max(np.hypot(*command), 0.1)
        cost = []
        for candidate in controller.candidates().numpy():
            away = command - candidate
            across = away - (away @ heading) * heading if np.hypot(*command) >= 0.1 else None
            if across is not None:
                cost.append((away @ heading) ** 2 + sideways * across @ across)
            else:  # slow: the part beside counts less and less
                cost.append(away @ away - (1.0 - sideways) * (away[0] * heading[1] - away[1] * heading[0]) ** 2)
        wary, free = (np.exp(-np.array(cost + extra) / 0.05) for extra in (8.0 * risk, 0.0 * risk))
        expected = (wary / wary.sum() - free / free.sum()) @ controller.candidates().numpy()
        given = (torch.tensor(x[None], dtype=torch.float32) for x in (risk, command))
        assert controller.avoidance(*given, controller.candidates())[0].tolist() == pytest.approx(expected, abs=2e-5)


def test_goes_round_something_wide_instead_of_standing_before_it():
    """A wall 0.8 m ahead that reaches from 0.5 m on the right to 1.4 m on the left."""
    angles = -math.pi + (torch.arange(36) + 0.5) * math.pi / 18
    ahead = (angles > -math.pi / 6) & (angles < math.pi / 3)
    sectors = torch.zeros(1, 36, 3)
    sectors[0, :, 0] = torch.where(ahead, 0.8 / angles.cos(), math.inf)
    times = (0.1, 0.3, 0.6, 0.9, 1.3, 1.8)
    parameters = GIVEN | {"num_rings": 4, "num_directions": 24, "times": times, "decay": 0.15, "max_speed": 1.4}
    command, chosen = torch.tensor([[1.0, 0.0]]), {}
    for sideways in (1.0, 0.15):
        controller = VelocityRisk(**parameters, sideways=sideways)
        risk = controller.risk(sectors, controller.candidates())
        chosen[sideways] = (command + controller.avoidance(risk, command, controller.candidates()))[0]
    assert chosen[1.0].norm() < 0.1
    assert chosen[0.15][1] < -0.3 and chosen[0.15][0] > 0.1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"temperature": 0.0}, r"risk\.temperature=0\.0 must be positive"),
        ({"robot_radius": -0.1}, r"robot_radius=-0\.1 must not be negative"),
        ({"robot_half_length": -0.1}, r"robot_half_length=-0\.1 must not be negative"),
        ({"times": []}, r"times=\[\] must be times"),
        ({"times": [-1.0]}, r"times=\[-1\.0\] must be times"),
    ],
)
def test_impossible_settings_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        VelocityRisk(**GIVEN | change)


class TestRisk:
    def by_search(self, controller, sectors, candidate):
        """The definition, obstacle by obstacle and time by time."""
        worst = 0.0
        for s, (distance, vx, vy) in enumerate(sectors.tolist()):
            bearing = -math.pi + (s + 0.5) * 2 * math.pi / len(sectors)
            for time in controller.times:
                x = distance * math.cos(bearing) + (vx - candidate[0]) * time
                y = distance * math.sin(bearing) + (vy - candidate[1]) * time
                along = x - min(max(x, -controller.robot_half_length), controller.robot_half_length)
                gap = max(math.hypot(along, y) - controller.robot_radius, 0.0)
                worst = max(worst, math.exp(-gap / controller.decay - time / controller.time_constant))
        return worst

    def scene(self, seed, n=6, num_sectors=12):
        generator = torch.Generator().manual_seed(seed)
        distance = 0.4 + 2 * torch.rand(n, num_sectors, 1, generator=generator)
        distance[torch.rand(n, num_sectors, 1, generator=generator) < 0.5] = torch.inf
        return torch.cat((distance, torch.randn(n, num_sectors, 2, generator=generator)), -1)

    @pytest.mark.parametrize(("seed", "half_length"), [(0, 0.0), (1, 0.0), (2, 0.35)])
    def test_is_that_of_the_definition(self, seed, half_length):
        controller = VelocityRisk(**GIVEN, robot_half_length=half_length)
        sectors, candidates = self.scene(seed), controller.candidates()
        sectors[2, :, 0] = torch.inf
        risk = controller.risk(sectors, candidates)
        for n in range(6):
            rows = torch.where(sectors[n, :, :1].isinf(), torch.tensor([1e6, 0.0, 0.0]), sectors[n])
            for k in range(9):
                expected = self.by_search(controller, rows, candidates[k].tolist())
                assert risk[n, k].item() == pytest.approx(expected, abs=1e-5)
        assert not risk[2].any() and risk.max() > 0.5

    @pytest.mark.parametrize("half_length", [0.0, 0.35])
    def test_the_kernel_finds_what_the_exported_operations_find(self, half_length):
        controller = VelocityRisk(**GIVEN, robot_half_length=half_length)
        sectors, candidates = self.scene(3, n=40), controller.candidates()
        risk = controller.risk(sectors, candidates)
        bearing = -math.pi + (torch.arange(12) + 0.5) * math.pi / 6
        place = sectors[..., :1].clamp(max=100.0) * torch.stack((bearing.cos(), bearing.sin()), -1)
        sector, when = controller._worst(place, sectors[..., 1:], candidates)
        index = sector[..., None].expand(-1, -1, 2)
        offset = place.gather(1, index) + when[..., None] * (sectors[..., 1:].gather(1, index) - candidates)
        along = offset[..., 0] - offset[..., 0].clamp(-half_length, half_length)
        gap = (torch.hypot(along, offset[..., 1]) - controller.robot_radius).clamp(min=0.0)
        assert torch.allclose((-gap / controller.decay - when / controller.time_constant).exp(), risk, atol=1e-5)

    def test_a_long_robot_passes_beside_what_it_would_not_pass_before(self):
        """A post beside it and one ahead, as far from its middle."""
        risks = {}
        for half_length in (0.0, 0.3):
            controller = VelocityRisk(**GIVEN | {"times": (0.0,)}, robot_half_length=half_length)
            for s in (2, 6, 8):  # of 12 sectors: to the right, ahead and to the left
                sectors = torch.zeros(1, 12, 3)
                sectors[..., 0] = torch.inf
                sectors[0, s, 0] = 0.8
                risks[half_length, s] = controller.risk(sectors, controller.candidates())[0, 0].item()
        assert risks[0.0, 2] == pytest.approx(risks[0.0, 8]) == pytest.approx(risks[0.0, 6])
        assert risks[0.3, 6] > 3 * risks[0.3, 8] and risks[0.3, 8] < 1.5 * risks[0.0, 8]

    def test_gradient_is_that_of_differences(self):
        controller = VelocityRisk(**GIVEN, robot_half_length=0.2)
        sectors = self.scene(5, n=3)
        sectors[..., 0].clamp_(max=3.0)
        sectors.requires_grad_()
        weights = torch.randn(3, 9, generator=torch.Generator().manual_seed(0))
        (gradient,) = torch.autograd.grad((controller.risk(sectors, controller.candidates()) * weights).sum(), sectors)
        with torch.no_grad():
            direction = torch.randn(sectors.shape, generator=torch.Generator().manual_seed(1))
            up, down = (
                (controller.risk(sectors + s * 2e-4 * direction, controller.candidates()) * weights).sum()
                for s in (1, -1)
            )
        assert (gradient * direction).sum().item() == pytest.approx(((up - down) / 4e-4).item(), rel=3e-2, abs=2e-3)
