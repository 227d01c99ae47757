"""Lost and late LiDAR frames: how many, what the history then holds, and from where late ones are cast."""

import math

import pytest
import torch
from stepping import random_actions, still, tensors

from omnilidar import Lidar
from omniperception.common.random import EnvRandom
from omniperception.env.frame_delivery import FrameDelivery
from omniperception.learning.storage import PerceptiveStorage

TASK = (
    "experiment=avoid",
    "perception=proximity_gru",
    "terrain=flat",
    "obstacles=crowd",
    "obstacles.curriculum=null",
    "lidar.num_rays=200",
    "lidar.selection=every_kth",
    "lidar.period_s=0.04",
    "randomization=none",
)
LOST, LATE = "randomization.frames_lost=0.5", "randomization.frames_late_s=[0,0.1]"


def follow(env, fresh=None, late=None):
    """Has the frames of an environment come as in tables (ticks, num_envs) of bools and of control steps."""
    delivery, ticks = env.sensing._delivery, iter(range(1000))

    def draw():
        tick = next(ticks)
        delivery.fresh.copy_(torch.tensor(True if fresh is None else fresh[tick]))
        delivery.late_steps.copy_(torch.tensor(0 if late is None else late[tick]))

    delivery.draw = draw


class TestDraws:
    def test_a_share_is_lost_in_each_environment_on_its_own(self):
        delivery = FrameDelivery(0.05, None, 0.02, 500, EnvRandom(0, 500).branch("frames"))
        lost = []
        for _ in range(200):
            delivery.draw()
            lost.append(~delivery.fresh)
        lost = torch.stack(lost).double()
        n = lost.numel()
        assert lost.mean().item() == pytest.approx(0.05, abs=4 * math.sqrt(0.05 * 0.95 / n))
        for a, b in ((lost[1:], lost[:-1]), (lost[:, 1:], lost[:, :-1])):
            assert (a * b).mean().item() == pytest.approx(0.05**2, abs=4 * 0.05 / math.sqrt(n))
        assert (delivery.late_steps == 0).all()

    def test_lateness_is_uniform(self):
        """0 to 0.1 s in control steps of 20 ms: 1 to 4 steps a fifth each, 0 and 5 half of that."""
        delivery = FrameDelivery(None, (0.0, 0.1), 0.02, 5000, EnvRandom(1, 5000).branch("frames"))
        delivery.draw()
        shares = torch.bincount(delivery.late_steps, minlength=6) / 5000
        assert delivery.max_late_steps == 5 and delivery.fresh.all()
        assert shares.tolist() == pytest.approx([0.1, 0.2, 0.2, 0.2, 0.2, 0.1], abs=4 * math.sqrt(0.16 / 5000))

    @pytest.mark.parametrize("late_s", [0.03, 0.05, 0.07, 0.09, 0.11])
    def test_a_fixed_lateness_of_half_a_step_more_is_kept(self, late_s):
        delivery = FrameDelivery(None, (late_s, late_s), 0.02, 8, EnvRandom(1, 8).branch("frames"))
        delivery.draw()
        assert (delivery.late_steps == delivery.max_late_steps).all()
        assert abs(delivery.max_late_steps * 0.02 - late_s) < 0.0101


class TestLost:
    FRESH = (  # by tick, of three environments
        (True, True, False),
        (True, False, False),
        (True, False, True),
        (True, True, True),
        (True, False, False),
        (True, True, True),
    )

    @pytest.fixture(scope="class", name="pair")
    @classmethod
    def both(cls, make_env):
        """What two environments that do the same have seen by tick: all frames, and some."""
        whole, lossy = make_env(*TASK, num_envs=3), make_env(*TASK, LOST, num_envs=3)
        seen = ([], [])
        for env, notes in zip((whole, lossy), seen, strict=True):
            if env is lossy:
                follow(env, TestLost.FRESH)
            env._reset(torch.arange(3))
            for action in random_actions(whole, 2 * len(TestLost.FRESH), scale=0.5):
                observations = env.step(action)[0]
                if env.sensing.due(env.step_count):
                    notes.append({**tensors(observations), "unseen": env.sensing.consumers["Sightings"].unseen.clone()})
                    assert not env.done.any()
        return seen

    def test_the_last_frame_is_repeated_without_motion(self, pair):
        whole, lossy = pair
        for env in range(3):
            expected, count = torch.zeros_like(lossy[0]["frames"][env]), 0
            moved = torch.zeros(3)  # x, y and heading since the last frame that came, in the frame of then
            for tick, fresh in enumerate(self.FRESH):
                newest = whole[tick]["frames"][env, -1].clone()
                x, y, turn = newest[-1].tolist()
                cos, sin = math.cos(moved[2]), math.sin(moved[2])
                moved = moved + torch.tensor([cos * x - sin * y, sin * x + cos * y, turn])
                if fresh[env]:
                    newest[-1], moved = moved, torch.zeros(3)
                else:
                    newest = expected[-1].clone()
                    newest[-1] = 0.0
                count = min(count + 1, len(expected)) if count or fresh[env] else 0
                expected = torch.cat((expected[1:], newest[None]))
                got = lossy[tick]
                assert int(got["frame_count"][env]) == count, (tick, env)
                torch.testing.assert_close(got["frames"][env], expected, atol=1e-6, rtol=1e-5)

    def test_nothing_is_lost_where_all_come(self, pair):
        whole, lossy = pair
        for one, other in zip(whole, lossy, strict=True):
            assert torch.equal(one["frames"][0], other["frames"][0])

    def test_what_a_repeated_frame_shows_stays_seen(self, pair):
        """An obstacle counts as seen as many frames ago as its newest sighting stands back in the history."""
        whole, lossy = pair
        unseen = torch.full_like(lossy[0]["unseen"], 2**31)
        for tick, fresh in enumerate(self.FRESH):
            now = torch.tensor(fresh)[:, None]
            hit = torch.where(now, whole[tick]["unseen"] == 0, unseen == 0)
            unseen = torch.where(hit, 0, unseen + 1)
            assert torch.equal(lossy[tick]["unseen"], unseen), tick
        assert (unseen == 0).any() and (unseen > 0).any()

    def test_supervision_is_of_the_present(self, pair):
        """Where the base is now, not where the repeated frame was taken."""
        whole, lossy = pair
        for one, other in zip(whole, lossy, strict=True):
            assert torch.equal(one["height_target"], other["height_target"])


