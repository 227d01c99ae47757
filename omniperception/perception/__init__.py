"""Point-cloud sampling (FPS, averaging, sorting) and the networks that read sampled LiDAR histories.

What needs Warp is loaded when it is first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING

from omniperception.perception.networks import DirectMlp, FpsGru, FpsMlp, PerceptionNetwork
from omniperception.perception.pd_risknet import CarriedPdRiskNet, PdRiskNet
from omniperception.perception.sampler import Attitude, Sampler

if TYPE_CHECKING:
    from omniperception.perception.motion_match import MotionMatch
    from omniperception.perception.rings import RingPath
    from omniperception.perception.sampling import FpsSampler, PdSampler, ProximitySampler, RawSampler
    from omniperception.perception.velocity_risk import VelocityRisk

_LOADED_WHEN_USED = {
    "motion_match": ("MotionMatch",),
    "rings": ("RingPath",),
    "sampling": ("FpsSampler", "PdSampler", "ProximitySampler", "RawSampler"),
    "velocity_risk": ("VelocityRisk",),
}

__all__ = [
    "Attitude",
    "CarriedPdRiskNet",
    "DirectMlp",
    "FpsGru",
    "FpsMlp",
    "FpsSampler",
    "MotionMatch",
    "PdRiskNet",
    "PdSampler",
    "PerceptionNetwork",
    "ProximitySampler",
    "RawSampler",
    "RingPath",
    "Sampler",
    "VelocityRisk",
]


def __getattr__(name: str) -> object:
    for module, names in _LOADED_WHEN_USED.items():
        if name in names:
            return getattr(import_module(f"{__name__}.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
