"""The blind and the scripted policy: what they see and what they are told."""

import math
from types import SimpleNamespace

import pytest
import torch

from omniperception import config
from omniperception.assembly import build_runner
from omniperception.evaluation.baselines import TrueSectors, covered, steered
from omniperception.perception import Attitude
from omniperception.random import EnvRandom
from omniperception.task.rewards import AvoidanceConfig
from omniperception.world import ObstacleField, ObstacleGroup, ObstaclesConfig

BLIND = ("experiment=walk", "rewards=walk")
SEEING = ("experiment=quickstart", "scenario=static", "num_envs=3", "randomization=none")


def scene(groups, base=(0.0, 0.0), yaw=0.0, num_envs=1, **settings):
    """What TrueSectors needs of an environment, with obstacles that a test places."""
    obstacles = ObstaclesConfig(groups, **settings)
    field = None
    if obstacles.placed_slots():
        pos, quat = (torch.zeros(num_envs, len(obstacles.placed_slots()), n, dtype=torch.float64) for n in (3, 4))
        quat[..., 0] = 1.0
        field = ObstacleField(obstacles, pos, quat, EnvRandom(0, num_envs))
    kinematics = SimpleNamespace(
        base_pos_w=torch.tensor([[*base, 0.3]]).expand(num_envs, 3), yaw=torch.full((num_envs,), yaw)
    )
    world = SimpleNamespace(obstacles=obstacles)
    return SimpleNamespace(world=world, obstacles=field, kinematics=kinematics, device="cpu", num_envs=num_envs)


POST = ObstacleGroup("cylinder", 1, [[0.5, 0.5], [0.5, 0.5]])
NORTH, EAST = 3, 2  # of four sectors that begin at -180, -90, 0 and 90 degrees: east holds 0 to 90 degrees


class TestTrueSectors:
    def test_a_circle_by_hand(self):
        env = scene({"post": POST}, base=(1.0, 1.0))
        env.obstacles.pos_w[0, 0] = torch.tensor([4.0, 5.0, 0.5])  # 3 m and 4 m off: 5 m away, its edge at 4.5 m
        got = TrueSectors(env, 4).measure()[0]
        assert got[EAST].item() == pytest.approx(4.5) and got.isinf().tolist() == [True, True, False, True]

    def test_sectors_turn_with_the_robot(self):
        env = scene({"post": POST}, yaw=-math.pi / 2)
        env.obstacles.pos_w[0, 0] = torch.tensor([3.0, 4.0, 0.5])
        got = TrueSectors(env, 4).measure()[0]
        assert got[NORTH].item() == pytest.approx(4.5)

    def test_a_box_across_two_sectors_by_hand(self):
        env = scene({"crate": ObstacleGroup("box", 1, [[0.5, 0.5], [1.0, 1.0], [0.5, 0.5]])})
        env.obstacles.pos_w[0, 0] = torch.tensor([2.0, 0.4, 0.5])  # its face at x = 1.5 from y = -0.6 to 1.4
        got = TrueSectors(env, 8).measure()[0]
        assert got[4].item() == pytest.approx(1.5) and got[3].item() == pytest.approx(1.5)
        assert got.isinf().tolist() == [True, True, True, False, False, True, True, True]

    def test_a_turned_box_by_hand(self):
        env = scene({"crate": ObstacleGroup("box", 1, [[1.0, 1.0], [1.0, 1.0], [0.5, 0.5]])})
        env.obstacles.pos_w[0, 0] = torch.tensor([4.0, 0.0, 0.5])
        env.obstacles.quat_w[0, 0] = torch.tensor([math.cos(math.pi / 8), 0, 0, math.sin(math.pi / 8)])
        got = TrueSectors(env, 8).measure()[0]
        assert got[4].item() == pytest.approx(4 - math.sqrt(2), abs=1e-5)  # its corner

    def test_walls_count_and_what_hangs_overhead_or_is_parked_does_not(self):
        wall = ObstacleGroup("box", 1, [[3.0, 3.0], [0.1, 0.1], [0.5, 0.5]], poses=[[0.0, -2.0, 0.0]])
        env = scene({"post": POST, "wall": wall})
        env.obstacles.pos_w[0, 0] = torch.tensor([2.0, 2.0, 0.5 + 0.44])
        got = TrueSectors(env, 4).measure()[0]
        assert got[EAST].item() == pytest.approx(math.sqrt(8) - 0.5)
        assert got[1].item() == pytest.approx(1.9) and got[0].item() == pytest.approx(1.9)
        for height in (0.5 + 0.46, -100.0):
            env.obstacles.pos_w[0, 0, 2] = height
            assert TrueSectors(env, 4).measure()[0, EAST].isinf()

    def test_against_points_all_over_the_outlines(self):
        n, generator = 40, torch.Generator().manual_seed(2)
        groups = {
            "post": ObstacleGroup("cylinder", 3, [[0.1, 0.6], [0.5, 0.5]]),
            "crate": ObstacleGroup("box", 3, [[0.1, 0.7], [0.1, 0.7], [0.5, 0.5]]),
        }
        env = scene(groups, base=(0.3, -0.2), yaw=0.7, num_envs=n)
        field, slots = env.obstacles, env.world.obstacles.slots()
        angle = 2 * math.pi * torch.rand(n, 6, generator=generator, dtype=torch.float64)
        distance = 1.2 + 3 * torch.rand(n, 6, generator=generator, dtype=torch.float64)
        field.pos_w[..., :2] = torch.stack((angle.cos(), angle.sin()), -1) * distance[..., None]
        field.pos_w[..., 2] = 0.5
        field.quat_w[..., 0], field.quat_w[..., 3] = (angle / 2).cos(), (angle / 2).sin()
        got = TrueSectors(env, 36).measure()
        expected = torch.full((n, 36), torch.inf, dtype=torch.float64)
        for k, slot in enumerate(slots):
            s = torch.linspace(0, 1, 4001, dtype=torch.float64)
            if slot.kind == "box":
                x, y = slot.size[:2]
                corners = torch.tensor([[x, y], [-x, y], [-x, -y], [x, -y], [x, y]], dtype=torch.float64)
                sides = [corners[i] + s[:, None] * (corners[i + 1] - corners[i]) for i in range(4)]
                outline = torch.cat(sides)
            else:
                outline = slot.size[0] * torch.stack(((2 * math.pi * s).cos(), (2 * math.pi * s).sin()), -1)
            cos, sin = angle[:, k, None].cos(), angle[:, k, None].sin()
            x = field.pos_w[:, k, :1] + cos * outline[:, 0] - sin * outline[:, 1] - 0.3
            y = field.pos_w[:, k, 1:2] + sin * outline[:, 0] + cos * outline[:, 1] + 0.2
            bearing = torch.remainder(torch.atan2(y, x) - 0.7 + math.pi, 2 * math.pi)
            sector = (bearing / (2 * math.pi) * 36).long().clamp(max=35)
            expected = expected.scatter_reduce(1, sector, torch.hypot(x, y), "amin")
        seen = expected.isfinite()
        assert (got.isfinite() | ~seen).all() and (got.isfinite() != seen).float().mean() < 0.005  # grazed sectors
        both = seen & got.isfinite()
        assert ((got - expected)[both].abs() > 2e-3).float().mean() < 0.01
        assert (got - expected)[both].abs().median() < 1e-5


