"""The baselines: what they observe and which command they give."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from omniperception import build, config
from omniperception.avoidance.velocity import AvoidanceConfig
from omniperception.build import TrainedPolicy, load_policy
from omniperception.evaluation.trials.baselines import StopConfig, baseline, blind, free_share, prepared

ROOT = Path(__file__).resolve().parents[2]
AVOIDER = ROOT / "pretrained/avoider"
BLIND = ("experiment=walk", "rewards=walk")
CONTROLLER = AvoidanceConfig(num_sectors=36, threshold=1.5, alpha=2.0, max_speed=None)


def trained(name: str, *overrides: str, run_dir: Path = AVOIDER) -> TrainedPolicy:
    """The published policy, in an environment for the policy of this name."""
    run = build.assemble(config.load(run_dir, ["num_envs=4", *overrides]))
    return load_policy(replace(run, env=prepared(name, run.env, run.env.lidar)), run_dir)


def walk(env, policy, steps):
    with torch.no_grad():
        for _ in range(steps):
            env.step(policy(env.get_observations()))


class TestBlind:
    def test_acts_as_before_the_first_frame(self):
        seeing, unseeing = trained("run", "scenario=corridor"), trained("blind", "scenario=corridor")
        env, policy = unseeing.env, blind(unseeing.env, unseeing.policy)
        walk(env, policy, 30)
        walk(seeing.env, seeing.policy, 30)
        with torch.no_grad():
            felt, seen = env.get_observations(), seeing.env.get_observations()
            assert not felt["frame_count"].any() and not felt["frames"].any()
            assert (seen["frame_count"] > 0).all() and seen["frames"].any()
            before = seen.clone()
            for group in ("proprioception", "command", "action", "clock", "last_asked"):
                before[group] = felt[group]
            before.set_non_tensor("frame_tick", seen["frame_tick"] + 1)  # the policy embeds each frame once
            assert not torch.allclose(policy(felt), seeing.policy(before))
            before["frame_count"] = torch.zeros_like(before["frame_count"])
            assert torch.allclose(policy(felt), seeing.policy(before), atol=1e-6)

    def test_a_policy_without_a_lidar_is_blind_already(self, make_env):
        env = make_env(*BLIND, "scenario=static", "num_envs=2")
        with pytest.raises(ValueError, match="leave policy=blind out"):
            blind(env, None)
        shown = trained("run", "scenario=corridor")  # which sees frames
        with pytest.raises(ValueError, match="EnvConfig.network_sees_frames=False"):
            baseline("oracle", shown.env, shown.policy, CONTROLLER, None)


class TestOracle:
    def commanded(self, env, limits):
        heard = []
        policy = baseline("oracle", env, lambda obs: heard.append(obs["command"].clone()), CONTROLLER, limits)
        policy(env.get_observations())
        return heard[0]

    def test_is_commanded_the_sum_within_its_trained_range(self, make_env):
        env = make_env(*BLIND, "scenario=static", "num_envs=2", "commands.spawn.yaw_deg=[0,0]")
        env.sim.mocap_pos[..., 0] = 50.0
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


@pytest.mark.parametrize("name", ["oracle", "histogram", "stop"])
def test_the_driven_policy_perceives_nothing_itself(name):
    avoider = trained(name, "scenario=corridor")
    env, controller = avoider.env, avoider.env.config.rewards.avoidance
    driven = baseline(name, env, avoider.policy, controller, None)
    walk(env, driven, 30)
    with torch.no_grad():
        seen = env.get_observations()
        assert not seen["frame_count"].any() and not seen["frames"].any()
        other = seen.clone()
        other["frames"] = torch.rand_like(other["frames"])
        other.set_non_tensor("frame_tick", seen["frame_tick"] + 1)
        assert torch.equal(driven(seen), driven(other))


def test_a_driven_policy_needs_a_command_and_geometry_a_lidar(make_env):
    env = make_env(*BLIND, "scenario=static", "num_envs=2")
    with pytest.raises(ValueError, match="use lidar=mid360"):
        baseline("stop", env, None, CONTROLLER, None)
    env.observations = env.observations.exclude("command")
    with pytest.raises(ValueError, match="group 'command'"):
        baseline("oracle", env, None, CONTROLLER, None)


class TestFromClouds:
    """Before a wall of 4 m across the way, with nothing randomized."""

    def commanded(self, name, x, steps=12):
        wall = (
            f"{{wall: {{kind: box, count: 1, size: [[0.1, 0.1], [2.0, 2.0], [0.5, 0.5]], poses: [[{x}, 0.0, 0.0]]}}}}"
        )
        ahead = ("lin_vel_x=[0.8,0.8]", "lin_vel_y=[0,0]", "ang_vel_z=[0,0]", "standing=0", "spawn.yaw_deg=[0,0]")
        given = (
            "terrain=flat",
            "condition=ideal",
            "obstacles=none",
            f"+obstacles.groups={wall}",
            *(f"commands.{value}" for value in ahead),
        )
        avoider, heard = trained(name, *given, "num_envs=2"), []
        env = avoider.env

        def stand(observations):
            heard.append(observations["command"].clone())
            return torch.zeros(env.num_envs, env.num_actions)

        walk(env, baseline(name, env, stand, env.config.rewards.avoidance, None), steps)
        return torch.stack(heard), env.command.value

    def test_stop_stops_before_a_wall_and_only_there(self):
        far, command = self.commanded("stop", 4.0)
        torch.testing.assert_close(far[-1], command)
        near, command = self.commanded("stop", 0.75)  # its face is at 0.65 m
        assert near[-1, :, :2].abs().max() < 1e-6 and command[:, 0].min() > 0.3
        torch.testing.assert_close(near[-1, :, 2], command[:, 2])

    def test_histogram_brakes_before_a_wall_and_only_there(self):
        far, command = self.commanded("histogram", 5.5)
        torch.testing.assert_close(far[-1], command, atol=0.15, rtol=0.0)
        near, command = self.commanded("histogram", 0.75)
        assert (near[-1, :, 0] < 0.3 * command[:, 0]).all()


class TestFreeShare:
    config = StopConfig(stand=0.5, slow=1.5, half_width=0.3)

    def share(self, place, command):
        place = torch.tensor([[place]])
        return free_share(place, place.norm(dim=-1), torch.tensor([command]), self.config).item()

    def test_falls_with_the_distance_ahead_and_nowhere_else(self):
        assert self.share([2.0, 0.0], [1.0, 0.0]) == 1.0
        assert math.isclose(self.share([1.0, 0.2], [0.5, 0.0]), 0.5, abs_tol=1e-6)
        assert self.share([0.4, 0.0], [1.0, 0.0]) == 0.0
        assert self.share([0.6, 0.31], [1.0, 0.0]) == 1.0
        assert self.share([-0.6, 0.0], [1.0, 0.0]) == 1.0
        assert self.share([0.0, 0.5], [0.0, 1.0]) == 0.0  # ahead is where the command leads
        empty = free_share(torch.zeros(1, 4, 2), torch.full((1, 4), math.inf), torch.tensor([[1.0, 0.0]]), self.config)
        assert empty.item() == 1.0
