"""Point-cloud sampling (FPS, averaging, sorting) and the networks that read sampled LiDAR histories.

The samplers need Warp and are loaded when one is first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING

from omniperception.perception.networks import DirectMlp, FpsGru, FpsMlp, PerceptionNetwork
from omniperception.perception.pd_risknet import CarriedPdRiskNet, PdRiskNet
from omniperception.perception.sampler import Attitude, Sampler
from omniperception.perception.velocity_risk import VelocityRisk

if TYPE_CHECKING:
    from omniperception.perception.sampling import FpsSampler, PdSampler, ProximitySampler, RawSampler

_LOADED_WHEN_USED = ("FpsSampler", "PdSampler", "ProximitySampler", "RawSampler")

__all__ = [
    "Attitude",
    "CarriedPdRiskNet",
    "DirectMlp",
    "FpsGru",
    "FpsMlp",
    "FpsSampler",
    "PdRiskNet",
    "PdSampler",
    "PerceptionNetwork",
    "ProximitySampler",
    "RawSampler",
    "Sampler",
    "VelocityRisk",
]


def __getattr__(name: str) -> object:
    if name in _LOADED_WHEN_USED:
        return getattr(import_module("omniperception.perception.sampling"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
