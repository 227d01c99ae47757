"""Warp kernel of the rings, one thread for each environment."""

import math

import warp as wp

from omnilidar.kernels.sectors import bearing_in_sectors, sector_at
from omniperception.common.sectors import FAR

LEAST_PROXIMITY = 1e-6
"""Proximity below which a cell counts as empty; with a decay of 0.5 m, a distance of 6.9 m."""

LATERAL = 5.0
"""Scale of the sine of the bearing within a sector, which is at most 0.09 for 36 of them."""


@wp.kernel(module="unique", enable_backward=False)
def write_rings(
    env_offset: int,
    cells: wp.array3d(dtype=wp.vec3),
    origin: wp.array2d(dtype=wp.vec2),
    yaw: wp.array2d(dtype=wp.float32),
    here: wp.array2d(dtype=wp.vec2),
    heading: wp.array2d(dtype=wp.float32),
    count: wp.array2d(dtype=wp.int64),
    decay: float,
    decays: wp.array(dtype=wp.float32),
    history: int,
    bands: int,
    nearest: wp.array3d(dtype=wp.float32),  # work memory
    # out
    rings_out: wp.array4d(dtype=wp.float32),
):
    """The windows of one environment, see `moved_rings`."""
    env = wp.tid() + env_offset
    num_sectors = rings_out.shape[3]
    per_cell = decays.shape[0] + 1
    for window in range(rings_out.shape[1]):
        newest = window + history - 1
        for k in range(history - int(count[env, window]), history):
            frame = window + k
            step = origin[env, frame] - here[env, newest]
            back = -heading[env, newest]
            cos_back = wp.cos(back)
            sin_back = wp.sin(back)
            shift = wp.vec2(cos_back * step[0] - sin_back * step[1], sin_back * step[0] + cos_back * step[1])
            cos = wp.cos(yaw[env, frame] + back)
            sin = wp.sin(yaw[env, frame] + back)
            for band in range(bands):
                for sector in range(num_sectors):
                    nearest[env, band, sector] = wp.static(FAR)
            for cell in range(bands * num_sectors):
                c = cells[env, frame, cell]
                if c[2] > wp.static(LEAST_PROXIMITY):
                    far = -decay * wp.log(c[2]) / c[2]
                    x = far * (cos * c[0] - sin * c[1]) + shift[0]
                    y = far * (sin * c[0] + cos * c[1]) + shift[1]
                    distance = wp.sqrt(x * x + y * y)
                    bearing = bearing_in_sectors(x, y, num_sectors)
                    sector = sector_at(bearing, num_sectors)
                    band = cell / num_sectors
                    if distance < nearest[env, band, sector]:
                        nearest[env, band, sector] = distance
                        first = (k * bands + band) * per_cell
                        for j in range(decays.shape[0]):
                            rings_out[env, window, first + j, sector] = wp.exp(-distance / decays[j])
                        within = (bearing - float(sector) - 0.5) * wp.static(2.0 * math.pi) / float(num_sectors)
                        last = rings_out[env, window, first + decays.shape[0] - 1, sector]
                        rings_out[env, window, first + decays.shape[0], sector] = wp.static(LATERAL) * within * last