class TestSteered:
    law = AvoidanceConfig(num_sectors=36, threshold=1.5, alpha=2.0, max_speed=None)

    def told(self, env, limits):
        heard = []
        policy = steered(env, lambda obs: heard.append(obs["command"].clone()), self.law, limits)
        policy(env.get_observations())
        return heard[0]

    def test_is_told_the_sum_within_what_it_has_learned(self, make_env):
        env = make_env(*BLIND, "scenario=static", "num_envs=2", "commands.spawn.yaw_deg=[0,0]")
        env.sim.mocap_pos[..., 2] = -100.0
        env.sim.mocap_pos[1, 2] = torch.tensor([50.0, 0.0, 0.3])
        given = env.get_observations()["command"].clone()
        assert torch.equal(self.told(env, None), given)  # nothing near: V_cmd alone
        side = max(slot.radius for slot in env.world.obstacles.slots())
        env.sim.mocap_pos[1, 0, :2] = env.kinematics.base_pos_w[1, :2] + torch.tensor([0.0, side + 0.3])
        env.sim.mocap_pos[1, 0, 2] = 0.5  # to its left
        told = self.told(env, None)
        assert torch.equal(told[0], given[0])
        assert told[1, 1] < given[1, 1] - 0.5 and told[1, 2] == given[1, 2]
        limited = self.told(env, ((-0.5, 1.0), (-0.5, 0.5)))
        assert limited[1, 1] == -0.5 and limited[0, 0] == given[0, 0].clamp(max=1.0)
        assert torch.equal(env.get_observations()["command"], given)  # the task's command is what it was

    def test_needs_a_command_to_add_to(self, make_env):
        env = make_env(*BLIND, "scenario=static", "num_envs=2", "observations.actor=[proprioception]")
        env.observations = env.observations.exclude("command")
        with pytest.raises(ValueError, match="group 'command'"):
            steered(env, None, self.law, None)


@pytest.fixture(scope="module")
def runner():
    """An untrained policy to which its embedding counts."""
    run = config.assemble(config.compose([*SEEING, "ppo.num_steps_per_env=4", "ppo.num_mini_batches=1"]))
    torch.manual_seed(3)
    runner = build_runner(run, None)
    with torch.no_grad():
        runner.alg.actor.mlp[0].weight.normal_(0.0, 0.1)
    return runner


class TestCovered:
    def test_frames_are_what_the_sampler_makes_of_misses(self, runner):
        env = runner.env
        heard = []
        covered(env, lambda obs: heard.append(obs["frames"].clone()))(env.get_observations())
        frame = env.sensing.frame
        misses = torch.full_like(frame.ranges, torch.inf)
        expected = torch.zeros_like(env.sensing.frames[:, 0])
        sensor = env.config.lidar.sensor
        attitude = Attitude(env.kinematics.base_quat_w.contiguous(), sensor.mount_pos, sensor.quat)
        env.config.sampler()(misses, frame.directions_s, frame.elevation, frame.azimuth, expected, attitude)
        assert heard[0].shape == env.sensing.frames.shape
        for k in range(heard[0].shape[1]):
            torch.testing.assert_close(heard[0][:, k], expected)
        assert not torch.equal(heard[0][:, -1], env.sensing.frames[:, -1])

    def test_what_is_around_does_not_matter_to_a_blind_policy(self, runner):
        env, seeing = runner.env, runner.get_inference_policy("cpu")
        blind = covered(env, seeing)
        with torch.no_grad():
            observations = env.get_observations()
            other = observations.clone()
            other["frames"] = torch.rand_like(other["frames"])
            assert torch.equal(blind(observations), blind(other))
            assert not torch.allclose(seeing(observations), seeing(other))
            assert not torch.allclose(blind(observations), seeing(observations))

    def test_a_policy_without_a_lidar_cannot_be_covered(self, make_env):
        env = make_env(*BLIND, "scenario=static", "num_envs=2")
        with pytest.raises(ValueError, match="leave policy=blind out"):
            covered(env, None)
