"""Reward and observation terms of navigation, on numbers worked out by hand."""

import math
from types import SimpleNamespace

import pytest
import torch

from omniperception.avoidance.navigation import navigation_inputs, num_inputs
from omniperception.avoidance.velocity_risk import VelocityRisk
from omniperception.env.mdp import rewards
from omniperception.env.mdp.observations import NavigationView, SectorErrors

RISK = VelocityRisk(1.8, 3, 36, (0.1, 0.4, 0.8, 1.3, 1.8), 0.25, 0.15, 2.0, 8.0, 0.05, 0.2, 0.15)


def sectors(**there: tuple[float, float, float]) -> torch.Tensor:
    """(1, 36, 3) with obstacles by sector `s<number>`: distance and velocity."""
    known = torch.zeros(1, 36, 3)
    known[..., 0] = torch.inf
    for name, value in there.items():
        known[0, int(name[1:])] = torch.tensor(value)
    return known


def state(velocity=(0.0, 0.0), wanted=(1.0, 0.0, 0.0), turn=0.0, around=None, targets=None, upright=-1.0):
    kinematics = SimpleNamespace(
        base_lin_vel_yaw=torch.tensor([velocity]),
        base_ang_vel_b=torch.tensor([[0.0, 0.0, turn]]),
        planar_velocity=torch.tensor([[*velocity, turn]]),
        projected_gravity_b=torch.tensor([[0.0, 0.0, upright]]),
    )
    targets = tuple(torch.tensor([target]) for target in (targets or [(0.0, 0.0, 0.0)] * 2))
    around = sectors() if around is None else around
    reference = torch.tensor([wanted])
    return SimpleNamespace(
        kinematics=kinematics, reference=reference, sectors=around, device="cpu", num_envs=1, targets=targets
    )


@pytest.mark.parametrize(
    ("velocity", "wanted", "earned"),
    [
        ((0.35, 0.0), (1.0, 0.0, 0.0), 0.5),
        ((0.9, 0.0), (1.0, 0.0, 0.0), 1.0),  # 70 % is enough
        ((0.0, 0.5), (1.0, 0.0, 0.0), 0.0),
        ((-0.7, 0.0), (1.0, 0.0, 0.0), -1.0),
        ((0.0, 0.7), (0.0, 2.0, 0.0), 1.0),
        ((0.5, 0.5), (0.0, 0.0, 0.0), 0.0),
    ],
)
def test_progress(velocity, wanted, earned):
    found = rewards.progress(state(velocity, wanted), enough=0.7)
    assert found.tolist() == pytest.approx([earned], abs=1e-5)


def test_deviations():
    moving = state((0.6, 0.3), (1.0, 0.0, 0.5), turn=0.1)
    assert rewards.deviation(moving).item() == pytest.approx(0.16 + 0.09)
    assert rewards.yaw_deviation(moving).item() == pytest.approx(0.16)
    assert rewards.deviation_while_free(moving, within=1.0).item() == pytest.approx(0.41)
    moving.sectors = sectors(s3=(0.9, 0.0, 0.0))
    assert rewards.deviation_while_free(moving, within=1.0).item() == 0.0


@pytest.mark.parametrize(
    ("velocity", "there", "time"),
    [
        ((1.0, 0.0), (2.0, 0.0, 0.0), 1.75),  # a disc of 0.25 m meets a point 2 m ahead
        ((0.0, 0.0), (2.0, -1.0, 0.0), 1.75),  # that comes
        ((1.0, 0.0), (2.0, 1.0, 0.0), None),  # that runs away as fast
        ((-1.0, 0.0), (2.0, 0.0, 0.0), None),
        ((0.0, 1.0), (2.0, 0.0, 0.0), None),  # beside it
        ((1.0, 0.0), (0.1, 0.0, 0.0), 0.0),  # within
    ],
)
def test_time_to_collision(velocity, there, time):
    """Sector 18 begins straight ahead; its middle is 5 degrees to the left, and all turns with it."""
    turn = math.radians(5.0)
    c, s = math.cos(turn), math.sin(turn)

    def turned(x, y):
        return c * x - s * y, s * x + c * y

    distance, *motion = there
    around = sectors(s18=(distance, *turned(*motion)))
    found = rewards.time_to_collision(state(turned(*velocity), around=around), radius=0.25, scale_s=0.5).item()
    assert found == pytest.approx(0.0 if time is None else math.exp(-time / 0.5), abs=1e-4)


