"""Range noise."""

import warp as wp

from .geometry import INF


@wp.kernel(module="unique", enable_backward=False)
def add_noise(
    env_offset: int,
    seed: int,
    frame: wp.array(dtype=wp.int32),
    distance_ratio: float,
    mask_ratio: float,
    mask_low: float,
    mask_high: float,
    min_range: float,
    max_range: float,
    true_ranges: wp.array2d(dtype=wp.float32),
    # out
    ranges_out: wp.array2d(dtype=wp.float32),
):
    """Disturbs the hits of one ray; the random numbers are a function of seed, environment, frame and ray."""
    i, ray = wp.tid()
    env = i + env_offset
    measured = true_ranges[env, ray]
    if measured < INF:
        env_state = wp.rand_init(seed, env)
        frame_state = wp.rand_init(int(env_state), frame[0])
        state = wp.rand_init(int(frame_state), ray)
        factor = 1.0 + distance_ratio * (2.0 * wp.randf(state) - 1.0)
        measured = wp.min(measured * factor, max_range)
        if measured < min_range:
            measured = INF
        if wp.randf(state) < mask_ratio:
            measured = mask_low + (mask_high - mask_low) * wp.randf(state)
    ranges_out[env, ray] = measured
