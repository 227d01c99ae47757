"""A control step waits for a GPU only where environments are counted: those that end, and those with new commands."""

from dataclasses import replace

import pytest
import torch

from benchmarks.waits import find_waits
from omniperception import build, config
from omniperception.build import build_runner
from omniperception.env.env import OmniEnv

pytest.importorskip("mujoco_warp")

ON_WARP = ("sim=mujoco_warp", "sim.device=cpu", "num_envs=6", "lidar.num_rays=150", "seed=5")
COUNTED_IN = {
    "omniperception/env/env.py",
    "omniperception/env/mdp/commands.py",
    "omniperception/scene/obstacle_field.py",
}
TASKS = {
    "paper": ("experiment=paper",),
    "blind": ("experiment=walk",),
    "rough": ("experiment=avoid", "terrain=mixed", "lidar.motion_segments=1", "randomization=paper"),
    "crowd": ("experiment=avoid", "terrain=flat", "obstacles=crowd", "rewards.avoidance.risk.sideways=1.0"),
    "goal": ("experiment=avoid", "scenario=moving", "commands.radius=0.5"),
}


def built(task):
    overrides = [o for o in (*TASKS[task], *ON_WARP) if not (task == "blind" and o.startswith("lidar."))]
    env = OmniEnv(build.assemble(config.compose(overrides)).env)
    if env.obstacles is not None:
        env.obstacles.level = 1.0
    return env


def wear_out(env, step):
    """Ends an episode and a command, which last longer than a test."""
    env.episode_length_buf[step % env.num_envs] = env.max_episode_length - 1
    if env.command.goal_w is None:
        env.command.time_left[3] = 0.0


def scatter_obstacles(env):
    """Puts one obstacle of every environment far away, so that those that come at the robot start anew."""
    if env.obstacles is not None:
        env.obstacles.pos_w[1, :, :2] += 30.0


def rollout(env, num_steps):
    torch.manual_seed(1)
    seen = []
    for step in range(num_steps):
        wear_out(env, step)
        if step == num_steps // 2:
            scatter_obstacles(env)
        observations, rewards, dones, _ = env.step(0.5 * torch.randn(env.num_envs, env.num_actions))
        seen.append([*(observations[key].clone() for key in sorted(observations.keys())), rewards, dones])
    return seen


@pytest.mark.parametrize("task", TASKS)
def test_a_step_waits_where_environments_are_counted(task):
    env = built(task)
    steps = env.config.log_interval - 1  # metrics are read out at the end of an interval
    rollout(env, 3)
    with find_waits() as waits:
        seen = rollout(env, steps - 3)
    assert sum(int(dones.sum()) for *_, dones in seen) >= 5
    found = {place.partition(":")[0]: times for place, times in waits.places().items()}
    assert found.keys() <= COUNTED_IN and all(times <= steps - 3 for times in found.values()), found


@pytest.mark.parametrize("task", ["paper", "crowd"])
def test_a_step_of_training_waits_for_its_check_and_for_the_newest_tick(task, tmp_path):
    run = build.assemble(config.compose([*TASKS[task], *ON_WARP, "ppo.num_mini_batches=1"]))
    runner = build_runner(replace(run, env=replace(run.env, initial_obstacle_level=1.0, log_interval=10**9)), tmp_path)
    runner.alg.train_mode()
    runner.logger.open(0)
    obs, steps = runner.env.get_observations(), 12
    with torch.inference_mode():
        obs = runner.step(obs)
        with find_waits() as waits:
            for step in range(steps):
                wear_out(runner.env, step)
                obs = runner.step(obs)
    runner.logger.close()
    found = {place.partition(":")[0]: times for place, times in waits.places().items()}
    learning = {name: times for name, times in found.items() if name not in COUNTED_IN}
    assert learning == {"omniperception/learning/runner.py": steps, "omniperception/learning/models.py": steps}


def test_waiting_is_found():
    values = torch.arange(4.0)
    with find_waits() as waits:
        values[values > 1] = values[values > 1] * 2
        float(values.sum())
        values.tolist()
        torch.tensor([1.0])
        values.nonzero()
        values[values > 1] = 0.0
    assert sum(waits.values()) >= 6
