"""Episodes begin again before a touch: where and when, whose, in which sizes; and nobody else's do."""

import pytest
import torch
from stepping import random_actions, still

from omniperception.common.errors import ConfigError
from omniperception.env.env import OmniEnv

EVERY = 5
"""Control steps in `before_s` below."""
REPLAY = ("collision_replay={share: 1.0, before_s: 0.1}", "obstacles=all", "terminations.episode_length_s=30")


def scene(env):
    """What an observer sees of each environment, read from the simulator and not by the replay's own means."""
    seen = {"qpos": env.sim.qpos, "qvel": env.sim.qvel, "bodies": env.sim.mocap_pos, "turned": env.sim.mocap_quat}
    seen |= {"sizes": env.sim.model_field("geom_size"), "command": env.command.value, "steps": env.episode_length_buf}
    seen |= {"moving": env.obstacles.velocity_w, "there": env.obstacles.active, "outline": env.obstacles.outline}
    seen |= {"action": env.state.actions[0], "target": env.state.targets[0], "reference": env.state.reference}
    return {name: value.clone() for name, value in seen.items()}


def touch(env, which):
    env.contacts = torch.zeros(env.num_envs, dtype=torch.bool)
    env.contacts[which] = True
    env.collision_replay.follow(env.step_count, env.contacts)


def end(env, which):
    """Ends the episodes of some environments by a fall."""
    env.sim.qpos[which, 2] = -0.5
    return env.step(still(env))


@pytest.fixture(params=["all", "crowd"])
def env(make_env, request):
    return make_env(*REPLAY, f"obstacles={request.param}", blind=True)


def close(a, b, row):
    for name in a:
        assert torch.allclose(a[name][row].float(), b[name][row].float(), atol=1e-5), name


def test_an_episode_begins_again_before_its_touch_and_others_anew(env):
    past = {}
    for action in random_actions(env, 2 * EVERY + 3, scale=0.1):
        env.step(action)
        past[env.step_count] = scene(env)
    assert not env.done.any()
    env.collision_replay.kept[:] = False  # whoever touched something by chance
    touch(env, [2])
    _, _, done, _ = end(env, [1, 2])
    assert done.tolist() == [0, 1, 1, 0]
    now = scene(env)
    close(now, past[EVERY], 2)  # written down at 5 and 10: the older of them is 8 steps before the touch at 13
    assert now["steps"].tolist() == [14, 0, EVERY, 14]
    assert (now["action"][1] == 0).all()
    assert not torch.equal(now["bodies"][1], past[EVERY]["bodies"][1])
    assert not env.collision_replay.kept.any()


def test_a_touch_right_after_the_beginning_begins_again_there(env):
    first = scene(env)
    env.step(still(env))
    env.collision_replay.kept[:] = False
    touch(env, [0])
    end(env, [0])
    close(scene(env), first, 0)
    assert env.episode_length_buf[0] == 0


def test_only_the_first_touch_of_an_episode_counts(env):
    for k in range(4 * EVERY):
        env.step(still(env))
        env.collision_replay.kept[1:] = False
        if k == 2 * EVERY:
            env.collision_replay.kept[0] = False
        if k in (2 * EVERY, 3 * EVERY + 2):
            touch(env, [0])
    end(env, [0])
    assert env.episode_length_buf[0] == EVERY  # 5 before the step 11 of the first one; for the second it would be 10


def test_it_begins_again_once_per_touch_and_not_after_a_reset_from_outside(env):
    for _ in range(2 * EVERY + 1):
        env.step(still(env))
    env.collision_replay.kept[:] = False
    touch(env, [1, 3])
    env.reset(torch.tensor([3]))
    end(env, [1, 3])
    assert env.episode_length_buf[[1, 3]].tolist() == [EVERY, 0]
    env.collision_replay.kept[:] = False
    end(env, [1])
    assert env.episode_length_buf[1] == 0


