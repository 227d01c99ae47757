"""Counter-based random streams."""

import math

import pytest
import torch

from omniperception.common.random import EnvRandom, TrialRandom


def everyone(n):
    return torch.arange(n)


def test_draws_are_uniform():
    draws = EnvRandom(3, 500).uniform(everyone(500), (400,)).double().flatten()
    n = len(draws)
    assert draws.min() >= 0 and draws.max() < 1 and EnvRandom(1, 4).uniform(torch.tensor([0])).shape == (1,)
    assert draws.mean().item() == pytest.approx(0.5, abs=4 / math.sqrt(12 * n))
    assert draws.var().item() == pytest.approx(1 / 12, rel=0.01)
    counts = torch.histc(draws, 50, 0, 1)
    chi_squared = ((counts - n / 50) ** 2 / (n / 50)).sum().item()
    assert 20 < chi_squared < 90  # 49 degrees of freedom: 99.9 % lie in 24..85


def test_neighbours_are_uncorrelated_within_and_between_streams():
    draws = EnvRandom(0, 400).uniform(everyone(400), (400,)).double() - 0.5
    for a, b in (
        (draws[:, :-1], draws[:, 1:]),
        (draws[:-1], draws[1:]),
        (draws[:-1, 1:], draws[1:, :-1]),
        (draws, EnvRandom(1, 400).uniform(everyone(400), (400,)).double() - 0.5),
    ):
        assert abs((a * b).mean().item() * 12) < 4 / math.sqrt(a.numel())


def test_one_environments_draws_do_not_depend_on_anothers():
    alone, shared = EnvRandom(5, 3), EnvRandom(5, 3)
    expected = [alone.uniform(torch.tensor([2]), (4,)) for _ in range(3)]
    shared.uniform(torch.tensor([0]), (7,))
    got = [shared.uniform(torch.tensor([2]), (4,))]
    shared.uniform(torch.tensor([1, 0]), (2,))
    got.append(shared.uniform(torch.tensor([0, 2]), (4,))[1:])
    got.append(shared.uniform(torch.tensor([2, 1]), (4,))[:1])
    assert all(torch.equal(a, b) for a, b in zip(expected, got, strict=True))


def test_neither_the_number_of_environments_nor_that_of_calls_matters():
    whole = EnvRandom(5, 300).uniform(everyone(300), (6,))[:3]
    random = EnvRandom(5, 3)
    pieces = [random.uniform(everyone(3), (n,)) for n in (1, 2)]
    resumed = EnvRandom(5, 3)
    resumed.counter.copy_(random.counter)  # the counter is the whole state
    assert torch.equal(whole, torch.cat([*pieces, resumed.uniform(everyone(3), (3,))], 1))


def test_seeds_differ():
    first, other = (EnvRandom(seed, 50).uniform(everyone(50), (50,)) for seed in (1, 2))
    assert (first == other).float().mean() < 0.01
    assert len(torch.unique(first)) > 2490


def test_an_episode_draws_the_same_whatever_was_drawn_before():
    busy, idle = EnvRandom(1, 4), EnvRandom(1, 4)
    busy.uniform(torch.tensor([0, 2]), (17,))
    for random in (busy, idle):
        random.start_episode(everyone(4))
    first = idle.uniform(everyone(4), (5,))
    assert torch.equal(busy.uniform(everyone(4), (5,)), first)
    busy.uniform(torch.tensor([1]), (3,))
    for random in (busy, idle):
        random.start_episode(torch.tensor([1]))
    second = idle.uniform(everyone(4), (5,))
    assert torch.equal(busy.uniform(everyone(4), (5,)), second)
    assert not torch.equal(second[1], first[1])  # another episode, another scene


class TestBranches:
    def test_drawing_from_one_changes_no_other(self):
        busy, idle = EnvRandom(1, 4), EnvRandom(1, 4)
        branches = [(random.branch("a"), random.branch("b")) for random in (busy, idle)]
        for random, (a, b) in zip((busy, idle), branches, strict=True):
            for stream in (random, a, b):
                stream.start_episode(everyone(4))
        branches[0][0].uniform(everyone(4), (9,))
        assert torch.equal(busy.uniform(everyone(4), (5,)), idle.uniform(everyone(4), (5,)))
        first = branches[1][1].uniform(everyone(4), (500,))
        assert torch.equal(branches[0][1].uniform(everyone(4), (500,)), first)
        others = (
            EnvRandom(1, 4).uniform(everyone(4), (500,)),
            EnvRandom(1, 4).branch("a").uniform(everyone(4), (500,)),
        )
        assert all((first == other).float().mean() < 0.01 for other in others)

    def test_a_trial_draws_the_same_whoever_runs_it(self):
        """The third trial: begun by the third of five environments, or by the second of two after other trials."""
        many, few = TrialRandom(2, 5), TrialRandom(2, 2)
        expected, branch = many.branch("a"), few.branch("a")
        for random in (many, expected):
            random.start_episode(everyone(5))
        for env_ids in (everyone(2), torch.tensor([1])):
            for random in (few, branch):
                random.start_episode(env_ids)
            got = branch.uniform(torch.tensor([1]), (6,))
        assert torch.equal(expected.uniform(torch.tensor([2]), (6,)), got)

    def test_seeds_of_trials_are_refused(self):
        with pytest.raises(ValueError, match="seeds of a reset would be ignored in trials"):
            TrialRandom(2, 5).seed(everyone(5), everyone(5))