def test_nearness():
    for distance, expected in ((0.2, 1.0), (0.25, 1.0), (0.3, 2 / 3), (0.5, 0.0)):
        around = sectors(s7=(distance, 0.0, 0.0), s9=(3.0, 0.0, 0.0))
        assert rewards.nearness(state(around=around), radius=0.25, within=0.15).item() == pytest.approx(expected)
    assert rewards.nearness(state(), radius=0.25, within=0.15).item() == 0.0


def test_standing_costs_where_there_is_a_way():
    closed = {f"s{k}": (1.0, 0.0, 0.0) for k in range(36)}
    behind_open = {name: value for name, value in closed.items() if name not in ("s0", "s35")}
    aside_open = {name: value for name, value in closed.items() if name != "s22"}  # 45 degrees to the left
    for there, cost in (({}, 1.0), (closed, 0.0), (behind_open, 0.0), (aside_open, 1.0)):
        assert rewards.standing_while_free(state(around=sectors(**there)), 0.15, 1.5).item() == cost
    assert rewards.standing_while_free(state((0.3, 0.0)), 0.15, 1.5).item() == 0.0
    assert rewards.standing_while_free(state(wanted=(0.1, 0.0, 0.0)), 0.15, 1.5).item() == 0.0


def test_changes_of_what_is_asked_for():
    jump = state(targets=[(1.0, 0.6, -0.5), (0.2, 0.0, 0.5)])
    assert rewards.asked_change_squared(jump).item() == pytest.approx(1.0)
    assert rewards.asked_jump(jump, free=0.6).item() == pytest.approx(0.16)
    assert rewards.asked_jump(jump, free=1.1).item() == 0.0
    assert rewards.asked_turn_squared(jump).item() == pytest.approx(1.0)


def test_a_fall_is_a_tilt():
    assert rewards.fallen(state(upright=-0.6), tilt_deg=60.0).item() == 0.0
    assert rewards.fallen(state(upright=-0.4), tilt_deg=60.0).item() == 1.0


class TestInputs:
    def given(self, around, risks=None):
        reference, velocity = torch.tensor([[1.0, 0.0, 0.3]]), torch.tensor([[0.5, 0.1, 0.2]])
        asked = torch.tensor([[0.6, 0.0, 0.1]])
        return navigation_inputs(around, reference, velocity, asked, RISK, RISK.candidates(), risks)[0]

    def test_nothing_around_is_the_command_and_no_risk(self):
        found = self.given(sectors())
        assert len(found) == num_inputs(RISK) == 3 + 144 + 9 + 109
        assert found[:3].tolist() == pytest.approx([1.0, 0.0, 0.3])
        assert not found[3:147].any() and not found[156:].any()
        assert found[147:156].tolist() == pytest.approx([1.0, 0.0, 0.3, 0.5, 0.1, 0.2, 0.6, 0.0, 0.1])

    def test_the_choice_is_that_of_the_controller(self):
        around = sectors(s17=(0.8, -0.5, 0.0), s18=(0.9, -0.5, 0.0))
        command, candidates = torch.tensor([[1.0, 0.0]]), RISK.candidates()
        with torch.no_grad():
            risk = RISK.risk(around, candidates)
            expected = command + RISK.avoidance(risk, command, candidates)
            found = self.given(around)
        assert found[:2].tolist() == pytest.approx(expected[0].tolist(), abs=1e-5)
        assert found[156:].tolist() == pytest.approx(risk[0].tolist(), abs=1e-6)
        assert found[3 + 17].item() == pytest.approx(0.8) and found[39 + 17].item() == pytest.approx(math.exp(-1.375))
        assert found[75 + 34 : 75 + 36].tolist() == pytest.approx([-1 / 3, 0.0], abs=1e-6)

    def test_risks_that_are_known_otherwise_are_taken(self):
        risks = torch.zeros(1, 109)
        risks[0, 1:] = 1.0
        found = self.given(sectors(), risks)
        assert found[156:].tolist() == risks[0].tolist()
        assert found[:2].norm() < 0.1  # it stands


