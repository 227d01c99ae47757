"""Builds and refits trees of boxes over triangles, four children to a node and four triangles to a leaf."""

# ruff: noqa: UP018  (in a kernel, float(0) declares a variable that may change)

import warp as wp

wp.set_module_options({"enable_backward": False})

NUM_BINS = wp.constant(16)
BIG = wp.constant(wp.float32(3.0e38))


@wp.func
def half_area(low: wp.vec3, high: wp.vec3):
    edge = high - low
    return edge[0] * edge[1] + edge[1] * edge[2] + edge[2] * edge[0]


@wp.func
def bin_of(centre: float, low: float, extent: float):
    return wp.clamp(int((centre - low) * (float(NUM_BINS) / extent)), 0, NUM_BINS - 1)


@wp.func
def quads(count: int):
    """Leaves of four that ``count`` triangles fill."""
    return float((count + 3) / 4)


@wp.kernel(module="unique", enable_backward=False)
def split_triangles(
    lower: wp.array(dtype=wp.vec3),
    upper: wp.array(dtype=wp.vec3),
    heuristic_depth: int,
    # scratch, NUM_BINS each
    bin_lower: wp.array(dtype=wp.vec3),
    bin_upper: wp.array(dtype=wp.vec3),
    bin_count: wp.array(dtype=wp.int32),
    bin_cost: wp.array(dtype=wp.float32),
    # in and out
    order: wp.array(dtype=wp.int32),
    # out
    first_out: wp.array(dtype=wp.int32),
    count_out: wp.array(dtype=wp.int32),
    left_out: wp.array(dtype=wp.int32),
    depth_out: wp.array(dtype=wp.int32),
    lower_out: wp.array(dtype=wp.vec3),
    upper_out: wp.array(dtype=wp.vec3),
):
    """A binary tree, breadth first, by one thread: nodes own ranges of ``order``, leaves at most four triangles.

    Splits minimise the surface area heuristic over bins down to ``heuristic_depth`` and halve the range below it.
    """
    first_out[0] = 0
    count_out[0] = order.shape[0]
    depth_out[0] = 0
    num_nodes = wp.int32(1)
    node = wp.int32(0)
    while node < num_nodes:
        begin = first_out[node]
        end = begin + count_out[node]
        low = wp.vec3(BIG, BIG, BIG)
        high = wp.vec3(-BIG, -BIG, -BIG)
        centre_low = wp.vec3(BIG, BIG, BIG)
        centre_high = wp.vec3(-BIG, -BIG, -BIG)
        for i in range(begin, end):
            triangle = order[i]
            low = wp.min(low, lower[triangle])
            high = wp.max(high, upper[triangle])
            centre = 0.5 * lower[triangle] + 0.5 * upper[triangle]
            centre_low = wp.min(centre_low, centre)
            centre_high = wp.max(centre_high, centre)
        lower_out[node] = low
        upper_out[node] = high
        left_out[node] = -1
        if end - begin > 4:
            best_cost = float(BIG)
            best_axis = wp.int32(-1)
            best_bin = wp.int32(0)
            for axis in range(3):
                extent = centre_high[axis] - centre_low[axis]
                if extent > 0.0 and depth_out[node] < heuristic_depth:
                    for k in range(NUM_BINS):
                        bin_lower[k] = wp.vec3(BIG, BIG, BIG)
                        bin_upper[k] = wp.vec3(-BIG, -BIG, -BIG)
                        bin_count[k] = 0
                    for i in range(begin, end):
                        triangle = order[i]
                        middle = 0.5 * lower[triangle][axis] + 0.5 * upper[triangle][axis]
                        k = bin_of(middle, centre_low[axis], extent)
                        bin_lower[k] = wp.min(bin_lower[k], lower[triangle])
                        bin_upper[k] = wp.max(bin_upper[k], upper[triangle])
                        bin_count[k] = bin_count[k] + 1
                    side_low = wp.vec3(BIG, BIG, BIG)
                    side_high = wp.vec3(-BIG, -BIG, -BIG)
                    side_count = wp.int32(0)
                    for k in range(NUM_BINS - 1):
                        side_low = wp.min(side_low, bin_lower[k])
                        side_high = wp.max(side_high, bin_upper[k])
                        side_count += bin_count[k]
                        bin_cost[k] = BIG
                        if side_count > 0:
                            bin_cost[k] = half_area(side_low, side_high) * quads(side_count)
                    side_low = wp.vec3(BIG, BIG, BIG)
                    side_high = wp.vec3(-BIG, -BIG, -BIG)
                    side_count = wp.int32(0)
                    for j in range(1, NUM_BINS):
                        k = NUM_BINS - j
                        side_low = wp.min(side_low, bin_lower[k])
                        side_high = wp.max(side_high, bin_upper[k])
                        side_count += bin_count[k]
                        if side_count > 0:
                            cost = bin_cost[k - 1] + half_area(side_low, side_high) * quads(side_count)
                            if cost < best_cost:
                                best_cost = cost
                                best_axis = axis
                                best_bin = k - 1
            split = (begin + end) / 2
            if best_axis >= 0:
                extent = centre_high[best_axis] - centre_low[best_axis]
                left = int(begin)
                right = int(end - 1)
                while left <= right:
                    triangle = order[left]
                    middle = 0.5 * lower[triangle][best_axis] + 0.5 * upper[triangle][best_axis]
                    if bin_of(middle, centre_low[best_axis], extent) <= best_bin:
                        left += 1
                    else:
                        order[left] = order[right]
                        order[right] = triangle
                        right -= 1
                if left > begin and left < end:
                    split = left
            left_out[node] = num_nodes
            first_out[num_nodes] = begin
            count_out[num_nodes] = split - begin
            depth_out[num_nodes] = depth_out[node] + 1
            first_out[num_nodes + 1] = split
            count_out[num_nodes + 1] = end - split
            depth_out[num_nodes + 1] = depth_out[node] + 1
            num_nodes += 2
        node += 1


