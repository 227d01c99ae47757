"""Pushes: when they come, how hard and whither, in both simulators."""

import math
from types import SimpleNamespace

import pytest
import torch
from stepping import SIMS

from omniperception.common.random import EnvRandom
from omniperception.env.mdp.pushes import Pushes
from omniperception.env.mdp.randomization import PushesConfig

N, DT = 400, 0.02


@pytest.fixture(scope="module")
def history():
    """(steps, N, 2) m/s by which each robot was pushed before each of 1500 control steps."""
    sim = SimpleNamespace(num_envs=N, device=torch.device("cpu"), qvel=torch.zeros(N, 18, dtype=torch.float64))
    pushes = Pushes(PushesConfig([5.0, 10.0], 0.5), sim, DT, EnvRandom(7, N).branch("pushes"))
    pushes.reset(torch.arange(N))
    kicks = []
    for _ in range(1500):
        before = sim.qvel.clone()
        pushes.advance()
        assert torch.equal(sim.qvel[:, 2:], before[:, 2:])
        kicks.append((sim.qvel - before)[:, :2])
    return torch.stack(kicks)


def test_they_come_every_five_to_ten_seconds(history):
    pushed = history.abs().sum(2) > 0
    gaps = torch.cat([pushed[:, i].nonzero().flatten().diff() * DT for i in range(N)])
    assert len(gaps) > 2 * N and 5.0 <= gaps.min() < 5.1 and 9.9 < gaps.max() <= 10.0
    assert gaps.mean().item() == pytest.approx(7.4, abs=0.15)  # 7.5, but for long ones that the 30 s cut off


def test_the_first_comes_at_a_random_moment(history):
    first = (history.abs().sum(2) > 0).int().argmax(0) * DT
    assert first.min() < 0.2 and 9.0 < first.max() < 10.0
    assert (first < 5.0).float().mean().item() == pytest.approx(math.log(2), abs=0.08)  # mean of 5 s / T


def test_their_sizes_and_directions_are_even(history):
    kicks = history[history.abs().sum(2) > 0]
    speed, direction = kicks.norm(dim=1), kicks / kicks.norm(dim=1, keepdim=True)
    n = len(kicks)
    assert speed.max() <= 0.5 and speed.max() > 0.49 and speed.min() < 0.01
    assert speed.mean().item() == pytest.approx(0.25, abs=4 * 0.5 / math.sqrt(12 * n))
    assert direction.mean(0).abs().max() < 4 / math.sqrt(2 * n)
    quadrants = torch.bincount((2 * (kicks[:, 0] > 0) + (kicks[:, 1] > 0)).long(), minlength=4) / n
    assert (quadrants - 0.25).abs().max() < 0.05


@pytest.mark.parametrize("sim", SIMS)
def test_a_push_moves_the_robot(make_env, sim):
    task = ("experiment=walk", "randomization=none", *SIMS[sim])
    still, pushed = make_env(*task), make_env(*task, "randomization.pushes={every_s: [0.02, 0.02], speed: 0.5}")
    kick = []
    step = pushed.sim.step

    def spied(*args):
        kick.append(pushed.sim.qvel[:, :2].clone())
        step(*args)

    pushed.sim.step = spied
    pushed.pushes.countdown[:] = torch.tensor([0, 3, 0, 3])
    for env in (still, pushed):
        env.step(torch.zeros(4, 12))
    moved = (pushed.sim.qvel - still.sim.qvel)[:, :2]
    assert (kick[0][[0, 2]].norm(dim=1) > 0.01).all() and (kick[0][[1, 3]] == 0).all()
    assert torch.equal(pushed.sim.qpos[[1, 3]], still.sim.qpos[[1, 3]])
    assert ((moved * kick[0]).sum(1)[[0, 2]] > 0.3 * kick[0].norm(dim=1)[[0, 2]] ** 2).all()


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("{every_s: [0, 1], speed: 1}", r"pushes.every_s=\[0, 1\] must be"),
        ("{every_s: [2, 1], speed: 1}", r"pushes.every_s=\[2, 1\] must be"),
        ("{every_s: [1, 2], speed: -1}", r"pushes.speed=-1"),
        ("{speed: 1}", "randomization.pushes lacks every_s"),
    ],
)
def test_pushes_that_cannot_be_are_refused(make_config, row, message):
    with pytest.raises(ValueError, match=message):
        make_config(f"randomization.pushes={row}")
