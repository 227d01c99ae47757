"""The storage keeps each LiDAR frame once and gives back every window and step exactly."""

import pytest
import torch
from toy_env import HISTORY, PERIOD, ToyEnv, rollout

from omniperception.learning import PerceptiveStorage
from omniperception.learning.storage import max_windows


def storage_for(env, num_steps, steps_per_frame=PERIOD):
    given = {"frames": env.has_frames, "steps_per_frame": steps_per_frame}
    return PerceptiveStorage(env.num_envs, num_steps, env.get_observations(), ["command"], 2, **given)


@pytest.mark.parametrize(("num_envs", "num_batches"), [(1, 1), (5, 2), (7, 3), (6, 6)])
def test_every_step_finds_its_own_window(num_envs, num_batches):
    """Over several rollouts, in which the phase of the tick drifts and environments reset at any time."""
    torch.manual_seed(0)
    env = ToyEnv(num_envs, episode=11)
    num_steps = 8
    storage = storage_for(env, num_steps)
    phases, emptied = set(), 0
    for _ in range(6):
        phases.add(env.step_count % PERIOD)
        seen = rollout(env, storage, num_steps)
        visited = []
        for batch in storage.mini_batch_generator(num_batches, 1):
            obs = batch.observations
            assert obs.batch_size[0] == len(batch.actions)
            num_in_batch = obs.batch_size[0] // num_steps
            for row in range(obs.batch_size[0]):
                step = row // num_in_batch
                assert batch.values[row] == step
                [env_id] = [e for e in range(num_envs) if torch.equal(storage.actions[step, e], batch.actions[row])]
                visited.append((step, env_id))
                truth = seen[step][env_id]
                assert torch.equal(obs["command"][row], truth["command"])
                count = int(truth["frame_count"])
                assert obs.step_count[row] == count
                emptied += count == 0
                e, w = divmod(int(obs.step_window[row]), obs.window_count.shape[1])
                assert torch.equal(obs.frames[e, w + HISTORY - count : w + HISTORY], truth["frames"][HISTORY - count :])
                assert count in (0, int(obs.window_count[e, w]))
        assert sorted(visited) == [(s, e) for s in range(num_steps) for e in range(num_envs)]
        storage.clear()
    assert len(phases) == PERIOD and emptied > 0


def test_mini_batches_are_spread_and_change_every_epoch():
    env = ToyEnv(7)
    storage = storage_for(env, 4)
    rollout(env, storage, 4)
    batches = [b.observations.batch_size[0] // 4 for b in storage.mini_batch_generator(3, 2)]
    assert batches == [3, 2, 2, 3, 2, 2]


def test_without_frames_the_mini_batches_are_shuffled_steps():
    env = ToyEnv(6, frames=False)
    storage = storage_for(env, 8)
    rollout(env, storage, 8)
    batches = list(storage.mini_batch_generator(4, 1))
    assert [len(b.actions) for b in batches] == [12] * 4
    assert len(batches[0].values.unique()) > 4  # steps are mixed
    assert not hasattr(storage, "frames")


def test_more_frames_than_there_is_room_for_are_reported():
    env = ToyEnv(2, period=2)
    with pytest.raises(ValueError, match="set it to the environment's value"):
        rollout(env, storage_for(env, 8, steps_per_frame=5), 8)


@pytest.mark.parametrize(("steps", "period", "expected"), [(24, 5, 6), (1, 5, 1), (5, 5, 2), (6, 5, 2), (7, 1, 7)])
def test_most_windows_by_enumeration(steps, period, expected):
    ticks = [{(offset + s) // period for s in range(steps)} for offset in range(period)]
    assert max(map(len, ticks)) == max_windows(steps, period) == expected


def test_bytes_are_a_tenth_of_storing_windows():
    env = ToyEnv(8)
    obs = env.get_observations()
    obs["frames"] = torch.zeros(8, 10, 48, 3)
    storage = PerceptiveStorage(8, 24, obs, ["command"], 2, frames=True, steps_per_frame=5)
    buffers = [v for v in vars(storage).values() if isinstance(v, torch.Tensor)] + list(storage.observations.values())
    clouds = sum(b.untyped_storage().nbytes() for b in buffers if b.shape[-2:] == (48, 3))
    assert clouds == 8 * 15 * 48 * 3 * 4 <= 8 * 24 * 10 * 48 * 3 * 4 / 10