def test_training_keeps_each_frame_once_although_some_are_lost(make_env):
    """The windows of a rollout are those that the policy has seen, step by step."""
    env = make_env(*TASK, LOST, LATE, "terminations.episode_length_s=0.3", "perception.history=3", num_envs=6)
    groups = ["proprioception", "command"]
    storage = PerceptiveStorage(6, 30, env.get_observations(), groups, 12, frames=True, steps_per_frame=2)
    seen, lost = [], 0
    for step, action in enumerate(random_actions(env, 30, scale=0.3)):
        observations = env.get_observations()
        storage.record_frames(observations, observations["frame_tick"])
        storage.step = step + 1  # transitions beside the frames do not matter here
        seen.append((observations["frames"].clone(), observations["frame_count"].flatten().clone()))
        lost += int((~env.sensing.fresh).sum())
        env.step(action)
    rollout = storage.observations_of(torch.arange(6))
    assert lost > 50
    window = rollout.step_window.reshape(30, 6) - torch.arange(6) * rollout.window_count.shape[1]
    valid = 0
    for step, (frames, count) in enumerate(seen):
        assert torch.equal(rollout.step_count.reshape(30, 6)[step], count)
        for i in range(6):
            k = int(count[i])
            kept = rollout.frames[i, window[step, i] :][:3]
            assert torch.equal(kept[3 - k :], frames[i, 3 - k :])
            assert k in (0, int(rollout.window_count[i, window[step, i]]))
            valid += k
    assert valid > 100 and (rollout.step_count == 0).sum() > 10


class TestLate:
    def test_frames_are_cast_from_where_all_was(self, make_env):
        """A LiDAR of its own on the poses that this test has noted gives the same ranges."""
        task = ("obstacles=moving", "obstacles.curriculum=null", "perception=none", "lidar.period_s=0.04")
        env = make_env(*task, LATE, "randomization=none", num_envs=4)
        sensing = env.sensing
        lidar = Lidar(sensing.config, sensing.config.pattern(), sensing.scene, sensing.base, outputs=("true_ranges",))
        lidar.phase_rows.copy_(sensing.lidar.phase_rows)
        late = torch.tensor([[0, 1, 2, 5], [5, 0, 3, 1], [4, 4, 0, 2], [1, 5, 5, 0]])
        follow(env, late=late.tolist())
        env._reset(torch.arange(4))
        poses = [tuple(x.clone() for x in env.sim.body_poses(sensing._bodies))]
        differ = 0
        for step, action in enumerate(random_actions(env, 8, scale=0.5), 1):
            env.step(action)
            poses.append(tuple(x.clone() for x in env.sim.body_poses(sensing._bodies)))
            if step % 2:
                continue
            got = sensing.frame.true_ranges.clone()
            for out, past in ((sensing.scene.body_pos, 0), (sensing.scene.body_quat, 1)):
                when = [max(step - int(k), 0) for k in late[step // 2 - 1]]  # never before the episode
                out.copy_(torch.stack([poses[t][past][i] for i, t in enumerate(when)]))
            lidar.frame_count.copy_(sensing.lidar.frame_count - 1)
            expected = lidar.cast(step * env.control_dt).true_ranges
            assert torch.equal(got, expected), step
            present = [tuple(x.clone() for x in env.sim.body_poses(sensing._bodies))][0]
            sensing.scene.body_pos.copy_(present[0])
            sensing.scene.body_quat.copy_(present[1])
            lidar.frame_count.copy_(sensing.lidar.frame_count - 1)
            moved = (lidar.cast(step * env.control_dt).true_ranges != got).any(1)
            assert not moved[late[step // 2 - 1] == 0].any()
            differ += int(moved.sum())
        assert differ >= 10

    def test_no_frame_shows_the_last_episode(self, make_env):
        """An environment that is reset is seen from where it starts, however late the frame."""
        env = make_env("obstacles=none", "rewards=paper", "perception=none", LATE, num_envs=2)
        follow(env, late=[[5, 5]] * 9)
        env.step(still(env))
        env.sim.qpos[1, :2] = 30.0
        env.step(still(env))
        env._reset(torch.tensor([1]))
        start = env.sim.qpos[1, :3].float().clone()
        for _ in range(3):
            env.step(still(env))
        assert torch.equal(env.sensing.scene.body_pos[1, env.sensing.base], start)

    def test_motion_within_a_frame_is_refused(self, make_env):
        with pytest.raises(
            ValueError, match=r"lidar\.motion_segments=1 casts along the way .* use lidar\.motion_segments=0"
        ):
            make_env("obstacles=static", "lidar.motion_segments=1", LATE)


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("frames_lost=1.0", "frames_lost=1.0 must be a share"),
        ("frames_lost=-0.1", "frames_lost=-0.1 must be a share"),
        ("frames_late_s=[-0.1,0.1]", r"frames_late_s=\[-0.1, 0.1\] must be \[low, high\] with 0 <= low"),
    ],
)
def test_frames_that_cannot_be_are_refused(make_config, row, message):
    with pytest.raises(ValueError, match=message):
        make_config(f"randomization.{row}")