class TestErrors:
    def view(self, **errors):
        given = {"distance": 0.0, "velocity": 0.0, "slowed": [1.0, 1.0], "lost": 0.0, "late": 0.0, "lasts_s": 0.3}
        view = NavigationView(RISK, SectorErrors(**{**given, **errors}))
        robots = 400
        around = torch.tensor([2.0, 1.0, -0.5]).expand(robots, 36, 3).clone()
        here = SimpleNamespace(sectors=around, num_envs=robots, device="cpu", control_dt=0.1)
        here.true_sectors = SimpleNamespace(names=())
        view._candidates = RISK.candidates()
        view._begin(here)
        return view, here

    def test_without_any_the_truth_is_shown(self):
        view, here = self.view()
        assert torch.equal(view._with_errors(here, view._errors), here.sectors)

    def test_distances_and_velocities_err_as_much_as_given_and_as_long(self):
        view, here = self.view(distance=0.1, velocity=0.2)
        shown = [view._with_errors(here, view._errors) for _ in range(9)]
        error = torch.stack(shown) - here.sectors
        level = view.level[None, :, None]
        assert 0.0 <= view.level.min() < 0.02 and 0.98 < view.level.max() <= 1.0
        assert (error[..., 0] / level).std().item() == pytest.approx(0.2, rel=0.03)
        assert (error[..., 1] / level).std().item() == pytest.approx(0.2, rel=0.03)
        kept = (error[3:] * error[:-3])[..., 1].mean() / error[..., 1].square().mean()
        assert kept.item() == pytest.approx(math.exp(-1), abs=0.03)

    def test_velocities_are_slowed_for_an_episode(self):
        view, here = self.view(slowed=[0.5, 0.7])
        first, second = (view._with_errors(here, view._errors)[:, 0, 1] for _ in range(2))
        assert torch.equal(first, second) and 0.5 <= first.min() < 0.52 and 0.68 < first.max() <= 0.7
        view.reset(torch.tensor([3]))
        again = view._with_errors(here, view._errors)[:, 0, 1]
        assert again[3] != first[3] and torch.equal(again[4:], first[4:])

    def test_sectors_are_lost_and_late(self):
        view, here = self.view(lost=0.1)
        lost = view._with_errors(here, view._errors)[..., 0].isinf().float().mean()
        assert lost.item() == pytest.approx(0.1, abs=0.01)
        view, here = self.view(late=0.3)
        view._with_errors(here, view._errors)
        here.sectors = here.sectors + 1.0
        shown = view._with_errors(here, view._errors)[..., 0]
        assert (shown == 2.0).all(1).float().mean().item() == pytest.approx(0.3, abs=0.07)
        view.reset(torch.arange(400))
        here.sectors = here.sectors + 1.0
        assert (view._with_errors(here, view._errors)[..., 0] != 3.0).all()  # nothing of the episode before


def test_what_was_not_seen_lately_is_not_known(make_env):
    """A post stands behind a robot; what its LiDAR saw is known for 0.25 s."""
    post = ["obstacles=none", "+obstacles.groups.post={kind: cylinder, count: 1, size: [[0.3, 0.3], [0.5, 0.5]]}"]
    env = make_env(*post, num_envs=2, blind=True)
    field, state = env.obstacles, env.state
    field.pos_w[:, 0, :2] = state.kinematics.base_pos_w[:, :2] + torch.tensor([2.0, 0.0], dtype=field.pos_w.dtype)
    here = SimpleNamespace(true_sectors=state.true_sectors, num_envs=2, device="cpu", control_dt=0.1)
    here.kinematics = SimpleNamespace(base_pos_w=state.kinematics.base_pos_w, yaw=torch.zeros(2))
    here.sectors = state.sectors
    errors = SectorErrors(0.0, 0.0, [1.0, 1.0], 0.0, 0.0, 0.3, seen_deg=108.0, remembered_s=0.25)
    view = NavigationView(RISK, errors)
    view._candidates = RISK.candidates()
    view._begin(here)

    def known(yaw):
        here.kinematics.yaw = torch.full((2,), yaw)
        return view._with_errors(here, errors)[..., 0].isfinite().any(1).tolist()

    assert known(math.pi) == [False, False]  # behind, and never seen
    assert known(0.0) == [True, True]
    assert [known(math.pi) for _ in range(3)] == [[True, True], [True, True], [False, False]]
    assert known(math.radians(115.0)) == [True, True]  # its edge reaches into the view: asin(0.3 / 2) is 8.6 degrees
    view.reset(torch.tensor([1]))
    assert known(math.radians(118.0)) == [True, False]
