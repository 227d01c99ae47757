"""Windowed layers against the plain network run on each window by itself."""

import functools

import pytest
import torch
from torch import nn

from omniperception.perception import (
    DirectMlp,
    FpsGru,
    FpsMlp,
    MotionMatch,
    PdRiskNet,
    PolarRings,
    ProximityGru,
    RingPath,
)
from omniperception.perception.networks.windows import WindowedGru, WindowedLinear

H, W, B = 5, 4, 3


def sequence(points=6):
    torch.manual_seed(0)
    return torch.randn(B, H - 1 + W, points, 3)


def counts():
    """Every count from 0 to H occurs."""
    return torch.tensor([[0, 1, 2, 3], [4, 5, 0, 1], [5, 5, 5, 5]])


def gru_by_window(gru, frames, count):
    """nn.GRU on the valid frames of each window, one at a time."""
    rows = []
    for b in range(B):
        for w in range(W):
            n = int(count[b, w])
            window = frames[b : b + 1, w + H - n : w + H].flatten(2)
            rows.append(gru(window)[1][0, 0] if n else frames.new_zeros(gru.hidden_size))
    return torch.stack(rows).view(B, W, -1)


def plain_gru(windowed):
    plain = nn.GRU(windowed.input_size, windowed.hidden_size, batch_first=True).to(windowed.weight_ih_l0.dtype)
    plain.load_state_dict(windowed.state_dict())
    return plain


def relative(a, b):
    return ((a - b).norm() / b.norm()).item()


@pytest.mark.parametrize("partial", [False, True])
def test_windowed_gru_equals_gru_on_each_window(partial):
    frames = sequence().requires_grad_()
    count = counts() if partial else torch.full((B, W), H)
    windowed = WindowedGru(18, 7, H)
    plain = plain_gru(windowed)
    got, expected = windowed(frames.flatten(2), count), gru_by_window(plain, frames, count)
    assert torch.allclose(got, expected, atol=1e-5)

    weights = torch.randn_like(expected)
    got_grads = torch.autograd.grad((got * weights).sum(), [frames, *windowed.parameters()])
    expected_grads = torch.autograd.grad((expected * weights).sum(), [frames, *plain.parameters()])
    for a, b in zip(got_grads, expected_grads, strict=True):
        assert relative(a, b) < 1e-5


def test_invalid_frames_have_no_influence():
    network = PdRiskNet(4, 2, history=H, proximal_dim=5, distal_dim=3)
    frames, count = sequence(), counts()
    poisoned = frames.clone()
    poisoned[0, :H] = 1e3  # window w of environment 0 has w valid frames, from frame H on
    a, b = network(frames, count), network(poisoned, count)
    assert torch.equal(a, b) and (a[0, 0] == 0).all() and (a[0, 1:] != 0).all()


@pytest.mark.parametrize("encoder", [0, 7])
def test_pd_risknet_splits_the_points(encoder):
    """Each half in a GRU of its own; the distal half may pass a layer before."""
    network = PdRiskNet(4, 2, history=H, proximal_dim=5, distal_dim=3)
    if encoder:
        network = ProximityGru(4, 2, history=H, proximal_dim=5, distal_dim=3, distal_encoder=encoder)
    frames, count = sequence(), counts()
    far = frames[:, :, 4:]
    if encoder:
        far = torch.nn.functional.elu(network.encoder[0](far.flatten(2))).unsqueeze(-1)
    halves = (network.proximal, frames[:, :, :4]), (network.distal, far)
    expected = torch.cat([gru_by_window(plain_gru(gru), points, count) for gru, points in halves], -1)
    assert torch.allclose(network(frames, count), expected, atol=1e-5)
    assert network.supervised["height_target"] == slice(0, 5)  # the proximal half


def test_paper_dimensions():
    network = PdRiskNet()
    assert (network.num_points, network.history, network.feature_dim) == (384, 10, 251)
    with torch.no_grad():
        features = network(torch.zeros(2, 10, 384, 3), torch.tensor([[0], [10]]))
    assert features.shape == (2, 1, 251)
    assert features[..., network.supervised["height_target"]].shape == (2, 1, 187)
    assert network.supervised["sector_target"] == slice(187, 223)  # within the distal half
    assert (features[0] == 0).all()


def test_the_last_row_of_rings_is_the_motion_of_the_base():
    match = MotionMatch(speeds=(1.0,), num_directions=4, width=0.4, period_s=0.1)
    rings = functools.partial(RingPath, num_sectors=9, channels=(8,), kernel_sizes=(3,), match=match)
    network = PolarRings(2 * 9 + 1, H, rings)
    nn.init.normal_(network.rings.layers[-1].weight)
    frames, count = sequence(19).sigmoid(), counts()
    got = network(frames, count)
    assert got.abs().max() > 0 and torch.equal(got, network.rings(frames[:, :, :-1], frames[:, :, -1], count))
    assert network.feature_dim == 3 * 9 and network.supervised == {"motion_target": slice(0, 27)}


def test_windowed_linear_equals_linear_on_each_window():
    frames, count = sequence(), counts()
    layer = WindowedLinear(18, 7, H)
    got = layer(frames.flatten(2), count)
    for b in range(B):
        for w in range(W):
            window = frames[b, w : w + H].flatten(1).clone()
            window[: H - int(count[b, w])] = 0.0
            assert torch.allclose(got[b, w], layer.linear(window.flatten()), atol=1e-5)


@pytest.mark.parametrize(
    "network",
    [FpsGru(6, H, 9), FpsMlp(6, H, (8, 7), 9), DirectMlp(6, H, (8,), 9), FpsMlp(6, H, (), 9)],
    ids=["FpsGru", "FpsMlp", "DirectMlp", "linear"],
)
def test_ablations_share_the_interface(network):
    frames = sequence()
    full = network(frames, counts())
    assert full.shape == (B, W, 9) and "height_target" not in network.supervised
    for w in range(W):  # a window by itself gives the same
        alone = network(frames[:, w : w + H], counts()[:, w : w + 1])
        assert torch.allclose(alone[:, 0], full[:, w], atol=1e-6)
    full.sum().backward()
    assert all(p.grad is not None and torch.isfinite(p.grad).all() for p in network.parameters())


def test_wrong_counts_are_refused():
    with pytest.raises(ValueError, match="count must have shape"):
        FpsGru(6, H, 9)(sequence(), torch.full((B, W + 1), H))
    with pytest.raises(ValueError, match="at least 1"):
        FpsGru(0, H)


def test_a_path_can_be_left_out():
    frames, count = sequence(), counts()
    near = PdRiskNet(6, 0, history=H, proximal_dim=5, distal_dim=0)
    assert torch.equal(near(frames, count), near.proximal(frames.flatten(2), count))
    assert near.supervised == {"height_target": slice(0, 5)} and near.feature_dim == 5
    far = PdRiskNet(0, 6, history=H, proximal_dim=0, distal_dim=40)
    assert torch.equal(far(frames, count), far.distal(frames.flatten(2), count))
    assert far.supervised == {"sector_target": slice(0, 36)}
    for wrong, named in (
        ({"num_distal": 0}, r"num_distal=0 must be at least 1 .*perception\.network\.distal_dim=0"),
        ({"distal_dim": 0}, "distal_dim=0 leaves the distal path out, but 128 points"),
    ):
        with pytest.raises(ValueError, match=named):
            PdRiskNet(**wrong)
