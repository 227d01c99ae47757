"""The blind and the scripted policy: what they observe and which command they get."""

from pathlib import Path

import pytest
import torch

from omniperception import build, config
from omniperception.avoidance.velocity import AvoidanceConfig
from omniperception.build import build_runner, load_policy
from omniperception.env.env import OmniEnv
from omniperception.evaluation.baselines import covered, steered
from omniperception.perception import Attitude

ROOT = Path(__file__).resolve().parents[2]
BLIND = ("experiment=walk", "rewards=walk")
SEEING = ("experiment=quickstart", "scenario=static", "num_envs=3", "randomization=none")


class TestSteered:
    controller = AvoidanceConfig(num_sectors=36, threshold=1.5, alpha=2.0, max_speed=None)

    def commanded(self, env, limits):
        heard = []
        policy = steered(env, lambda obs: heard.append(obs["command"].clone()), self.controller, limits)
        policy(env.get_observations())
        return heard[0]

    def test_is_commanded_the_sum_within_its_trained_range(self, make_env):
        env = make_env(*BLIND, "scenario=static", "num_envs=2", "commands.spawn.yaw_deg=[0,0]")
        env.sim.mocap_pos[..., 2] = -100.0
        env.sim.mocap_pos[1, 2] = torch.tensor([50.0, 0.0, 0.3])
        given = env.get_observations()["command"].clone()
        assert torch.equal(self.commanded(env, None), given)  # nothing near: V_cmd alone
        side = env.obstacles.radius.max().item()
        env.sim.mocap_pos[1, 0, :2] = env.state.kinematics.base_pos_w[1, :2] + torch.tensor([0.0, side + 0.3])
        env.sim.mocap_pos[1, 0, 2] = 0.5  # to its left
        commanded = self.commanded(env, None)
        assert torch.equal(commanded[0], given[0])
        assert commanded[1, 1] < given[1, 1] - 0.5 and commanded[1, 2] == given[1, 2]
        limited = self.commanded(env, ((-0.5, 1.0), (-0.5, 0.5)))
        assert limited[1, 1] == -0.5 and limited[0, 0] == given[0, 0].clamp(max=1.0)
        assert torch.equal(env.get_observations()["command"], given)  # the task's command is what it was

    def test_what_the_policy_perceives_itself_does_not_matter(self):
        run = config.load(ROOT / "pretrained/avoider", ["scenario=corridor", "num_envs=4"])
        trained = load_policy(build.assemble(run), ROOT / "pretrained/avoider")
        env, controller = trained.env, trained.env.config.rewards.avoidance
        commanded = steered(env, trained.policy, controller, None)
        with torch.no_grad():
            for _ in range(30):
                env.step(commanded(env.get_observations()))
            seen = env.get_observations()
            other = seen.clone()
            other["frames"] = torch.rand_like(other["frames"])
            assert torch.equal(commanded(seen), commanded(other))
            other["frame_tick"] += 1  # a new frame, as the policy embeds each once
            assert not torch.allclose(trained.policy(seen), trained.policy(other))

    def test_needs_a_command_to_add_to(self, make_env):
        env = make_env(*BLIND, "scenario=static", "num_envs=2", "observations.actor=[proprioception]")
        env.observations = env.observations.exclude("command")
        with pytest.raises(ValueError, match="group 'command'"):
            steered(env, None, self.controller, None)


@pytest.fixture(scope="module")
def runner():
    """An untrained policy to which its embedding counts."""
    run = build.assemble(config.compose([*SEEING, "ppo.num_steps_per_env=4", "ppo.num_mini_batches=1"]))
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
        sensor = env.config.lidar
        attitude = Attitude(env.state.kinematics.base_quat_w.contiguous(), sensor.mount_pos, sensor.quat)
        env.config.sampler()(misses, frame.directions_s, frame.elevation, frame.azimuth, expected, attitude)
        assert heard[0].shape == env.sensing.frames.shape
        for k in range(heard[0].shape[1]):
            torch.testing.assert_close(heard[0][:, k], expected)
        assert not torch.equal(heard[0][:, -1], env.sensing.frames[:, -1])

    def test_how_the_base_moved_is_still_known(self):
        given = ("experiment=avoid", "scenario=static", "num_envs=3", "lidar.num_rays=200")
        env = OmniEnv(build.assemble(config.compose(given)).env)
        for _ in range(12):
            env.step(torch.randn(3, env.num_actions))
        frames, heard = env.get_observations()["frames"].clone(), []
        covered(env, lambda obs: heard.append(obs["frames"]))(env.get_observations())
        points = env.config.sampler().num_points
        assert frames.shape[2] == points + 1 and frames[:, -1, points].norm(dim=-1).min() > 0
        assert torch.equal(heard[0][:, :, points], frames[:, :, points])
        assert not heard[0][:, :, :points].any() and frames[:, :, :points].any()
        assert torch.equal(env.get_observations()["frames"], frames)  # what the robot itself sees is what it was

    def test_what_is_around_does_not_matter_to_a_blind_policy(self, runner):
        env, seeing = runner.env, runner.policy
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
