"""The environment's step: seeds, terminations, symmetry, what a run without LiDAR leaves out, observations."""

import math
from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch
from stepping import FULL, OTHERS, random_actions, still

from omniperception.env.env import OmniEnv
from omniperception.env.mdp.terms import ObservationGroup, StatefulTerm


def test_seeds_differ(make_env):
    first, second = (make_env(*FULL, f"seed={seed}") for seed in (1, 2))
    assert not torch.equal(first.get_observations()["command"], second.get_observations()["command"])
    assert not torch.equal(first.sim.mocap_pos, second.sim.mocap_pos)


class TestTerminations:
    def outcome(self, env, name):
        return env.outcomes[name].nonzero().flatten().tolist()

    def test_tilt_and_height(self, make_env):
        env = make_env(blind=True)
        half = [math.radians(angle) / 2 for angle in (55, 70)]
        env.sim.qpos[:, 2] = 2.0  # in the air, so that nothing rights them
        env.sim.qpos[0, 3:7] = torch.tensor([math.cos(half[0]), math.sin(half[0]), 0.0, 0.0])
        env.sim.qpos[1, 3:7] = torch.tensor([math.cos(half[1]), 0.0, math.sin(half[1]), 0.0])
        env.sim.qpos[2, 2] = 0.1
        _, _, done, extras = env.step(still(env))
        assert done.tolist() == [0, 1, 1, 0]
        assert self.outcome(env, "fall") == [1, 2]
        assert extras["time_outs"].sum() == 0

    def test_time_out_is_flagged_as_time_out_only(self, make_env):
        env = make_env("terminations.episode_length_s=0.1", blind=True)
        for step in range(5):
            if step == 4:
                env.sim.qpos[3, 2] = 0.05  # falls in the very step of the time limit
            _, _, done, extras = env.step(still(env))
            assert done.all() == (step == 4)
        assert self.outcome(env, "time_out") == [0, 1, 2]
        assert extras["time_outs"].tolist() == [1, 1, 1, 0]
        assert self.outcome(env, "fall") == [3]
        assert (env.episode_length_buf == 0).all()

    @pytest.mark.parametrize("ends", [False, True])
    def test_on_collision(self, make_env, ends):
        preset = "collision" if ends else "default"
        env = make_env(f"terminations={preset}", "obstacles=static", blind=True)
        env.sim.mocap_pos[2, 0, :2] = env.sim.qpos[2, :2]
        env.sim.mocap_pos[2, 0, 2] = 0.3
        _, _, done, _ = env.step(still(env))
        assert env.contacts.tolist() == [False, False, True, False]
        assert done.tolist() == [0, 0, int(ends), 0]
        assert self.outcome(env, "collision_end") == ([2] if ends else [])

    def test_a_touch_belongs_to_the_episode_that_was_interrupted(self, make_env):
        env = make_env("obstacles=static", "terminations.episode_length_s=0.1", blind=True)
        env.sim.mocap_pos[2, 0, :2], env.sim.mocap_pos[2, 0, 2] = env.sim.qpos[2, :2], 0.3
        env.step(still(env))
        assert env.metrics.collided.tolist() == [False, False, True, False]
        env.reset(torch.tensor([2]))
        assert not env.metrics.collided.any()

    def test_a_contact_in_any_physics_step_counts(self, make_env):
        """An obstacle that goes through the trunk's corner within one control step is felt at its end."""
        env = make_env("obstacles=moving", "obstacles.groups.walker.count=1", blind=True)
        env.sim.qpos[:, 3:7] = torch.tensor([1.0, 0.0, 0.0, 0.0])
        env.sim.mocap_pos[:, 0, :2] = torch.tensor([5.0, 5.0])
        env.obstacles.velocity_w[:] = 0.0
        env.sim.mocap_pos[1, 0] = torch.tensor([-1.0, 0.0, 0.8])
        env.obstacles.velocity_w[1, 0, 0] = 200.0  # 1 m per physics step, 4 m per control step
        env.step(still(env))
        assert env.contacts.tolist() == [False, True, False, False]
        assert env.sim.mocap_pos[1, 0, 0] > 1.0

    def test_goal(self, make_env):
        env = make_env("commands=corridor", "obstacles=corridor", blind=True)
        env.sim.qpos[2, 0] = 11.6
        _, _, done, extras = env.step(still(env))
        assert done.tolist() == [0, 0, 1, 0] and self.outcome(env, "goal") == [2]
        assert extras["time_outs"].tolist() == [0, 0, 1, 0]  # no failure: what would have come is not lost

    @pytest.mark.parametrize(
        "wrong", ["episode_length_s=0", "max_tilt_deg=0", "max_tilt_deg=181", "min_base_height=-1"]
    )
    def test_wrong_settings_are_refused(self, make_config, wrong):
        key, value = wrong.split("=")
        with pytest.raises(ValueError, match=rf"terminations\.{key}={value}"):
            make_config(f"terminations.{wrong}")


