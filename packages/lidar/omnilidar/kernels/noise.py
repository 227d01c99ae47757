"""Noise of a LiDAR, compiled for the models that a sensor has.

The random numbers are a function of seed, stream, frame, ray and model: none depends on what else is configured.
"""

import math
from collections.abc import Sequence
from functools import cache

import warp as wp

from ..noise import (
    MAX_SIGMAS,
    TABLE_BINS,
    AngularJitter,
    DistanceNoise,
    Dropout,
    GaussianNoise,
    MixedPixels,
    Noise,
    TabulatedNoise,
)
from .geometry import INF, PI

wp.set_module_options({"enable_backward": False})

JITTER, GAUSSIAN, DISTANCE, DROPOUT, MASK, TABLE = (wp.constant(k) for k in range(6))
MODELS = frozenset(("jitter", "mixed", "gaussian", "distance", "dropout", "table", "mask"))
BINS = wp.constant(TABLE_BINS)
Bins = wp.types.vector(length=TABLE_BINS, dtype=wp.float32)
GOLDEN_ANGLE = wp.constant(wp.float32(2.399963229728653))


@wp.struct
class NoiseParameters:
    """The parameters of all models; those of models that a sensor does not have are not read."""

    seed: wp.array(dtype=wp.int32)  # (num_envs,)
    stream: wp.array(dtype=wp.int32)  # (num_envs,) of that seed's
    min_range: float
    max_range: float
    jitter_sigma: float  # tangent of the angle
    mixed_radius: float  # of the circle on which the second ray lies, tangent of the angle
    mixed_min_gap: float
    mixed_max_gap: float
    mixed_weight: float  # of the nearer surface
    gaussian_sigma: float
    gaussian_sigma_per_metre: float
    distance_ratio: float
    dropout_ratio: float
    dropout_ratio_per_metre: float
    table_start: float
    table_ends: Bins  # bins that are not used end where the last one does
    table_sigma: Bins
    table_dropout: Bins
    table_sigma_elsewhere: float
    mask_ratio: float
    mask_low: float
    mask_high: float


def noise_parameters(named: dict[str, Noise], min_range: float, max_range: float) -> NoiseParameters:
    """The models as the kernels read them, angles as their tangents."""
    parameters = NoiseParameters()
    parameters.min_range, parameters.max_range = min_range, max_range
    for model in named.values():
        if isinstance(model, AngularJitter):
            parameters.jitter_sigma = math.tan(math.radians(model.sigma_deg))
        elif isinstance(model, MixedPixels):
            parameters.mixed_radius = math.tan(math.radians(model.divergence_deg) / 2.0)
            parameters.mixed_min_gap, parameters.mixed_max_gap = model.min_gap, model.max_gap
            parameters.mixed_weight = model.foreground
        elif isinstance(model, GaussianNoise):
            parameters.gaussian_sigma, parameters.gaussian_sigma_per_metre = model.sigma, model.sigma_per_metre
        elif isinstance(model, DistanceNoise):
            parameters.distance_ratio = model.ratio
        elif isinstance(model, Dropout):
            parameters.dropout_ratio, parameters.dropout_ratio_per_metre = model.ratio, model.ratio_per_metre
        elif isinstance(model, TabulatedNoise):
            parameters.table_start, parameters.table_sigma_elsewhere = model.edges[0], model.sigma_elsewhere
            parameters.table_ends = _bins(model.edges[1:], model.edges[-1])
            parameters.table_sigma, parameters.table_dropout = _bins(model.sigma), _bins(model.dropout)
        else:
            parameters.mask_ratio, parameters.mask_low, parameters.mask_high = model.ratio, model.low, model.high
    return parameters


def _bins(values: Sequence[float], fill: float = 0.0) -> wp.types.vector:
    return Bins(*values, *[fill] * (TABLE_BINS - len(values)))


@wp.func
def child_key(key: wp.uint32, index: int):
    """Key of the ``index``-th of a key's independent streams."""
    return wp.rand_init(int(key), index)


