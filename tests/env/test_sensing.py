"""The task's LiDAR: its ticks, its history of frames, and what a reset forgets."""

import math
from dataclasses import replace

import pytest
import torch
from stepping import OTHERS, assert_equal, assert_same, outcome, random_actions, still

from omnilidar import OUTPUTS, Lidar
from omniperception.env.build import build_sampler
from omniperception.env.consumers import FrameConsumer
from omniperception.env.env import OmniEnv
from omniperception.env.mdp.terms import RewardTerm
from omniperception.env.state import requires


def test_frames_come_at_tick_times_only(make_env):
    env = make_env("obstacles=static")
    observations = env.get_observations()
    first = observations["frame_tick"]
    assert env.sensing.period_steps == 5
    for step in range(1, 16):
        before = observations["frames"].clone()
        observations = env.step(still(env))[0]
        changed = not torch.equal(before, observations["frames"])
        assert changed == (step % 5 == 0), step
        assert observations["frame_tick"] == first + step // 5
        assert (observations["frame_count"] == 1 + step // 5).all()
        if changed:
            assert torch.equal(observations["frames"][:, :-1], before[:, 1:])


def test_frame_count_stops_at_the_history_and_points_lie_within_the_range(make_env):
    """Points are in units of the range, 6 m; the sensor begins at 0.1 m."""
    env = make_env("obstacles=static", "perception.history=3", "lidar.period_s=0.02")
    counts = [int(env.step(still(env))[0]["frame_count"][0]) for _ in range(5)]
    assert counts == [2, 3, 3, 3, 3]
    assert env.sensing.history.frames.shape[:2] == (4, 3)
    distance = env.sensing.history.frames.norm(dim=-1)
    assert distance.max() <= 1.0 + 1e-6 and distance[distance > 0].min() >= 0.1 / 6.0 - 1e-6


def test_a_reset_clears_that_environments_frames_only(make_env):
    env = make_env("obstacles=static", "rewards=paper")
    for _ in range(6):
        env.step(still(env))
    before, tick = env.sensing.history.frames.clone(), env.get_observations()["frame_tick"]
    sectors = env.avoidance.sector_distance.clone()
    env.sim.qpos[1, 2] = 0.05
    observations, _, done, _ = env.step(still(env))
    assert done.tolist() == [0, 1, 0, 0]
    assert observations["frame_count"].flatten().tolist() == [2, 0, 2, 2]
    assert (observations["frames"][1] == 0).all()
    assert torch.equal(observations["frames"][OTHERS], before[OTHERS])
    assert observations["frame_tick"] == tick  # by which an actor knows that it has embedded the others' frames
    assert torch.equal(env.avoidance.sector_distance[OTHERS], sectors[OTHERS])
    assert (env.avoidance.sector_distance[1] == 6.0).all()
    assert env.sensing.mean_distal_range(6.0)[1] == 6.0  # the last episode's distances are forgotten, too
    for _ in range(3):
        observations = env.step(still(env))[0]
    assert observations["frame_count"].flatten().tolist() == [3, 1, 3, 3]
    assert observations["frame_tick"] == tick + 1
    assert (observations["frames"][1, :-1] == 0).all() and (observations["frames"][1, -1] != 0).any()
    assert env.sensing.mean_distal_range(6.0)[1] < 6.0


def test_sector_distance_of_a_pillar_by_hand(make_env):
    """A pillar of known radius 2 m to the left: 36 sectors from -180 deg, so sectors 26 and 27 see it."""
    env = make_env("obstacles=static", "lidar.num_rays=20000", num_envs=1)
    env.sim.qpos[0, 3:7] = torch.tensor([math.cos(0.4), 0.0, 0.0, math.sin(0.4)])  # yaw 0.8
    left = 0.8 + math.pi / 2
    env.sim.mocap_pos[0, :, 2] = -100.0
    env.sim.mocap_pos[0, 0] = torch.tensor([2 * math.cos(left), 2 * math.sin(left), 0.5])
    for _ in range(5):
        env.step(still(env))
    sectors = env.avoidance.sector_distance[0]
    radius = env.obstacles.radius[0, 0].item()
    base_shift = env.state.kinematics.base_pos_w[0, :2].norm().item()
    for sector in (26, 27):
        assert sectors[sector].item() == pytest.approx(2 - radius, abs=0.02 + base_shift)
    assert (sectors[[*range(20), *range(34, 36)]] == 6.0).all()


def test_ground_and_own_legs_never_count_as_obstacles(make_env):
    env = make_env("obstacles=none", "perception=none")
    for _ in range(10):
        env.step(still(env))
    assert (env.avoidance.sector_distance == 6.0).all()
    assert torch.isfinite(env.sensing.frame.true_ranges).float().mean() > 0.3  # though rays do hit the ground


def test_distal_range_is_the_mean_of_capped_distances(make_env):
    env = make_env("obstacles=static", "rewards=paper")
    assert (env.sensing.mean_distal_range(2.5) == 2.5).all()  # averaged from the next frame on
    for _ in range(5):
        env.step(still(env))
    frame = env.sensing.frame
    for ranges, elevation, mean in zip(
        frame.true_ranges.double(), frame.elevation, env.sensing.mean_distal_range(2.5), strict=True
    ):
        expected = ranges[elevation < math.radians(20)].clamp(max=2.5).mean()
        assert mean.item() == pytest.approx(expected.item(), rel=1e-4)


def test_noise_reaches_the_points_and_not_the_reward(make_env):
    clean, noisy = make_env("obstacles=static"), make_env("obstacles=static", "randomization=lidar")
    torch.testing.assert_close(clean.avoidance.sector_distance, noisy.avoidance.sector_distance)
    assert torch.equal(clean.sensing.frame.true_ranges, noisy.sensing.frame.true_ranges)
    assert not torch.equal(clean.sensing.history.frames, noisy.sensing.history.frames)


def test_sector_target_is_the_nearness_of_obstacles(make_env):
    """1 - d / 4 m, and 0 from 4 m on."""
    env = make_env("obstacles=static", "perception.sector_weight=1.0")
    env.avoidance.sector_distance[0, :5] = torch.tensor([0.0, 1.0, 3.0, 4.0, 6.0])
    target = env.step(still(env))[0]["sector_target"]
    assert target[0, :5].tolist() == pytest.approx([1.0, 0.75, 0.25, 0.0, 0.0])
    assert "sector_target" not in make_env("obstacles=static").get_observations().keys()  # noqa: SIM118


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("lidar.period_s=0.03", r"lidar\.period_s=0\.03 must be a multiple"),
        ("lidar.period_s=0.005", r"lidar\.period_s=0\.005 must be a multiple"),
        ("lidar.motion_segments=2", r"motion_segments=2 must be 0 or divide the 5 control steps"),
        ("lidar.cloud_mb=0.0", r"lidar\.cloud_mb"),
    ],
)
def test_wrong_settings_are_refused(make_env, override, message):
    with pytest.raises(ValueError, match=message):
        make_env("obstacles=static", override)