class TestYawEquivariance:
    """Robot, obstacles and command in the world turned together: nothing rewarded or seen changes."""

    TURN = 1.1

    def place(self, env, turn):
        """One robot in the air, so that no friction cone knows the world's axes, among moving obstacles."""
        rng = np.random.default_rng(0)
        rotation = np.array([math.cos(turn / 2), 0, 0, math.sin(turn / 2)])
        matrix = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
        quat = np.array([1.0, 0.1, -0.15, 0.3])
        turned = np.zeros(4)
        mujoco.mju_mulQuat(turned, rotation, quat / np.linalg.norm(quat))
        env.sim.qpos[0, :3] = torch.tensor([0.0, 0.0, 0.7])
        env.sim.qpos[0, 3:7] = torch.from_numpy(turned)
        env.sim.qpos[0, 7:] += torch.from_numpy(rng.uniform(-0.2, 0.2, 12))
        env.sim.qvel[0] = torch.from_numpy(rng.uniform(-0.5, 0.5, 18))
        env.sim.qvel[0, :2] = torch.from_numpy(matrix @ env.sim.qvel[0, :2].numpy())
        for field in (env.sim.mocap_pos[0, :, :2], env.obstacles.velocity_w[0]):
            field.copy_(torch.from_numpy(field.numpy() @ matrix.T))
        half = env.sim.mocap_quat[0].numpy().copy()
        for i, quat in enumerate(half):
            mujoco.mju_mulQuat(env.sim.mocap_quat[0, i].numpy(), rotation, quat)
        env.sim.mocap_pos[0, 0, :2] = torch.from_numpy(matrix @ np.array([0.7, 0.4]))

    @pytest.mark.parametrize("preset", ["paper", "default"])
    def test_step(self, make_env, preset):
        envs = [make_env("obstacles=moving", f"rewards={preset}", num_envs=1) for _ in range(2)]
        outcomes = []
        for env, turn in zip(envs, (0.0, self.TURN), strict=True):
            env.command.value[:] = torch.tensor([0.5, -0.2, 0.3])
            self.place(env, turn)
            for action in random_actions(env, 5, scale=0.5):
                observations, reward, done, _ = env.step(action)
            assert env.sensing.due(env.step_count) and not done.any()
            outcomes.append({**dict(observations), "reward": reward})
        straight, turned = outcomes
        assert (envs[0].avoidance.sector_distance < 1).any()
        assert envs[0].avoidance.velocity.norm() > 0.1
        for name in ("proprioception", "command", "privileged", "reward"):
            torch.testing.assert_close(straight[name], turned[name], atol=2e-4, rtol=0, msg=name)
        ahead, aside = (env.sensing.frame.true_ranges for env in envs)
        assert ahead.isfinite().any()
        far = (ahead.nan_to_num(posinf=99.0) - aside.nan_to_num(posinf=99.0)).abs() > 1e-3
        assert far.float().mean() < 0.03  # a ray at an edge may hit the other side of it


class TestWithoutLidar:
    def test_blind_runs_build_nothing_of_it(self, make_env):
        env = make_env("obstacles=moving", blind=True)
        assert env.sensing is None
        for action in random_actions(env, 24, scale=0.1):
            observations, _, _, extras = env.step(action)
        assert not {"frames", "frame_count", "height_target"} & set(observations.keys())
        stages = {key for key in extras["log"] if key.startswith("Time/")}
        assert not any("rays" in stage or "sampling" in stage or "sectors" in stage for stage in stages)
        assert "Time/physics_us_per_env_step" in stages

    def test_free_ground_has_no_obstacle_stage(self, make_env):
        env = make_env("obstacles=none", blind=True)
        env.step(torch.zeros(4, 12))
        assert env.obstacles is None and "obstacles" not in env.timer.seconds
        assert env.world.model.nsensor == 0 and env.world.model.nmocap == 0


def test_observations_have_history_and_forget_at_a_reset(make_env):
    env = make_env("obstacles=none", blind=True)
    proprioception = env.get_observations()["proprioception"]
    assert proprioception.shape == (4, 330)
    assert (proprioception.unflatten(1, (10, 33)) == proprioception[:, None, :33]).all()
    actions = random_actions(env, 3)
    env.step(actions[0])
    before = env.step(actions[1])[0]["proprioception"].unflatten(1, (10, 33)).clone()
    env.sim.qpos[1, 3:7] = torch.tensor([0.0, 1.0, 0.0, 0.0])
    observations = env.step(actions[2])[0]
    after = observations["proprioception"].unflatten(1, (10, 33))
    assert torch.equal(after[OTHERS, :-1], before[OTHERS, 1:])
    assert (after[1] == after[1, :1]).all()
    assert after[1, 0, :12].abs().max() < 1e-6 and after[1, 0, -3:].tolist() == [0, 0, -1]
    assert torch.equal(observations["action"][OTHERS], actions[2][OTHERS]) and (observations["action"][1] == 0).all()


class Total(StatefulTerm):
    """How often it has been asked since the episode began."""

    def __init__(self):
        self.count = torch.zeros(4)

    def __call__(self, state):
        self.count = self.count + 1.0
        return self.count[:, None]

    def reset(self, env_ids):
        self.count = self.count.index_fill(0, env_ids, 0.0)


