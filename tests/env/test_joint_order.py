"""Joints that the configuration lists in another order than the robot's file: the same robot, its numbers reordered."""

import numpy as np
import pytest
import torch
from rsl_rl.modules.distribution import GaussianDistribution
from stepping import tensors

from omniperception import build, config
from omniperception.build import build_runner
from omniperception.deploy.export import describe
from omniperception.env.mirror import mirrored_joints

ORDER = [7, 2, 11, 0, 9, 4, 1, 10, 3, 8, 5, 6]
JOINTS = tuple(f"{leg}_{part}_joint" for leg in ("FL", "FR", "RL", "RR") for part in ("hip", "thigh", "calf"))
PERMUTED = f"robot.joints=[{','.join(JOINTS[k] for k in ORDER)}]"
PER_JOINT = {"joint_pos_offset": 1, "joint_vel": 1, "previous_action": 1, "true_proprioception": 2}
"""How many numbers for each joint a term begins with."""
TASK = (
    "obstacles=moving",
    "perception=pd_risknet",
    "rewards=paper",
    "lidar.num_rays=200",
    "lidar.period_s=0.04",
    "randomization=paper",
    "randomization.joint_offset=null",
    "randomization.motor_strength=null",
    "observations.groups.proprioception.history=2",
)


def columns(env, group):
    """Which numbers of a group of the unpermuted robot are those of the permuted one."""
    index = []
    for _ in range(env.config.observations.groups[group].history):
        for term, width in env.observation_widths(group).items():
            own = [len(ORDER) * k + j for k in range(PER_JOINT.get(term, 0)) for j in ORDER]
            start = len(index)
            index += [start + k for k in (*own, *range(len(own), width))]
    return index


@pytest.mark.parametrize(
    "sim", ["sim=mujoco", pytest.param("sim=mujoco_warp sim.device=cpu", marks=pytest.mark.slow)]
)  # without a cache its kernels take minutes to compile
def test_trajectory_observations_and_rewards_are_those_of_the_same_robot(make_env, sim):
    plain, permuted = (make_env(*TASK, *sim.split(), *order) for order in ((), (PERMUTED,)))
    assert permuted.robot.joints != plain.robot.joints
    generator, resets = torch.Generator().manual_seed(0), 0
    for step in range(30):
        actions = torch.randn(plain.num_envs, 12, generator=generator) * (1 + step % 3)
        expected, reward, done, _ = plain.step(actions)
        found, *outcome, _ = permuted.step(actions[:, ORDER])
        if step == 10:
            for env in (plain, permuted):
                env.sim.qpos[1, 3:7] = torch.tensor([0.0, 1.0, 0.0, 0.0], dtype=env.sim.qpos.dtype)  # it fell
        assert torch.equal(plain.sim.qpos, permuted.sim.qpos) and torch.equal(plain.sim.qvel, permuted.sim.qvel)
        torch.testing.assert_close(outcome[0], reward, atol=1e-7, rtol=1e-5)  # float32 sums over joints
        assert torch.equal(done, outcome[1])
        for name, group in tensors(expected).items():
            if name in plain.config.observations.groups:
                group = group[:, columns(plain, name)]
            assert torch.equal(group, found[name]), name
        resets += int(done.sum())
    assert resets
    assert torch.equal(plain.state.joint_upper[ORDER], permuted.state.joint_upper)


def test_training_is_that_of_the_same_robot(monkeypatch):
    """One update from the same weights, inputs and outputs reordered; float32 sums in another order."""
    small = ("experiment=walk", "num_envs=8", "ppo.hidden_dims=[16]", "ppo.num_steps_per_env=12")
    runners = [build_runner(build.assemble(config.compose([*small, *order])), None) for order in ((), (PERMUTED,))]
    weights = [{name: p for name, p in r.alg.actor.named_parameters()} for r in runners]
    env = runners[0].env
    for part, groups in (("actor", env.config.observations.actor), ("critic", env.config.observations.critic)):
        index = []
        for group in groups:
            start = len(index)
            index += [start + k for k in columns(env, group)]
        plain, permuted = (getattr(runner.alg, part).state_dict() for runner in runners)
        for name, value in plain.items():
            value = value[ORDER] if part == "actor" and name.startswith("mlp.2") else value
            permuted[name].copy_(value[:, index] if name == "mlp.0.weight" else value)
    losses = []
    for runner, order in zip(runners, (slice(None), ORDER), strict=True):
        noise = torch.Generator().manual_seed(3)
        monkeypatch.setattr(
            GaussianDistribution,
            "sample",
            lambda self, g=noise, o=order: self.mean + self.std * torch.randn(*self.mean.shape, generator=g)[:, o],
        )
        torch.manual_seed(4)
        update = runner.alg.update
        runner.alg.update = lambda update=update: losses.append(update()) or losses[-1]
        runner.learn(1)
    assert losses[0].keys() == losses[1].keys() and losses[0]["surrogate"] != 0
    for name, loss in losses[0].items():
        assert losses[1][name] == pytest.approx(loss, rel=1e-3, abs=1e-5), name
    torch.testing.assert_close(weights[0]["mlp.2.weight"][ORDER], weights[1]["mlp.2.weight"], atol=1e-4, rtol=0)


def test_the_exported_description_and_the_mirror_have_the_listed_order(make_config, make_env):
    both = [("experiment=walk",), ("experiment=walk", PERMUTED)]
    plain, permuted = (describe(make_config(*o), make_env(*o)).joints for o in both)
    assert permuted.names == tuple(JOINTS[k] for k in ORDER)
    for key in ("default_pos", "torque_limits", "lower", "upper"):
        values = getattr(plain, key)
        assert getattr(permuted, key) == [values[k] for k in ORDER], key
    (plain_index, plain_sign), (index, sign) = (mirrored_joints(make_config(*o).env.robot) for o in both)
    assert [ORDER[k] for k in index] == plain_index[ORDER].tolist()
    assert np.array_equal(sign, plain_sign[ORDER])