@pytest.mark.parametrize(("robot", "base_height"), [("go2", "0.33"), ("go1", "0.325"), ("anymal", "0.55")])
def test_bands_of_height_that_begin_above_the_ground_are_refused(make_config, robot, base_height):
    task = make_config(f"robot={robot}", f"robot.base_height={base_height}", "perception=proximity_gru").env
    if robot != "anymal":
        assert build_sampler(task) is not None
        return
    with pytest.raises(ValueError, match=r"band_edges begins 0\.21 m above the ground.*begin it at -0\.56"):
        build_sampler(task)


def test_no_frames_until_the_curriculum_has_obstacles(make_env):
    env = make_env("experiment=quickstart", "perception.sampler.num_proximal=8")
    for _ in range(6):
        env.step(still(env))
    assert env.obstacles.level == 0.0 and env.sensing.tick == 0 and not env.sensing.history.count.any()
    assert "rays" not in env.timer.seconds
    env.obstacles.level = 0.5
    for _ in range(5):
        observations = env.step(still(env))[0]
    assert env.sensing.tick == 1 and (observations["frame_count"] == 1).all()


def test_walls_are_seen_at_every_level_of_the_curriculum(make_env):
    env = make_env("experiment=quickstart", "obstacles=corridor", "commands=corridor", "lidar.num_rays=2000")
    for _ in range(6):
        env.step(still(env))
    assert env.obstacles.level == 0.0 and env.sensing.tick > 0
    assert (env.avoidance.sector_distance.amin(1) < 2.6).all()  # from half a metre beside the middle of four


