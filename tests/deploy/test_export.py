"""What an export compares before it may be used."""

import math
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from omniperception.deploy.export import check
from omnirobot.common.errors import ConfigError


class Network:
    """Two outputs, of which the first is `size` at most."""

    actor = SimpleNamespace()

    def __init__(self, size=1.0):
        self.size = size

    def examples(self, batch):
        return (torch.linspace(-1.0, 1.0, 3 * batch).reshape(batch, 3),)

    def __call__(self, x):
        return self.size * x, 0.1 * x


@pytest.mark.parametrize("size, off, passes", [(1, 5e-6, True), (1, 2e-5, False), (20, 1e-4, True), (20, 4e-4, False)])
def test_a_difference_counts_by_the_size_of_the_output(size, off, passes):
    network = Network(size)

    def written(x):
        actions, estimate = network(x)
        return actions + off, estimate

    if passes:
        check(network, Path("policy.onnx"), written)
    else:
        with pytest.raises(ConfigError, match=f"policy.onnx differs from the policy by {off / size:.1e} of an output"):
            check(network, Path("policy.onnx"), written)


@pytest.mark.parametrize("which", [0, 1])
def test_an_output_that_is_no_number_is_refused(which):
    network = Network()

    def written(x):
        return tuple(out * math.nan if k == which else out for k, out in enumerate(network(x)))

    with pytest.raises(ConfigError, match="differs from the policy by nan"):
        check(network, Path("policy.onnx"), written)
