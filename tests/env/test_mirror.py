"""The mirror image of what a robot does is what its mirror image does."""

import pytest
import torch
from tensordict import TensorDict

from omniperception import build, config
from omniperception.build import build_runner
from omniperception.config import ConfigError
from omniperception.env.mirror import Mirror, mirrored_joints


def test_joints_of_the_go2(make_config):
    robot = make_config("experiment=walk").env.robot
    index, sign = mirrored_joints(robot)
    swap = {"L": "R", "R": "L"}
    assert [robot.joints[i] for i in index] == [name[0] + swap[name[1]] + name[2:] for name in robot.joints]
    assert sign.tolist() == [-1.0 if "hip" in name else 1.0 for name in robot.joints]


def test_mirrored_physics_gives_mirrored_observations(make_env):
    """Environment 1 starts as the mirror image of environment 0 and gets the images of its actions; every observation
    of it is then the image of the other's."""
    env = make_env("experiment=walk", "randomization=none", num_envs=2)
    mirror = Mirror(env)
    index, sign = (torch.as_tensor(part) for part in mirrored_joints(env.robot))
    torch.manual_seed(0)
    joints = env.state.default_joint_pos[0] + 0.1 * torch.randn(12)
    velocity, turning = torch.tensor([0.4, 0.3, 0.1]), torch.tensor([0.5, -0.4, 0.7])
    flip = torch.tensor([1.0, -1.0, 1.0])
    roll = 0.1
    for i, side in enumerate((1.0, -1.0)):
        env.sim.qpos[i, :3] = torch.tensor([0.0, 0.2 * side, 0.34])
        env.sim.qpos[i, 3:7] = torch.tensor([(1 - roll**2) ** 0.5, side * roll, 0.0, 0.0])
        env.sim.qpos[i, 7:19] = joints if side > 0 else joints[index] * sign
        env.sim.qvel[i, :3] = velocity if side > 0 else velocity * flip
        env.sim.qvel[i, 3:6] = turning if side > 0 else -turning * flip
        env.sim.qvel[i, 6:18] = 0.0
        env.command.value[i] = torch.tensor([0.7, 0.3 * side, -0.5 * side])
    for _ in range(8):
        action = torch.randn(1, 12)
        obs = env.step(torch.cat((action, action[:, index] * sign)))[0]
        names = [name for name in obs.keys() if name in env.config.observations.groups]  # noqa: SIM118
        one = TensorDict({name: obs[name][:1] for name in names}, batch_size=[1])
        both, _ = mirror(env, one, None)
        for name in names:
            torch.testing.assert_close(both[name][0], obs[name][0])
            torch.testing.assert_close(
                both[name][1], obs[name][1], atol=2e-2, rtol=1e-2, msg=lambda m, n=name: f"{n}: {m}"
            )
        assert len(names) == 4


def test_twice_mirrored_is_itself(make_env):
    env = make_env("experiment=walk", "observations.groups.proprioception.history=3", num_envs=5)
    mirror = Mirror(env)
    obs = TensorDict(
        {name: torch.randn_like(env.get_observations()[name]) for name in ("proprioception", "privileged")}, [5]
    )
    image = mirror(env, obs, None)[0][5:]
    again = mirror(env, image, None)[0][5:]
    for name in ("proprioception", "privileged"):
        assert torch.equal(again[name], obs[name]) and not torch.equal(image[name], obs[name])
    actions = torch.randn(5, 12)
    assert torch.equal(mirror(env, None, mirror(env, None, actions)[1][5:])[1][5:], actions)


def test_updates_see_both_sides():
    overrides = ("experiment=walk", "num_envs=8", "ppo.symmetry=true", "ppo.hidden_dims=[8]", "ppo.num_mini_batches=2")
    runner = build_runner(build.assemble(config.compose(overrides)), None)
    seen = []
    runner.alg.actor.register_forward_hook(lambda *call: seen.append(call[2].clone()) if call[0].training else None)
    runner.learn(1)
    assert runner.alg.symmetry.use_data_augmentation
    assert max(len(actions) for actions in seen) == 2 * 8 * 24 // 2  # mini-batches of half a rollout, and their images


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (("experiment=quickstart", "ppo.symmetry=true"), "with perception set ppo.symmetry=false"),
        (
            ("experiment=walk", "ppo.symmetry=true", "robot.default_joint_pos.FL_hip_joint=0.2"),
            "default_joint_pos is not its own mirror image",
        ),
        (
            ("experiment=walk", "ppo.symmetry=true", "+observations.groups.privileged.terms.heights={}"),
            "privileged.terms.heights does not say how it looks in the mirror",
        ),
        (
            ("experiment=gait", "ppo.symmetry=true", "robot.gait.offsets=[0.0,0.0,0.5,0.5]"),  # a bound
            "left and right feet do not step half a period apart",
        ),
    ],
)
def test_what_has_no_mirror_image_is_refused_in_one_line(overrides, message):
    with pytest.raises(ConfigError, match=message) as error:
        build_runner(build.assemble(config.compose([*overrides, "num_envs=2"])), None)
    assert "\n" not in str(error.value)
