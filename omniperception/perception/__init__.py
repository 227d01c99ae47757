"""Point-cloud samplers (FPS, averaging, proximities) and the networks that read histories of sampled points.

What needs Warp is loaded when it is first used: a blind run starts half a second sooner (of 3 s) without it.
"""

from importlib import import_module
from typing import TYPE_CHECKING

from omniperception.perception.networks.base import DirectMlp, FpsGru, FpsMlp, PerceptionNetwork
from omniperception.perception.networks.motion_match import MotionMatch
from omniperception.perception.networks.pd_risknet import PdRiskNet, ProximityGru
from omniperception.perception.networks.polar_rings import PolarRings
from omniperception.perception.samplers.base import Attitude, Sampler

if TYPE_CHECKING:
    from omniperception.perception.networks.rings import RingPath
    from omniperception.perception.samplers.sampling import FpsSampler, PdSampler, ProximitySampler, RawSampler
    from omniperception.perception.samplers.standing import StandingSampler

_SAMPLERS = "samplers.sampling"
_NEEDS_WARP = {
    "FpsSampler": _SAMPLERS,
    "PdSampler": _SAMPLERS,
    "ProximitySampler": _SAMPLERS,
    "RawSampler": _SAMPLERS,
    "RingPath": "networks.rings",
    "StandingSampler": "samplers.standing",
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
    "PolarRings",
    "ProximityGru",
    "ProximitySampler",
    "RawSampler",
    "RingPath",
    "Sampler",
    "StandingSampler",
]


def __getattr__(name: str) -> object:
    if name in _NEEDS_WARP:
        return getattr(import_module(f"{__name__}.{_NEEDS_WARP[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
