"""Networks are built for the points of their sampler; the ablation's variants."""

from functools import partial

import pytest

from omniperception.evaluation.ablation import VARIANTS
from omniperception.learning.config import PerceptionConfig
from omniperception.perception import FpsMlp, FpsSampler, PdRiskNet, PdSampler, ProximityGru, ProximitySampler

CELLS = {"band_edges": [-1.0, 0.0, 0.5, 2.0], "decay": 0.5, "blind": 0.3, "body": [0.5, 0.3], "split_deg": 20.0}


def perception(sampler, network, history=3):
    return PerceptionConfig(partial(sampler, max_range=5.0), network, history, height_weight=0.0, sector_weight=0.0)


@pytest.mark.parametrize("num_proximal", [0, 6])
def test_cells_of_the_distal_half_are_counted_for_the_network(num_proximal):
    network = partial(ProximityGru, proximal_dim=5 if num_proximal else 0, distal_dim=3, distal_encoder=4)
    sampler = partial(ProximitySampler, num_proximal, 7, **CELLS)
    built = perception(sampler, network).build_network()
    assert (built.num_points, built.history) == (num_proximal + 3 * 7, 3)
    assert built.encoder[0].in_features == 3 * 3 * 7


def test_a_network_that_does_not_fit_its_sampler_is_refused():
    with pytest.raises(ValueError, match=r"perception\.network does not fit the sampler, which gives .*num_points"):
        perception(partial(FpsSampler, 8), PdRiskNet).build_network()
    with pytest.raises(ValueError, match=r"does not fit the sampler, which gives .*num_proximal"):
        perception(partial(PdSampler, 8, 4, split_deg=20.0), FpsMlp).build_network()


def test_variants_differ_from_their_preset_in_one_thing(make_config):
    whole = make_config("perception=pd_risknet").perception
    network = whole.build_network()
    near = make_config(*VARIANTS["pd_risknet_no_distal"]).perception
    far = make_config(*VARIANTS["pd_risknet_no_proximal"]).perception
    halves = near.build_network(), far.build_network()
    assert [half.num_points for half in halves] == list(whole.sampler().sizes.values())
    assert [half.feature_dim for half in halves] == [187, 64]
    assert {t: w for t, w in whole.supervision.items() if t != "height_target"} == far.supervision
    assert (near.history, far.history) == (whole.history, whole.history)
    shapes = {name: p.shape for name, p in network.named_parameters()}
    for half in halves:
        assert all(shapes[name] == p.shape for name, p in half.named_parameters())