def test_a_reset_between_steps_advances_no_term_of_the_others(make_env):
    task = make_env("obstacles=none", blind=True).config
    groups = {**task.observations.groups, "action": ObservationGroup({"total": Total}, history=2)}
    env = OmniEnv(replace(task, observations=replace(task.observations, groups=groups)))
    for _ in range(3):
        before = env.step(torch.zeros(4, 12))[0]["action"].tolist()
    after = env.reset(torch.tensor([1]))["action"].tolist()
    assert after[1] == [1.0, 1.0] and [after[k] for k in OTHERS] == [before[k] for k in OTHERS]
    now = env.step(torch.zeros(4, 12))[0]["action"]
    assert now[1].tolist() == [1.0, 2.0] and now[0].tolist() == [before[0][1], before[0][1] + 1.0]


def test_a_reset_right_after_a_loaded_state(make_env):
    """As a viewer does; the terrain's levels ask how the episodes ended."""
    given = ("terrain=mixed", "obstacles=none")
    whole, resumed = (make_env(*given, blind=True) for _ in range(2))
    whole.step(torch.zeros(4, 12))
    resumed.load_state_dict(whole.state_dict())
    for env in (whole, resumed):
        env.reset()
    assert torch.equal(whole.sim.qpos, resumed.sim.qpos)


def test_an_assigned_clock_is_the_states(make_env):
    """As rsl_rl's runner does, with init_at_random_ep_len."""
    env = make_env("obstacles=none", blind=True)
    env.episode_length_buf = torch.tensor([3, 0, 10, 7])
    assert env.state.time_s.tolist() == pytest.approx([0.06, 0.0, 0.2, 0.14])
    env.step(torch.zeros(4, 12))
    assert env.state.time_s.tolist() == pytest.approx([0.08, 0.02, 0.22, 0.16])


@pytest.mark.parametrize(
    "given", [("obstacles=moving", "randomization=robot"), ("scenario=maze",), ("scenario=people",), ("terrain=mixed",)]
)
def test_a_reset_after_steps_in_inference_mode(make_env, given):
    env = make_env("experiment=avoid", *given, "lidar.num_rays=50", "lidar.selection=every_kth")
    with torch.inference_mode():
        for _ in range(6):
            env.step(torch.full((4, 12), torch.nan))
    env.reset()
    env.step(torch.zeros(4, 12))


def test_obstacles_approach_along_the_route_of_their_own_episode(make_env, monkeypatch):
    given = ("scenario=maze", "+obstacles.groups.person={kind:cylinder,count:1,size:[[0.2,0.2],[0.8,0.8]],speed:[1,1]}")
    env = make_env(*given, "+obstacles.groups.person.approach={within:0.1,distance:[2.0,3.0]}", blind=True)
    told, start = [], env.obstacles._start_approach
    monkeypatch.setattr(env.obstacles, "_start_approach", lambda *given: (told.append(given[-1]), start(*given)))
    env.reset()
    ahead = (env.command.along < 3.0).sum(1, keepdim=True)[..., None].expand(-1, 1, 2)
    way = env.command.route_w.gather(1, ahead)[:, 0] - env.state.kinematics.base_pos_w[:, :2]
    speed = env.config.commands.speed
    torch.testing.assert_close(told[0].float(), speed * way / way.norm(dim=1, keepdim=True), atol=1e-5, rtol=0)


def test_nearest_obstacles_by_hand(make_env):
    """Per obstacle x/4, y/4, relative velocity, radius, 1 - edge distance / 4, nearest edge first."""
    env = make_env("obstacles=moving", "obstacles.groups.walker.count=2", num_envs=1)
    env.sim.qpos[0, 3:7] = torch.tensor([math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)])  # faces +y
    env.sim.mocap_pos[0, :, :2] = torch.tensor([[0.0, 3.0], [2.0, 0.0]])
    env.obstacles.velocity_w[0] = torch.tensor([[0.0, -1.0], [0.0, 0.0]])
    observations = env.step(torch.zeros(1, 12))[0]
    group = env._groups["privileged"]
    seen = observations["privileged"][0, group.slices["nearest_obstacles"]].unflatten(0, (2, 6))
    radius = env.obstacles.radius[0].float()
    velocity = env.state.kinematics.base_lin_vel_yaw[0]
    near, ahead = seen
    assert near[:2].tolist() == pytest.approx([0.0, -0.5], abs=2e-3)  # to its right
    assert near[2:4].tolist() == pytest.approx((-velocity).tolist(), abs=1e-6)
    assert near[4].item() == pytest.approx(radius[1].item())
    assert near[5].item() == pytest.approx(1 - (2 - radius[1].item()) / 4, abs=2e-3)
    assert ahead[0].item() == pytest.approx((3 - 0.02) / 4, abs=2e-3)  # has come 2 cm in 0.02 s
    assert ahead[2].item() == pytest.approx(-1 - velocity[0].item(), abs=1e-5)