def test_share(make_env):
    env = make_env(REPLAY[0].replace("1.0", "0.3"), *REPLAY[1:], num_envs=400, blind=True)
    for _ in range(2 * EVERY + 1):
        env.step(still(env))
    everybody = list(range(400))
    env.collision_replay.kept[:] = False
    touch(env, everybody)
    end(env, everybody)
    again = int((env.episode_length_buf == EVERY).sum())
    assert 85 <= again <= 155  # 120 expected, four standard deviations of 9.2
    assert again + int((env.episode_length_buf == 0).sum()) == 400


def test_sizes_of_geoms_and_rays_go_back(make_env):
    """What the engine and the LiDAR collide with is as large as it was, beside an equal scene that never ended."""
    ends, goes_on = (make_env("perception=pd_risknet", *REPLAY, "lidar.num_rays=2000") for _ in range(2))
    past = []
    for _ in range(2 * EVERY + 1):
        ends.step(still(ends))
        past.append(ends.obstacles.size.clone())
    ends.collision_replay.kept[:] = False
    touch(ends, [1])
    end(ends, [1])
    assert torch.equal(ends.obstacles.size[1], past[EVERY - 1][1])
    for _ in range(EVERY):
        goes_on.step(still(goes_on))
    for env in (ends, goes_on):
        env.step_count = 0  # which the scan's phase follows
        env.sensing.lidar.reset()
        env._sense()
    seen, expected = (env.sensing.frame.ranges[1] for env in (ends, goes_on))
    assert torch.allclose(seen, expected, atol=1e-3)


def test_on_uneven_ground_the_tile_comes_back(make_env):
    env = make_env(*REPLAY, "terrain=walk", "terrain.curriculum=null", num_envs=8, blind=True)
    for _ in range(2 * EVERY + 1):
        env.step(still(env))
    tiles, place = env.ground.level.clone(), env.sim.ground_pos.clone()
    env.collision_replay.kept[:] = False
    touch(env, [0, 1, 2, 3])
    end(env, list(range(8)))
    assert torch.equal(env.ground.level[:4], tiles[:4])
    assert torch.equal(env.sim.ground_pos[:4], place[:4])
    assert not torch.equal(env.ground.level[4:], tiles[4:])


def test_going_on_from_a_saved_state_is_exact(make_env):
    first, second = (make_env(*REPLAY, blind=True) for _ in range(2))
    actions = random_actions(first, 30, scale=0.1)
    for action in actions[: 2 * EVERY + 2]:
        first.step(action)
    touch(first, [1])
    second.sim.qpos.copy_(first.sim.qpos)
    second.load_state_dict(first.state_dict())
    assert torch.equal(first.collision_replay.kept, second.collision_replay.kept)
    for env in (first, second):
        end(env, [1, 2])
    assert first.episode_length_buf.tolist() == second.episode_length_buf.tolist()
    a, b = scene(first), scene(second)
    for row in (1, 2):
        close(a, b, row)


def test_evaluations_begin_every_episode_anew(make_config):
    from dataclasses import replace

    blind = ("perception=none", "lidar=none", "rewards=walk", "observations=walk")
    for overrides in (REPLAY, (REPLAY[0], "scenario=corridor"), (REPLAY[0], "scenario=static", "terrain=mixed")):
        run = make_config(*blind, *overrides, "num_envs=2")
        assert OmniEnv(replace(run.env, full_level=True, trials=True)).collision_replay is None


@pytest.mark.parametrize(
    ("replay", "other", "message"),
    [
        ("{share: 0, before_s: 2}", None, ".share=0 must lie in (0, 1]; collision_replay=null"),
        ("{share: 0.5, before_s: 0}", None, ".before_s=0 must be positive"),
        ("{share: 0.5}", None, "before_s"),
        ("{share: 0.5, before_s: 2}", "obstacles=none", "there is no obstacle; use collision_replay=null"),
        ("{share: 0.5, before_s: 2}", "commands=goal", "use commands=velocity or collision_replay=null"),
        ("{share: 0.5, before_s: 2}", "terrain=mixed", "use terrain.curriculum=null or collision_replay=null"),
    ],
)
def test_wrong_input(make_env, replay, other, message):
    overrides = (f"collision_replay={replay}", *(() if other is None else (other,)))
    with pytest.raises((ConfigError, ValueError), match="^[^\n]*$") as error:
        make_env(*overrides)
    assert message in str(error.value)