@wp.func
def deflected(d: wp.vec3, sideways: wp.vec2):
    """Unit d moved by ``sideways`` across itself, in units of its length.

    The axes across d are those of Duff et al., Building an Orthonormal Basis, Revisited, JCGT 6(1), 2017.
    """
    sign = wp.where(d[2] < 0.0, -1.0, 1.0)
    a = -1.0 / (sign + d[2])
    b = d[0] * d[1] * a
    first = wp.vec3(1.0 + sign * d[0] * d[0] * a, sign * b, -sign * d[0])
    second = wp.vec3(b, sign + d[1] * d[1] * a, -d[1])
    return wp.normalize(d + sideways[0] * first + sideways[1] * second)


@wp.func
def jittered(d: wp.vec3, sigma: float, key: wp.uint32):
    """Unit d moved by a normal variable along each of two axes across it."""
    state = child_key(key, JITTER)
    radius = sigma * wp.min(wp.sqrt(-2.0 * wp.log(1.0 - wp.randf(state))), MAX_SIGMAS)  # by Box and Muller
    bearing = 2.0 * PI * wp.randf(state)
    return deflected(d, radius * wp.vec2(wp.cos(bearing), wp.sin(bearing)))


@wp.func
def beside(d: wp.vec3, radius: float, row: int):
    """A direction across d by ``radius``, on a side that changes evenly from row to row of the pattern."""
    bearing = GOLDEN_ANGLE * float(row % 4096)
    return deflected(d, radius * wp.vec2(wp.cos(bearing), wp.sin(bearing)))


@wp.func
def mixed(noise: NoiseParameters, first: float, second: float):
    """The distance measured by a beam that hits two surfaces."""
    gap = wp.abs(second - first)
    if gap <= noise.mixed_min_gap or gap > noise.mixed_max_gap:  # an infinite second distance, too
        return first
    near = wp.min(first, second)
    return near + (1.0 - noise.mixed_weight) * gap


@wp.func
def table_bin(noise: NoiseParameters, distance: float):
    """The range of the table in which a distance lies, -1 outside of all."""
    found = -1
    if distance >= noise.table_start:
        for k in range(BINS):
            if found < 0 and distance < noise.table_ends[k]:
                found = k
    return found


@cache
def disturb_function(models: frozenset[str]) -> wp.Function:
    """(noise, distance, true distance, key) -> what is measured of a hit; mixed pixels are in ``distance`` already."""
    has_gaussian, has_distance = "gaussian" in models, "distance" in models
    has_table = "table" in models
    has_dropout, has_mask = "dropout" in models, "mask" in models

    @wp.func
    def disturb(noise: NoiseParameters, distance: float, true_distance: float, key: wp.uint32):
        measured = distance
        if wp.static(has_gaussian):
            gaussian = child_key(key, GAUSSIAN)
            sigma = noise.gaussian_sigma + noise.gaussian_sigma_per_metre * true_distance
            measured += sigma * wp.sqrt(-2.0 * wp.log(1.0 - wp.randf(gaussian))) * wp.cos(2.0 * PI * wp.randf(gaussian))
        if wp.static(has_table):
            table = child_key(key, TABLE)
            at = table_bin(noise, true_distance)
            table_sigma = noise.table_sigma_elsewhere
            lost = 0.0
            if at >= 0:
                table_sigma = noise.table_sigma[at]
                lost = noise.table_dropout[at]
            measured += table_sigma * wp.sqrt(-2.0 * wp.log(1.0 - wp.randf(table))) * wp.cos(2.0 * PI * wp.randf(table))
            is_lost = wp.randf(table) < lost
        if wp.static(has_distance):
            uniform = child_key(key, DISTANCE)
            measured *= 1.0 + noise.distance_ratio * (2.0 * wp.randf(uniform) - 1.0)
        measured = wp.min(measured, noise.max_range)
        if measured < noise.min_range:
            measured = INF
        if wp.static(has_mask):
            mask = child_key(key, MASK)
            if wp.randf(mask) < noise.mask_ratio:
                measured = noise.mask_low + (noise.mask_high - noise.mask_low) * wp.randf(mask)
        if wp.static(has_table):
            measured = wp.where(is_lost, INF, measured)
        if wp.static(has_dropout):
            dropout = child_key(key, DROPOUT)
            if wp.randf(dropout) < noise.dropout_ratio + noise.dropout_ratio_per_metre * true_distance:
                measured = INF
        return measured

    return disturb
