"""Both formulations of an update are the same update."""

import torch

from benchmarks.update_benchmark import UpdateCase, build, differences, rollout_bytes

SMALL = UpdateCase(
    num_envs=4, num_steps=12, num_proximal=6, num_distal=4, history=3, hidden_dims=(8,), num_epochs=2,
    num_mini_batches=2, proprioception=5, proximal_dim=7, distal_dim=5,
)  # fmt: skip


def test_features_gradients_and_losses_agree():
    pair = build(SMALL)
    assert max(differences(pair)) < 1e-5
    assert rollout_bytes(pair.stepwise) == 4 * 12 * 3 * 10 * 12
    assert rollout_bytes(pair.shared) == 4 * (3 - 1 + 4) * 10 * 12
    losses = []
    for algorithm in (pair.shared, pair.stepwise):
        torch.manual_seed(3)  # the order of the environments
        losses.append(algorithm.update())
    assert losses[0].keys() == losses[1].keys()
    for name, value in losses[0].items():
        assert abs(value - losses[1][name]) < 1e-4 * max(1.0, abs(value)), name
    for a, b in zip(pair.shared.actor.parameters(), pair.stepwise.actor.parameters(), strict=True):
        assert torch.allclose(a, b, atol=1e-4)