def test_nothing_is_computed_that_the_task_does_not_read(make_env):
    def outputs(*overrides):
        frame = make_env(*overrides).sensing.lidar.frame
        return {name for name in OUTPUTS if getattr(frame, name) is not None}

    sampled, sectors = {"ranges", "directions_s", "elevation", "azimuth"}, {"true_ranges", "directions_s", "class_id"}
    assert outputs("rewards=default") == sampled | sectors
    assert outputs("rewards=default", "perception=none") == sectors
    assert outputs("rewards=paper", "perception=none") == sectors | {"elevation"}


def take_frame(env, time_s):
    env.sensing.take_frame(time_s, env.state.measured.base_quat_w, env.timer)


def test_motion_distortion_starts_where_the_last_frame_ended_and_forgets_the_last_episode(make_env):
    """A robot that is placed again has not swept there; a robot that turns has, also after a saved state is loaded."""
    moving = ("obstacles=static", "lidar.motion_segments=1", "lidar.motion_jump=100.0")
    whole, resumed, instant = (make_env(*given, num_envs=2) for given in (moving, moving, ("obstacles=static",)))
    whole.sim.qpos[:, :2] += 0.3
    take_frame(whole, 0.1)
    resumed.sensing.load_state_dict(whole.sensing.state_dict())
    for env in (whole, resumed, instant):
        env.sim.qpos[:, :2] = 3.0
        env.sensing.reset(torch.tensor([0]), env.state.measured)
        take_frame(env, 0.2)
    found, again, expected = (env.sensing.frame.true_ranges for env in (whole, resumed, instant))
    assert torch.equal(found, again)
    torch.testing.assert_close(found[0], expected[0], rtol=1e-6, atol=1e-6)
    assert not torch.allclose(found[1], expected[1], rtol=1e-3)


def test_rays_within_a_frame_follow_the_robot_by_control_steps(make_env):
    """As a LiDAR of its own on the same scene, given the bodies' poses after each of the frame's five control steps."""
    env = make_env("obstacles=static", "lidar.motion_segments=5", "perception=none", num_envs=2)
    sensing, outputs = env.sensing, env.sensing.lidar.outputs
    lidar = Lidar(sensing.config, sensing.config.pattern(), sensing.scene, sensing.base, outputs=outputs)
    lidar.phase_rows.copy_(sensing.lidar.phase_rows)
    lidar.load_state_dict(sensing.lidar.state_dict())
    actions = random_actions(env, 5, scale=0.5)
    for step, action in enumerate(actions):
        env.step(action)
        pos, quat = env.sim.body_poses(sensing._bodies)
        sensing.scene.body_pos.copy_(pos)
        sensing.scene.body_quat.copy_(quat)
        if step < 4:
            lidar.record_poses()
    expected = lidar.cast(5 * env.control_dt).true_ranges
    assert torch.equal(sensing.frame.true_ranges, expected)
    straight = make_env("obstacles=static", "lidar.motion_segments=1", "perception=none", num_envs=2)
    for action in actions:
        straight.step(action)
    assert not torch.allclose(straight.sensing.frame.true_ranges, expected, rtol=1e-3)


def test_time_begins_anew_within_a_frame_of_several_segments(make_env):
    """A seeded reset forgets the moments noted before it; the frames after it are those of a fresh environment."""
    given = ("obstacles=static", "lidar.motion_segments=5", "perception=none")
    env, fresh = (make_env(*given, num_envs=2) for _ in range(2))
    for action in random_actions(env, 3):
        env.step(action)
    seeds = torch.tensor([4, 9])
    for each in (env, fresh):
        each.reset(seeds=seeds)
        for action in random_actions(each, 5, scale=0.5):
            each.step(action)
    assert torch.equal(env.sensing.frame.true_ranges, fresh.sensing.frame.true_ranges)


def test_everybody_may_begin_again_before_the_first_step(make_env):
    """Moments within a frame are missed then, and are not asked for; so does another task's state begin."""
    given = ("obstacles=static", "lidar.motion_segments=5", "perception=none")
    env = make_env(*given, num_envs=2)
    env.reset()
    env.reset()
    env.begin_at_levels_of(env.state_dict())
    for action in random_actions(env, 5):
        env.step(action)
    assert env.sensing.tick == 5  # a frame at each beginning, and one after five steps


