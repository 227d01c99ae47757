"""True velocity risk against a search over finely sampled outlines, in the scenes that have every kind of obstacle."""

import math

import pytest
import torch

from omniperception.task.env import OmniEnv
from omniperception.task.true_risk import HEADROOM
from omniperception.world.obstacle_field import PARKED_HEIGHT


@pytest.fixture
def risky_env(make_config):
    def build(*overrides):
        run = make_config("rewards=velocity_risk", "perception=none", "num_envs=5", *overrides)
        env = OmniEnv(run.env)
        for _ in range(7):
            env.step(torch.zeros(5, 12))
        return env

    return build


def by_search(env, env_id: int, candidate: torch.Tensor) -> float:
    """The definition, obstacle by obstacle and time by time, with the outline's axis as 4001 points."""
    law, motion = env.config.rewards.avoidance.risk, env.kinematics
    yaw, base = float(motion.yaw[env_id]), motion.base_pos_w[env_id, :2].double()
    turn = torch.tensor([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]]).double()
    own = turn @ candidate.double()
    worst, placed = 0.0, 0
    for slot in env.config.obstacles.slots():
        bottom, velocity = 0.0, torch.zeros(2).double()
        if slot.pose is None:
            x, y, z = env.obstacles.pos_w[env_id, placed].tolist()
            heading = 2 * math.atan2(
                float(env.obstacles.quat_w[env_id, placed, 3]), env.obstacles.quat_w[env_id, placed, 0]
            )
            bottom, velocity = z - slot.half_height, env.obstacles.velocity_w[env_id, placed]
            placed += 1
        else:
            x, y, heading = slot.pose[0], slot.pose[1], math.radians(slot.pose[2])
        if not PARKED_HEIGHT / 2 < bottom < HEADROOM:
            continue
        half_x, half_y, radius = 0.0, 0.0, slot.size[0]
        if slot.kind == "box":
            hx, hy = slot.size[:2]
            half_x, half_y, radius = max(hx - hy, 0.0), max(hy - hx, 0.0), 1.2 * min(hx, hy)
        axis = torch.tensor(
            [
                math.cos(heading) * half_x - math.sin(heading) * half_y,
                math.sin(heading) * half_x + math.cos(heading) * half_y,
            ]
        )
        points = torch.linspace(-1, 1, 4001).double()[:, None] * axis.double()
        for time in law.times:
            offset = torch.tensor([x, y]).double() + velocity * time - base - own * time
            gap = float((offset + points).norm(dim=1).min()) - radius - law.robot_radius
            if gap < 5 * law.decay:
                worst = max(worst, math.exp(-max(gap, 0.0) / law.decay) * math.exp(-time / law.time_constant))
    return worst


@pytest.mark.parametrize("scene", ["scenario=corridor", "scenario=aerial", "scenario=moving", "obstacles=all"])
def test_risk_is_that_of_the_definition(risky_env, scene):
    env = risky_env(scene)
    risk = env.true_risk.measure(env.kinematics)
    assert risk.shape == (5, env.config.rewards.avoidance.risk.num_candidates)
    found = 0
    for env_id in range(5):
        for k in range(0, risk.shape[1], 4):
            expected = by_search(env, env_id, env.true_risk.candidates[k])
            assert float(risk[env_id, k]) == pytest.approx(expected, abs=2e-4)
            found += expected > 0.01
    assert found > 0


def test_without_obstacles_there_is_no_risk(risky_env):
    env = risky_env("obstacles=none")
    assert not env.true_risk.measure(env.kinematics).any() and not env.avoidance_velocity.any()


def test_a_reset_forgets_the_risk_of_one_environment_alone(risky_env):
    env = risky_env("scenario=corridor")
    env.risk = torch.rand_like(env.risk)
    before = env.risk.clone()
    env._reset(torch.tensor([2]))
    assert not env.risk[2].any() and not env.avoidance_velocity[2].any()
    assert torch.equal(env.risk[[0, 1, 3, 4]], before[[0, 1, 3, 4]])


def test_the_papers_law_has_no_risk(make_config):
    env = OmniEnv(make_config("rewards=default", "num_envs=2").env)
    assert env.true_risk is None and env.risk is None


def test_risk_needs_its_law(make_config):
    with pytest.raises(ValueError, match=r"perception\.risk_weight needs rewards\.avoidance\.risk; use rewards=veloc"):
        make_config("experiment=avoid", "rewards=default")
    with pytest.raises(ValueError, match=r"avoidance_weight=1\.0 and risk_weight=20\.0 would both change the command"):
        make_config("experiment=avoid", "perception.avoidance_weight=1.0")