@wp.kernel(module="unique", enable_backward=False)
def widen_tree(
    # binary tree
    order: wp.array(dtype=wp.int32),
    first: wp.array(dtype=wp.int32),
    count: wp.array(dtype=wp.int32),
    left: wp.array(dtype=wp.int32),
    lower: wp.array(dtype=wp.vec3),
    upper: wp.array(dtype=wp.vec3),
    # scratch: the binary node of each node, how much of a stack its children need
    source: wp.array(dtype=wp.int32),
    need: wp.array(dtype=wp.int32),
    # out
    bounds_out: wp.array3d(dtype=wp.float32),
    child_out: wp.array2d(dtype=wp.int32),
    depth_out: wp.array(dtype=wp.int32),
    leaf_out: wp.array2d(dtype=wp.int32),
    totals_out: wp.array(dtype=wp.int32),
):
    """Nodes of up to four children, breadth first, by one thread, and the triangles of each leaf.

    A node opens its largest children. ``totals_out`` is (nodes, leaves, stack that a descent needs).
    """
    num_nodes = wp.int32(1)
    num_leaves = wp.int32(0)
    most = wp.int32(0)
    source[0] = 0
    need[0] = 0
    depth_out[0] = 0
    node = wp.int32(0)
    while node < num_nodes:
        lanes = wp.vec4i(source[node], -1, -1, -1)
        num_lanes = wp.int32(1)
        opened = wp.int32(1)
        while opened == 1 and num_lanes < 4:
            opened = wp.int32(0)
            widest = float(-1.0)
            pick = wp.int32(0)
            for k in range(num_lanes):
                if left[lanes[k]] >= 0:
                    area = half_area(lower[lanes[k]], upper[lanes[k]])
                    if area > widest:
                        widest = area
                        pick = k
                        opened = wp.int32(1)
            if opened == 1:
                pair = left[lanes[pick]]
                lanes[pick] = pair
                lanes[num_lanes] = pair + 1
                num_lanes += 1
        need_here = need[node] + num_lanes - 1
        most = wp.max(most, need_here)
        for k in range(num_lanes):
            inner = lanes[k]
            for axis in range(3):
                bounds_out[node, axis, k] = lower[inner][axis]
                bounds_out[node, 3 + axis, k] = upper[inner][axis]
            if left[inner] >= 0:
                child_out[node, k] = num_nodes
                source[num_nodes] = inner
                need[num_nodes] = need_here
                depth_out[num_nodes] = depth_out[node] + 1
                num_nodes += 1
            else:
                child_out[node, k] = -1 - num_leaves
                for j in range(count[inner]):
                    leaf_out[num_leaves, j] = order[first[inner] + j]
                num_leaves += 1
        node += 1
    totals_out[0] = num_nodes
    totals_out[1] = num_leaves
    totals_out[2] = most


