"""Triangle-triangle intersections in double precision, candidates from a BVH."""

import warp as wp

from refu_core.sdf._crossing_kernels import BLOCK, Corners, double, meeting_edges

# Contracted multiply-adds would round a x b and b x a differently, and open cracks between neighbouring triangles.
wp.set_module_options({"fuse_fp": False, "enable_backward": False})


@wp.kernel
def intersect_kernel(
    body: wp.uint64,
    vertices: wp.array[wp.vec3],
    faces: wp.array[wp.vec3i],
    numbers: wp.array[int],
    is_body: bool,
    # outputs
    count: wp.array[int],
    pairs: wp.array[wp.vec3i],
) -> None:
    """Appends (face, body face, edges) for each face that meets a body face; `count` goes on if `pairs` has no room.

    A thread takes `BLOCK` successive faces, which lie together, so that the tree is walked once for them; `numbers`
    holds their indices in the mesh. `edges` are as `meeting_edges` gives them. With `is_body` the faces are the body's
    own: each pair is given once, and faces that share an edge are left out.
    """
    first = BLOCK * wp.tid()
    end = wp.min(first + BLOCK, faces.shape[0])
    lower = vertices[faces[first][0]]
    upper = lower
    lows = Corners()
    highs = Corners()
    for k in range(first, end):
        a = vertices[faces[k][0]]
        b = vertices[faces[k][1]]
        c = vertices[faces[k][2]]
        low = wp.min(wp.min(a, b), c)
        high = wp.max(wp.max(a, b), c)
        lows[k - first] = low
        highs[k - first] = high
        lower = wp.min(lower, low)
        upper = wp.max(upper, high)
    query = wp.mesh_query_aabb(body, lower, upper)
    j = int(0)
    while wp.mesh_query_aabb_next(query, j):
        other = wp.vec3i(
            wp.mesh_get_index(body, 3 * j), wp.mesh_get_index(body, 3 * j + 1), wp.mesh_get_index(body, 3 * j + 2)
        )
        p = wp.mesh_get_point(body, 3 * j)
        q = wp.mesh_get_point(body, 3 * j + 1)
        r = wp.mesh_get_point(body, 3 * j + 2)
        low = wp.min(wp.min(p, q), r)
        high = wp.max(wp.max(p, q), r)
        for k in range(first, end):
            i = k - first
            if lows[i, 0] > high[0] or lows[i, 1] > high[1] or lows[i, 2] > high[2]:
                continue
            if highs[i, 0] < low[0] or highs[i, 1] < low[1] or highs[i, 2] < low[2]:
                continue
            if is_body and j <= numbers[k]:
                continue
            triangle = faces[k]
            edges = meeting_edges(
                triangle,
                double(vertices[triangle[0]]),
                double(vertices[triangle[1]]),
                double(vertices[triangle[2]]),
                other,
                double(p),
                double(q),
                double(r),
                is_body,
            )
            if edges > 0:
                slot = wp.atomic_add(count, 0, 1)
                if slot < pairs.shape[0]:
                    pairs[slot] = wp.vec3i(numbers[k], j, edges)
