"""What networks are fitted to: the same ways for each, truth that is the robots' own, a score that knows both ends."""

from types import SimpleNamespace

import pytest
import torch

from benchmarks.fitted_networks import TASK, Arguments, Reader, fit, record, scores
from omniperception import build, config
from omniperception.avoidance.velocity import AvoidanceConfig, avoidance_velocity

FEW = ("num_envs=6", "lidar.num_rays=200", "terrain=flat", "seed=3")


def task(network):
    return build.assemble(config.compose([*TASK, f"perception={network}", *FEW]))


@pytest.fixture(scope="module")
def recording():
    return record(task("fps_mlp_small"), config.find_run("pretrained/gait"), 25)


def test_every_network_is_shown_the_same_ways(recording):
    other = record(task("pd_risknet_small"), config.find_run("pretrained/gait"), 25)
    assert torch.equal(recording.given, other.given) and not torch.equal(recording.frames, other.frames)
    for name, target in recording.targets.items():
        torch.testing.assert_close(target, other.targets[name], atol=1e-6, rtol=0)


def test_truth_of_a_frame(recording):
    """Where nothing is near, no V_avoid asks for anything but the command; the paper's points away from what is."""
    targets = recording.targets
    assert {name: value.shape[-1] for name, value in targets.items()} == {
        "nearness": 36,
        "velocity": 72,
        "V_avoid, paper": 2,
        "V_avoid, 2 m": 2,
        "V_avoid, velocity risk": 2,
    }
    free = targets["nearness"].amax(-1) == 0
    near = targets["nearness"].amax(-1) > 0.8
    assert free.any() and near.any()
    assert targets["V_avoid, paper"][free].abs().max() == 0 < targets["V_avoid, paper"][near].abs().max()
    distance = torch.full((1, 36), 6.0)
    distance[0, 18] = 0.5  # the sector just left of ahead
    away = avoidance_velocity(distance, AvoidanceConfig(num_sectors=36, threshold=1.0, alpha=2.0))
    assert away[0, 0] < -0.36 < -0.03 > away[0, 1]


class Knowing(torch.nn.Module):
    """Says a share of the truth, which it is shown as frames."""

    def __init__(self, recording, share):
        super().__init__()
        self.network, self.share = SimpleNamespace(history=1), share
        self.sizes = {name: target.shape[-1] for name, target in recording.targets.items()}

    def forward(self, frames, count, given):
        truth = frames[:, 0, :, 0].split(tuple(self.sizes.values()), -1)
        return {name: self.share * value for name, value in zip(self.sizes, truth, strict=True)}


def test_score_is_one_for_the_truth_and_less_for_half_of_it(recording):
    told = torch.cat(tuple(recording.targets.values()), -1)[..., None].repeat(1, 1, 1, 3)
    shown = type(recording)(told, recording.count, recording.given, recording.targets)
    everyone = torch.arange(len(told))
    assert scores(Knowing(shown, 1.0), shown, everyone) == dict.fromkeys(recording.targets, 1.0)
    half = scores(Knowing(shown, 0.5), shown, everyone)
    assert all(0.6 < value < 1.0 for value in half.values())  # 0.75 and more, as the mean is not zero, less by weights


def test_fitting_brings_the_score_of_its_own_robots_up(recording):
    torch.manual_seed(0)
    everyone = torch.arange(len(recording.count))
    reader = Reader(task("fps_mlp_small").perception, recording, everyone)
    before = scores(reader, recording, everyone)
    fit(reader, recording, everyone, Arguments(steps=60, batch=32))
    after = scores(reader, recording, everyone)
    assert all(after[name] > before[name] + 0.2 for name in before), (before, after)
