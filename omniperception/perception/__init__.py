"""Point-cloud sampling (FPS, averaging, sorting) and the networks that read sampled LiDAR histories.

What needs Warp is loaded when it is first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING

from omniperception.perception.networks.base import DirectMlp, FpsGru, FpsMlp, PerceptionNetwork
from omniperception.perception.networks.pd_risknet import PdRiskNet
from omniperception.perception.samplers.base import Attitude, Sampler

if TYPE_CHECKING:
    from omniperception.perception.networks.motion_match import MotionMatch
    from omniperception.perception.networks.rings import RingPath
    from omniperception.perception.samplers.sampling import FpsSampler, PdSampler, ProximitySampler, RawSampler

_LOADED_WHEN_USED = {
    "networks.motion_match": ("MotionMatch",),
    "networks.rings": ("RingPath",),
    "samplers.sampling": ("FpsSampler", "PdSampler", "ProximitySampler", "RawSampler"),
}

__all__ = [
    "Attitude",
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
]


def __getattr__(name: str) -> object:
    for module, names in _LOADED_WHEN_USED.items():
        if name in names:
            return getattr(import_module(f"{__name__}.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