class TestSlices:
    """Clouds of some environments after those of others give what all at once give."""

    TASKS = (
        ("rewards=paper", "obstacles=moving"),
        ("experiment=avoid", "terrain=flat", "obstacles=crowd", "randomization=device"),
        ("obstacles=static", "perception=fps_gru", "lidar.motion_segments=1"),
    )

    @pytest.mark.parametrize("task", TASKS)
    def test_bit_for_bit(self, make_env, task):
        whole, sliced = (make_env(*task, f"lidar.cloud_mb={mb}", num_envs=5) for mb in ("1000.0", "0.1"))
        sizes = [each.stop - each.start for each in sliced.sensing.lidar.env_slices]
        assert (
            len(whole.sensing.lidar.env_slices) == 1 < len(sizes) and sum(sizes) == 5 and max(sizes) - min(sizes) <= 1
        )
        assert len(sliced.sensing.lidar.frame.ranges) == max(sizes)
        for step in range(23):
            for env in (whole, sliced):
                env.episode_length_buf[step % 5] = env.max_episode_length - 1 if step % 4 == 1 else 5
            actions = 0.3 * torch.sin(torch.arange(60.0).reshape(5, 12) + step)
            assert_equal(outcome(whole, actions)[0], outcome(sliced, actions)[0])
        for consumer, other in zip(*(each.sensing.consumers.values() for each in (whole, sliced)), strict=True):
            assert_same(consumer.state_dict(), other.state_dict())

    def test_reading_a_whole_cloud_that_does_not_fit_is_refused(self, make_env):
        env = make_env("obstacles=static", "lidar.cloud_mb=0.1", num_envs=5)
        with pytest.raises(ValueError, match=r"5 environments take more than lidar\.cloud_mb=0\.1"):
            _ = env.sensing.frame

    def test_a_term_of_ones_own_that_reads_rays_gets_whole_clouds(self, make_env):
        @requires("cloud")
        def nearest(state):
            frame = state.cloud
            return torch.ones(5) if frame is None else frame.true_ranges.amin(1)

        config = make_env("obstacles=static", "lidar.cloud_mb=0.1", num_envs=5).config
        terms = {**config.rewards.terms, "nearest": RewardTerm(1.0, nearest)}
        env = OmniEnv(replace(config, rewards=replace(config.rewards, terms=terms)))
        env.step(torch.zeros(5, 12))
        assert len(env.sensing.lidar.env_slices) == 1 and env.rewards.weighted["nearest"].min() > 0


class Nearest(FrameConsumer):
    """A consumer of one's own: the least range of each cloud, and how many frames there have been."""

    outputs = ("true_ranges",)
    saved = ("least", "frames")

    def attach(self, sensing):
        super().attach(sensing)
        self.least, self.frames = torch.zeros(sensing.num_envs), 0

    def take(self, envs, frame):
        self.least[envs] = frame.true_ranges.amin(1)

    def finish(self):
        self.frames += 1

    def reset(self, env_ids):
        self.least[env_ids] = 0.0


@pytest.mark.parametrize("cloud_mb", [0.01, 1000.0])
def test_a_consumer_of_ones_own_stands_beside_the_others(make_env, cloud_mb):
    """Alone it has the LiDAR built, and rays compute what it reads; it is reset and saved with the rest."""
    task = make_env("obstacles=static", blind=True, num_envs=5).config
    sensor = make_env("obstacles=static", "perception=none", num_envs=5).config.lidar
    sensor = replace(sensor, consumers={"near": Nearest}, cloud_mb=cloud_mb)
    env, resumed = (OmniEnv(replace(task, lidar=sensor)) for _ in range(2))
    near = env.state.consumer("near")
    assert env.sensing.lidar.outputs == {"true_ranges"} and env.sensing.sliced == (cloud_mb < 1)
    for action in random_actions(env, 6, scale=0.3):
        env.step(action)
    assert near.frames == env.sensing.tick == 2 and (near.least > 0.1).all()
    if not env.sensing.sliced:
        assert torch.equal(near.least, env.sensing.frame.true_ranges.amin(1))
    resumed.load_state_dict(env.state_dict())
    for each in (env, resumed):
        each.reset(torch.tensor([2]))
        each.step(torch.zeros(5, 12))
        assert each.state.consumer("near").least.gt(0).tolist() == [True, True, False, True, True]
    assert torch.equal(near.least, resumed.state.consumer("near").least)
    with pytest.raises(ValueError, match="reads far of LiDAR frames; give lidar.consumers.far"):
        env.state.consumer("far")
