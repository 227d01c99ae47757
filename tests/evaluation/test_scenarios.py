"""Scenarios: fixed scenes, seeded, the same for every policy; what they replace and what they measure."""

import pytest
import torch

from omniperception import build, config
from omniperception.evaluation.trials.episodes import run_episodes
from omniperception.evaluation.trials.outcomes import CLEARANCE_CAP
from omniperception.evaluation.trials.tracks import PERIOD_S

BLIND = ("experiment=walk", "rewards=walk")
SHORT = "terminations.episode_length_s=0.4"


def stand(observations):
    return torch.zeros(len(observations), 12)


def fling(observations):
    actions = torch.zeros(len(observations), 12)
    actions[:, 1::3], actions[:, 2::3] = 8.0, -8.0
    return actions


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory):
    """A run with some settings of its own."""
    path = tmp_path_factory.mktemp("run")
    given = ["experiment=quickstart", "rewards.avoidance.alpha=1.7", "seed=5", "lidar.max_range=5.0"]
    config.save(build.assemble(config.compose(given)).composed, path)
    return path


class TestOverlay:
    def test_the_scene_is_the_scenarios_and_the_rest_the_runs(self, run_dir):
        before, loaded = config.load(run_dir), config.load(run_dir, ["scenario=abs_hard"])
        fresh = config.compose(["scenario=abs_hard"])
        for key in loaded:
            assert loaded[key] == (fresh if key in config.FIXED_BY_SCENARIO else before)[key], key
        run = build.assemble(loaded).env
        assert run.seed == 1007 and run.terminations.episode_length_s == 9.0 and run.obstacles.num_obstacles == 8
        assert run.rewards.avoidance.alpha == 1.7 and run.lidar.max_range == 5.0
        assert len({config.compose([f"scenario={name}"]).seed for name in config.presets("scenario")}) == 21
        assert run.obstacles.curriculum is None and before.obstacles.curriculum is not None

    @pytest.mark.parametrize("scenario", config.presets("scenario"))
    def test_an_experiment_leaves_no_trace_in_the_scene(self, scenario):
        alone, mixed = (config.compose([*given, f"scenario={scenario}"]) for given in ([], ["experiment=quickstart"]))
        for key in config.FIXED_BY_SCENARIO:
            assert alone[key] == mixed[key], key


class TestMeasures:
    def test_measuring_changes_nothing(self, make_env):
        measured, plain = (
            make_env(*BLIND, "scenario=static", SHORT, "num_envs=3", "commands.spawn.x=[1.2,1.2]") for _ in range(2)
        )
        steps = []
        run_episodes(measured, fling, 6, on_step=lambda: steps.append(0), keep_tracks=True)
        for _ in steps:
            plain.step(fling(plain.get_observations()))
        assert torch.equal(measured.sim.qpos, plain.sim.qpos) and torch.equal(measured.sim.qvel, plain.sim.qvel)
        assert torch.equal(measured.observations["command"], plain.observations["command"])
        assert not measured.step_hooks

    def test_clearance_is_the_least_of_the_trial_and_0_with_a_touch(self, make_env):
        env = make_env(*BLIND, "scenario=static", SHORT, "num_envs=4", "commands.spawn.yaw_deg=[0,0]")
        env.obstacles.advance = lambda dt, xy: None  # the test moves them
        radius = env.obstacles.radius[:, 0]

        def place(observations):
            step = int(env.episode_length_buf[0])
            env.obstacles.pos_w[..., 0] = 50.0
            at = {1: {3: 0.9, 10: 0.6, 11: 0.6, 15: 0.8}, 2: {10: 0.0}, 3: {10: 3.0}}
            for env_id, steps in at.items():
                beside = env.state.kinematics.base_pos_w[env_id, :2] + torch.tensor(
                    [0.0, radius[env_id] + steps.get(step, 40.0)]
                )
                env.obstacles.pos_w[env_id, 0, :2] = beside.double()
                env.obstacles.pos_w[env_id, 0, 2] = 0.3
            return torch.zeros(4, 12)

        episodes = run_episodes(env, place, 4)
        touch = episodes.first_contact_s
        assert touch.isinf().tolist() == [True, True, False, True] and touch[2] == pytest.approx(11 * 0.02)
        assert episodes.clearance[[0, 2, 3]].tolist() == pytest.approx([CLEARANCE_CAP, 0.0, CLEARANCE_CAP])
        # beside the robot: 0.6 m less half its width at the knees or feet, 0.14 to 0.2 m
        assert 0.38 < episodes.clearance[1] < 0.47

    def test_energy_is_power_over_time(self, make_env):
        env = make_env(*BLIND, "scenario=static", SHORT, "num_envs=2")
        power, speed = [], []
        env.step_hooks.append(
            lambda: power.append((env.sim.joint_torque() * env.state.kinematics.joint_vel).abs().sum(1).clone())
        )
        env.step_hooks.append(lambda: speed.append(env.sim.qvel[:, :2].norm(dim=1).clone()))
        episodes = run_episodes(env, fling, 2)
        steps = (episodes.length_s / 0.02).round().long()
        for i in range(2):
            energy = 0.02 * torch.stack(power)[: steps[i], i].double().sum()
            assert episodes.energy[i].item() == pytest.approx(energy.item(), rel=1e-5)
            path = 0.02 * torch.stack(speed)[: steps[i], i].sum()
            assert episodes.path[i].item() == pytest.approx(path.item(), rel=1e-4)
        assert episodes.weight == pytest.approx(15.2 * 9.81, rel=0.03)  # the Go2 weighs about 15 kg

    def test_scenes_show_obstacles_in_the_sizes_of_their_trial(self, make_env):
        """Those that the physics has, by environment; what has not been placed is not there."""
        env = make_env(*BLIND, "scenario=static", SHORT, "num_envs=3")
        ids = [env.world.model.geom(part.name).id for part in env.obstacles.parts]
        sizes = env.sim.model_field("geom_size")[:, ids].float().clone()
        tracks = run_episodes(env, stand, 3, keep_tracks=True).tracks
        parts = tracks.parts
        there = ~parts[..., 0].isnan()
        box = torch.tensor(["crate" in part.name for part in env.obstacles.parts]).expand_as(there)
        assert there.sum() >= 9 and (parts[..., 3][there].unique().numel()) == there.sum()  # all of other sizes
        torch.testing.assert_close(parts[..., 3][there], sizes[..., 0][there])
        torch.testing.assert_close(parts[..., 4][there & box], sizes[..., 1][there & box])
        assert (parts[..., 4][there & ~box] < 0).all()  # round

    def test_tracks_end_where_the_episode_ends(self, make_env):
        env = make_env(*BLIND, "scenario=abs_hard", SHORT, "num_envs=2")
        ends = []
        env.step_hooks.append(lambda: ends.extend(env.state.kinematics.base_pos_w[env.done, :2].tolist()))
        tracks = run_episodes(env, stand, 2, keep_tracks=True).tracks
        assert [len(way) for way in tracks.xy] == [1 + round(0.4 / PERIOD_S)] * 2
        for way, end in zip(tracks.xy, ends, strict=True):
            assert way[-1].tolist() == pytest.approx(end)
        assert tracks.contact.isnan().all()
