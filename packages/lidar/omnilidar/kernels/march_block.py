"""All rays of a block through a height field at once, for CPUs, where the steps of a single ray stall each other."""

from pathlib import Path

import warp as wp

from ..native import constant, function_body
from .heightfield import FieldPart

wp.set_module_options({"enable_backward": False})

HEADER = Path(__file__).with_name("march_block.h")
BLOCK = constant(HEADER, "block")
"""The most rays that are marched at once."""
NOT_MARCHED = wp.constant(constant(HEADER, "not_marched"))
"""The face of a ray that is left to ``intersect_heightfield``."""
REACHES = (2, 8, 32, 128)
"""Cells by which the windows of highest points reach beyond their block of 4 x 4 cells."""


@wp.func_native(function_body(HEADER))
def march_block(
    field: FieldPart,
    heights: wp.array(dtype=wp.float32),
    windows: wp.array(dtype=wp.vec4),
    reaches: wp.vec4,
    directions: wp.array(dtype=wp.vec3),
    start: int,
    cycle: int,
    steps: int,
    first: int,
    last: int,
    o: wp.vec3d,
    axes: wp.mat33,
    limit: float,
    refine: float,
    env: int,
    t_out: wp.array2d(dtype=wp.float32),
    face_out: wp.array2d(dtype=wp.int32),
    uncertain_out: wp.array2d(dtype=wp.bool),
):
    """Hits that ``intersect_heightfield`` finds for rays ``first`` to ``last`` of an environment, all from ``o``."""
    ...
