"""The Warp kernel that tells what stands on the ground from what is ground, noise or the robot's own body."""

import warp as wp

from omnilidar.kernels.rotations import to_quat
from omnilidar.kernels.sectors import levelled, sector_of

wp.set_module_options({"enable_backward": False})

_INF = wp.constant(wp.float32(wp.inf))
_RIDGE = wp.constant(1.0e-3)


@wp.struct
class Settings:
    """`GeometryConfig`."""

    back: float
    front: float
    side: float
    reach: float
    near: float
    near_share: float
    standing: float
    fit_reach: float
    ring: float
    lowest: float
    slope: float
    min_height: float
    rise: float
    lift: float
    headroom: float
    rings: int
    sectors: int


@wp.func
def _horizontal(p: wp.vec3):
    return wp.sqrt(p[0] * p[0] + p[1] * p[1])


@wp.kernel
def find_standing(
    env_offset: int,
    ranges: wp.array2d(dtype=wp.float32),
    directions: wp.array2d(dtype=wp.vec3),
    base_quat: wp.array(dtype=wp.vec4),  # (w, x, y, z)
    mount_pos: wp.vec3,
    mount_quat: wp.vec4,
    bands: wp.array(dtype=wp.float32),
    settings: Settings,
    # work
    cells: wp.array2d(dtype=wp.int32),  # (N, R) of each hit that counts; -1: none
    low: wp.array2d(dtype=wp.float32),  # (N, rings * sectors)
    ground: wp.array2d(dtype=wp.float32),  # (N, rings * sectors)
    returns: wp.array2d(dtype=wp.int32),  # (N, rings * sectors)
    around: wp.array2d(dtype=wp.int32),  # (N, 2 * sectors) returns around the sensor: near ones that stand, and all
    # out
    points: wp.array2d(dtype=wp.vec3),
    heights: wp.array2d(dtype=wp.float32),
):
    """See `Standing`; a thread for each environment."""
    env = env_offset + wp.tid()
    level = levelled(base_quat[env])
    sensor = wp.quat_rotate(level, mount_pos)
    mount = wp.quat_to_matrix(to_quat(mount_quat))
    num_rays = ranges.shape[1]
    num_cells = settings.rings * settings.sectors
    for cell in range(num_cells):
        low[env, cell] = _INF
        ground[env, cell] = 0.0
        returns[env, cell] = 0
    for sector in range(2 * settings.sectors):
        around[env, sector] = 0
    for ray in range(num_rays):
        cells[env, ray] = -1
        distance = ranges[env, ray]
        p = wp.vec3(0.0, 0.0, 0.0)
        if distance < _INF:  # false for nan
            p = mount_pos + distance * (mount * directions[env, ray])
            on_body = p[0] > -settings.back and p[0] < settings.front and wp.abs(p[1]) < settings.side
            p = wp.quat_rotate(level, p)
            if not on_body:
                ring = wp.min(int(_horizontal(p) / settings.ring), settings.rings - 1)
                cells[env, ray] = ring * settings.sectors + sector_of(p[0], p[1], settings.sectors)
        points[env, ray] = p

    upright = wp.vec3(0.0, 0.0, -settings.standing)
    plane = upright  # z = plane . (x, y, 1)
    for band in range(bands.shape[0]):
        normal = wp.mat33(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        right = wp.vec3(0.0, 0.0, 0.0)
        count = wp.float32(0.0)
        for ray in range(num_rays):
            p = points[env, ray]
            if cells[env, ray] >= 0 and ranges[env, ray] >= settings.near and _horizontal(p) < settings.fit_reach:
                at = wp.vec3(p[0], p[1], 1.0)
                if wp.abs(p[2] - wp.dot(plane, at)) < bands[band]:
                    normal += wp.outer(at, at)
                    right += p[2] * at
                    count += 1.0
        share = 1.0 / wp.max(count, 1.0)
        ridge = wp.mat33(_RIDGE, 0.0, 0.0, 0.0, _RIDGE, 0.0, 0.0, 0.0, _RIDGE)
        plane = wp.inverse(share * normal + ridge) * (share * right + _RIDGE * upright)

    for ray in range(num_rays):
        p = points[env, ray]
        cell = cells[env, ray]
        if cell >= 0:
            above = p[2] - wp.dot(plane, wp.vec3(p[0], p[1], 1.0))
            heights[env, ray] = above
            if ranges[env, ray] >= settings.near and _horizontal(p) < settings.reach:
                low[env, cell] = wp.min(low[env, cell], above)
    for ray in range(num_rays):
        cell = cells[env, ray]
        tells = cell >= 0 and ranges[env, ray] >= settings.near and _horizontal(points[env, ray]) < settings.reach
        if tells and heights[env, ray] <= low[env, cell] + settings.lowest:
            ground[env, cell] = ground[env, cell] + heights[env, ray]
            returns[env, cell] = returns[env, cell] + 1
    for sector in range(settings.sectors):
        before = wp.float32(0.0)
        for ring in range(settings.rings):
            cell = ring * settings.sectors + sector
            if returns[env, cell] > 0:
                before = wp.min(ground[env, cell] / float(returns[env, cell]), before + settings.slope * settings.ring)
            ground[env, cell] = before

    for ray in range(num_rays):
        cell = cells[env, ray]
        height = _INF
        if cell >= 0:
            p = points[env, ray]
            seen = p - sensor
            steepness = wp.max(-seen[2] / wp.max(wp.length(seen), 1.0e-6), 0.0)
            least = settings.min_height + settings.rise * _horizontal(p) + settings.lift * steepness
            above = heights[env, ray] - ground[env, cell]
            sector = sector_of(seen[0], seen[1], settings.sectors)
            around[env, settings.sectors + sector] = around[env, settings.sectors + sector] + 1
            if above > least:
                height = above
                if ranges[env, ray] < settings.near and above < settings.headroom:
                    around[env, sector] = around[env, sector] + 1
        heights[env, ray] = height
    for ray in range(num_rays):
        if ranges[env, ray] < settings.near and heights[env, ray] < settings.headroom:
            seen = points[env, ray] - sensor
            sector = sector_of(seen[0], seen[1], settings.sectors)
            share = float(around[env, sector]) / float(wp.max(around[env, settings.sectors + sector], 1))
            if share < settings.near_share:
                heights[env, ray] = _INF


@wp.kernel
def nearest_standing(
    env_offset: int,
    points: wp.array2d(dtype=wp.vec3),
    heights: wp.array2d(dtype=wp.float32),
    band_edges: wp.array(dtype=wp.float32),
    num_sectors: int,
    decay: float,
    # out
    points_out: wp.array2d(dtype=wp.vec3),
):
    """By band of height and sector, the nearest point's bearing times its proximity, and that; zeros without one.

    A thread for each environment; of equally near points the first one.
    """
    env = env_offset + wp.tid()
    num_bands = band_edges.shape[0] - 1
    for cell in range(num_bands * num_sectors):
        points_out[env, cell] = wp.vec3(0.0, 0.0, 0.0)
    for ray in range(points.shape[1]):
        height = heights[env, ray]
        if height >= band_edges[0] and height < band_edges[num_bands]:
            band = wp.int32(0)
            while height >= band_edges[band + 1]:
                band += 1
            p = points[env, ray]
            slot = band * num_sectors + sector_of(p[0], p[1], num_sectors)
            away = _horizontal(p)
            proximity = wp.exp(-away / decay)
            if proximity > points_out[env, slot][2]:
                bearing = proximity / wp.max(away, 1.0e-6)
                points_out[env, slot] = wp.vec3(bearing * p[0], bearing * p[1], proximity)
