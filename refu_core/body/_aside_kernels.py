"""Finds which places are inside the body."""

import warp as wp

from refu_core.body._bundle_kernels import greater, lesser
from refu_core.body._collider_kernels import Means, find_mean

wp.set_module_options({"enable_backward": False})


@wp.kernel
def near_kernel(
    skin: wp.array[wp.vec3],
    n_skin: int,
    n_middles: int,
    means: Means,
    segment_start: wp.array[int],
    corner: wp.array[int],
    # outputs
    low_of_all: wp.array[wp.vec3],
    high_of_all: wp.array[wp.vec3],
    count: wp.array[int],
) -> None:
    """Counts how often one of the first `n_middles` means is in the box of a segment; for a single thread of a CPU.

    The vertices of segment k's faces are `corner[segment_start[k]:segment_start[k + 1]]`. The other means close the
    body: they are appended to its skin.
    """
    for c in range(means.mean.shape[0]):
        find_mean(c, skin, means)
        if c >= n_middles:
            skin[n_skin + c - n_middles] = means.mean[c]
    near = int(0)
    low_of_all[0] = wp.vec3(1.0e9)
    high_of_all[0] = wp.vec3(-1.0e9)
    for k in range(segment_start.shape[0] - 1):
        low = skin[corner[segment_start[k]]]
        high = low
        for i in range(segment_start[k] + 1, segment_start[k + 1]):
            at = skin[corner[i]]
            low = lesser(low, at)
            high = greater(high, at)
        low_of_all[0] = lesser(low_of_all[0], low)
        high_of_all[0] = greater(high_of_all[0], high)
        for c in range(n_middles):
            at = means.mean[c]
            if low == lesser(low, at) and high == greater(high, at):
                near += 1
    count[0] = near


@wp.kernel
def inside_kernel(
    tree: wp.uint64,
    low: wp.array[wp.vec3],
    high: wp.array[wp.vec3],
    points: wp.array[wp.vec3],
    # outputs
    face: wp.array[int],
    corners: wp.array[wp.vec3],
) -> None:
    """Finds the mesh's closest face to each point inside of it, -1 for one outside, and the weights of its corners.

    `low` and `high` are the mesh's box.
    """
    i = wp.tid()
    p = points[i]
    face[i] = -1
    for c in range(3):
        if p[c] < low[0][c] or p[c] > high[0][c]:
            return
    # A ray that points away from the middle of the box leaves it soonest, and meets few boxes of the tree.
    side = wp.vec3(wp.where(p[0] < 0.5 * (low[0][0] + high[0][0]), -0.9418, 0.9418), 0.2389, 0.2361)
    if wp.mesh_query_ray_count_intersections(tree, p, side) % 2 == 1:
        hit = wp.mesh_query_point_no_sign(tree, p, 1.0e3)
        face[i] = hit.face
        corners[i] = wp.vec3(hit.u, hit.v, 1.0 - hit.u - hit.v)