@wp.kernel(module="unique", enable_backward=False)
def gather_leaves(
    env_offset: int,
    vertices: wp.array2d(dtype=wp.vec3),
    leaf_vertex: wp.array2d(dtype=wp.vec4i),
    first_leaf: int,
    # out
    triangles_out: wp.array2d(dtype=wp.vec4),
):
    """Writes the corners of one leaf's triangles: nine rows (corner, axis) of four triangles.

    A triangle with a corner that is not finite becomes all NaN, which no ray hits.
    """
    i, leaf = wp.tid()
    env = i + env_offset
    out = first_leaf + env * leaf_vertex.shape[0] + leaf
    for k in range(4):
        total = float(0.0)
        for corner in range(3):
            index = leaf_vertex[leaf, corner][k]
            p = wp.vec3(wp.NAN, wp.NAN, wp.NAN)
            if index >= 0:
                p = vertices[env, index]
            total += 0.0 * (p[0] + p[1] + p[2])
            for axis in range(3):
                row = triangles_out[out, 3 * corner + axis]
                row[k] = p[axis]
                triangles_out[out, 3 * corner + axis] = row
        if total != 0.0:
            for j in range(9):
                row = triangles_out[out, j]
                row[k] = wp.NAN
                triangles_out[out, j] = row


@wp.kernel(module="unique", enable_backward=False)
def refit_nodes(
    env_offset: int,
    first_in_level: int,
    child: wp.array2d(dtype=wp.int32),
    triangles: wp.array2d(dtype=wp.vec4),
    first_leaf: int,
    num_leaves: int,
    first_node: int,
    # in and out
    bounds: wp.array2d(dtype=wp.vec4),
):
    """Refits the boxes of one node's children, whose own nodes have been refitted; an empty box is inside out."""
    i, k = wp.tid()
    env = i + env_offset
    node = first_in_level + k
    nodes = first_node + env * child.shape[0]
    leaves = first_leaf + env * num_leaves
    lows = wp.matrix(shape=(3, 4), dtype=wp.float32)
    highs = wp.matrix(shape=(3, 4), dtype=wp.float32)
    for lane in range(4):
        inner = child[node, lane]
        for axis in range(3):
            low = float(wp.INF)
            high = float(-wp.INF)
            if inner > 0:
                below_low = bounds[nodes + inner, axis]
                below_high = bounds[nodes + inner, 3 + axis]
                low = wp.min(below_low)
                high = wp.max(below_high)
            elif inner < 0:
                for corner in range(3):
                    row = triangles[leaves - 1 - inner, 3 * corner + axis]
                    for j in range(4):
                        if row[j] < low:
                            low = row[j]
                        if row[j] > high:
                            high = row[j]
            lows[axis, lane] = low
            highs[axis, lane] = high
    for axis in range(3):
        bounds[nodes + node, axis] = lows[axis]
        bounds[nodes + node, 3 + axis] = highs[axis]
