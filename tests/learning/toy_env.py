"""A tiny deterministic environment with LiDAR frames, resets and time-outs, and configurations to train on it."""

import functools
import itertools

import numpy as np
import torch
from rsl_rl.env import VecEnv
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict

from omniperception.env.env import frame_number
from omniperception.learning.config import LearningConfig, PerceptionConfig, PPOConfig
from omniperception.perception import PdRiskNet, PdSampler

HISTORY, POINTS, PERIOD = 4, 3, 5
FIRST = itertools.count(0, 1 << 32)
STATE = ("step_count", "tick", "position", "episode_length_buf", "frames", "frame_count")


class ToyEnv(VecEnv):
    """A point on a line: the action moves it, the reward is minus the distance to the origin.

    Frames are derived from the position; one frame buffer is reused in place, so whoever keeps it without
    copying sees later frames.
    """

    def __init__(self, num_envs=6, frames=True, episode=17, period=PERIOD, seed=0, history=HISTORY):
        self.num_envs, self.num_actions, self.device, self.cfg = num_envs, 2, "cpu", {}
        self.max_episode_length = episode
        self.has_frames, self.period = frames, period
        self.rng = np.random.default_rng(seed)
        self.step_count = 0
        self.tick, self.first = 0, next(FIRST)
        self.position = torch.tensor(self.rng.normal(size=(num_envs, 2)), dtype=torch.float32)
        self.episode_length_buf = torch.arange(num_envs) * 3 % episode
        self.frames = torch.zeros(num_envs, history, POINTS, 3)
        self.frame_count = torch.zeros(num_envs, 1, dtype=torch.long)

    curriculum_levels = (1.0,)

    def terms_not_finite(self, name, env_id):
        return []

    def get_observations(self):
        groups = {
            "command": torch.cat([self.position, self.episode_length_buf.unsqueeze(1) / 10.0], -1),
            "avoidance_target": -0.3 * self.position,
            "height_target": (self.position[:, :1] * torch.linspace(0.1, 0.5, 5)).clamp(-1, 1),
        }
        if self.has_frames:
            groups["frames"] = self.frames
            groups["frame_count"] = self.frame_count.clone()
            groups["frame_tick"] = frame_number(self.first + self.tick, self.num_envs, torch.device("cpu"))
        return TensorDict(groups, batch_size=[self.num_envs])

    def step(self, actions):
        self.position = (self.position + 0.1 * actions.clamp(-1, 1)).clamp(-3, 3)
        self.step_count += 1
        self.episode_length_buf = self.episode_length_buf + 1
        if self.step_count % self.period == 0:
            self._new_frame()
        fell = self.position.norm(dim=-1) > 2.5
        time_outs = (self.episode_length_buf >= self.max_episode_length) & ~fell
        rewards = -self.position.norm(dim=-1)
        self._reset((fell | time_outs).nonzero().flatten())
        extras = {"time_outs": time_outs.float(), "log": {"Metrics/velocity_error": -rewards.mean()}}
        return self.get_observations(), rewards, (fell | time_outs).long(), extras

    def _new_frame(self):
        self.tick += 1
        self.frames[:, :-1] = self.frames[:, 1:].clone()
        noise = torch.randn(self.num_envs, POINTS, 1) * 0.01  # torch's global generator
        self.frames[:, -1] = torch.cat([self.position, torch.ones(self.num_envs, 1)], -1).unsqueeze(1) * 0.1 + noise
        self.frame_count = (self.frame_count + 1).clamp(max=self.frames.shape[1])

    def _reset(self, ids):
        self.position[ids] = torch.tensor(self.rng.normal(size=(len(ids), 2)), dtype=torch.float32)
        self.episode_length_buf[ids] = 0
        self.frame_count[ids] = 0
        self.frames = self.frames.index_fill(0, ids, 0.0)

    def state_dict(self):
        return {"rng": self.rng.bit_generator.state, "array": np.arange(3), **{n: getattr(self, n) for n in STATE}}

    def load_state_dict(self, state):
        assert torch.equal(state["array"], torch.arange(3))
        self.rng.bit_generator.state = state["rng"]
        for name in STATE:
            setattr(self, name, state[name])


def config(frames=True, supervised=False, **ppo):
    """What learns in a `ToyEnv`; keyword arguments replace settings of PPO."""
    defaults = {
        "max_iterations": 100,
        "max_minutes": None,
        "save_interval": 100,
        "keep_checkpoints": 10,
        "num_steps_per_env": 8,
        "num_learning_epochs": 2,
        "num_mini_batches": 2,
        "clip_param": 0.2,
        "gamma": 0.99,
        "lam": 0.95,
        "learning_rate": 1e-3,
        "schedule": "adaptive",
        "desired_kl": 0.01,
        "value_loss_coef": 1.0,
        "use_clipped_value_loss": True,
        "entropy_coef": 0.01,
        "max_grad_norm": 1.0,
        "hidden_dims": [16],
        "activation": "elu",
        "init_std": 0.5,
        "obs_normalization": True,
    }
    perception = PerceptionConfig(
        functools.partial(PdSampler, 2, 1, max_range=5.0, split_deg=10.0),
        functools.partial(PdRiskNet, proximal_dim=5, distal_dim=3),
        HISTORY,
        height_weight=1.0,
        sector_weight=0.0,
        supervised_epochs=2 if supervised else 0,
        learning_rate=1e-2,
    )
    groups = ("command",)
    return LearningConfig(PPOConfig(**defaults | ppo), perception if frames else None, groups, groups, PERIOD)


def collect(alg, env, steps):
    """Let an algorithm act for a rollout of so many steps."""
    obs = env.get_observations()
    with torch.inference_mode():
        for _ in range(steps):
            obs, rewards, dones, extras = env.step(alg.act(obs))
            alg.process_env_step(obs, rewards, dones, extras)
        alg.compute_returns(obs)


def steps_of(alg, group=0):
    """Learning rates of the optimiser's steps from now on, of one group of its parameters."""
    rates = []
    alg.optimizer.register_step_pre_hook(lambda optimizer, *_: rates.append(optimizer.param_groups[group]["lr"]))
    return rates


def rollout(env, storage, num_steps):
    """Fill the storage; returns copies of the observations of every step."""
    seen = []
    obs = env.get_observations()
    for step in range(num_steps):
        seen.append(obs.clone())
        if env.has_frames:
            storage.record_frames(obs, env.tick)
        transition = RolloutStorage.Transition()
        transition.observations = obs
        transition.actions = torch.randn(env.num_envs, 2)
        transition.values = torch.full((env.num_envs, 1), float(step))
        transition.actions_log_prob = torch.zeros(env.num_envs)
        transition.distribution_params = (torch.zeros(env.num_envs, 2), torch.ones(env.num_envs, 2))
        obs, transition.rewards, transition.dones, _ = env.step(transition.actions)
        storage.add_transition(transition)
    return seen
