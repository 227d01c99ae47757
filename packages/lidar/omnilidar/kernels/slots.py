"""The shapes around a viewer as its rays look for them: slots, nearest first, and words of 32 of them."""

from pathlib import Path

import warp as wp

from ..native import constant

wp.set_module_options({"enable_backward": False})

SLOTS_AHEAD = Path(__file__).with_name("slots_ahead.h")
WORD = wp.constant(constant(SLOTS_AHEAD, "word_size"))
"""Slots that are compared with a ray at once."""


@wp.struct
class Viewpoint:
    """Pose of the viewer and its body; -1: in the environment."""

    body: int
    pose: wp.transformd


@wp.struct
class Slots:
    """Shapes in the viewer's frame, nearest first; S slots, W words of WORD slots."""

    bound: wp.array2d(dtype=wp.vec4)  # (num_envs, S) centre and rejection threshold
    near: wp.array2d(dtype=wp.float32)  # (num_envs, S) lower bound of the distance
    shape: wp.array2d(dtype=wp.int32)  # (num_envs, S)
    axes: wp.array2d(dtype=wp.mat33)  # (num_envs, S) the shape's axes in rows; none with motion
    pose: wp.array2d(dtype=wp.transformd)  # (num_envs, S) its pose in float64; none with motion
    count: wp.array(dtype=wp.int32)  # (num_envs,) slots in use
    words: wp.array3d(dtype=wp.float32)  # (num_envs, W, 4 * WORD) x, y, z and threshold of a word's slots; no reach
    view: wp.array(dtype=wp.transformd)  # (num_envs,) the viewer's pose; none with motion
    reach: float  # how far from the viewer's origin rays start, metres
    marched_t: wp.array2d(dtype=wp.float32)  # (num_envs, N) what each ray hits of the height field, by march_block
    marched_face: wp.array2d(dtype=wp.int32)
    marched_uncertain: wp.array2d(dtype=wp.bool)


@wp.func
def pack_words(slots: Slots, env: int, count: int):
    """Copies one environment's bounds into words; slots that are not in use are never ahead."""
    for slot in range((count + WORD - 1) // WORD * WORD):
        word = slot // WORD
        k = slot - word * WORD
        if slot < count:
            bound = slots.bound[env, slot]
            slots.words[env, word, k] = bound[0]
            slots.words[env, word, WORD + k] = bound[1]
            slots.words[env, word, 2 * WORD + k] = bound[2]
            slots.words[env, word, 3 * WORD + k] = bound[3]
        else:
            slots.words[env, word, 3 * WORD + k] = wp.INF
    return 0
