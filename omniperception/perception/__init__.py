"""Point-cloud sampling (FPS, averaging, sorting) and the networks that read sampled LiDAR histories."""

from omniperception.perception.networks import DirectMlp, FpsGru, FpsMlp, PerceptionNetwork
from omniperception.perception.pd_risknet import CarriedPdRiskNet, PdRiskNet
from omniperception.perception.rings import RingPath
from omniperception.perception.sampling import Attitude, FpsSampler, PdSampler, ProximitySampler, RawSampler, Sampler
from omniperception.perception.velocity_risk import VelocityRisk

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
    "RingPath",
    "Sampler",
    "VelocityRisk",
]
