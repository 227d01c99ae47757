"""The example with another library trains for a few steps."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


@pytest.fixture(scope="module")
def example():
    pytest.importorskip("gymnasium", reason="extra gym")
    pytest.importorskip("stable_baselines3", reason="pip install stable-baselines3")
    spec = importlib.util.spec_from_file_location("walk", EXAMPLES / "stable_baselines3_walk.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_stable_baselines3_learns(example):
    ppo = example.learn(3 * example.STEPS * 4, 4, "terrain=flat")
    assert ppo.num_timesteps == 3 * example.STEPS * 4 and ppo._n_updates > 0
    assert all(np.isfinite(value.detach().numpy()).all() for value in ppo.policy.parameters())


def test_episodes_end_as_the_library_expects(example):
    """Robots that are cut off after 0.1 s: five steps, and the last observation apart from the next episode's first."""
    import omniperception

    short = ("experiment=walk", "terminations.episode_length_s=0.1")
    robots = example.Robots(omniperception.make(*short, num_envs=3))
    robots.seed(5)
    first = robots.reset()
    idle = np.zeros((3, *robots.action_space.shape), np.float32)
    for step in range(1, 6):
        observations, rewards, dones, infos = robots.step(idle)
        assert rewards.shape == (3,) and dones.all() == (step == 5)
    assert all(info["TimeLimit.truncated"] for info in infos)
    last = np.array([info["terminal_observation"] for info in infos])
    assert last.shape == observations.shape and (last != observations).any(1).all()
    robots.seed(5)
    np.testing.assert_array_equal(robots.reset(), first)
