"""The closest skin that is really outside, for vertices that ended inside: one code for CPU and CUDA."""

import warp as wp

from refu_core.contact._layers_kernels import Cut, normal_at
from refu_core.sdf._closest_kernels import area_normal, closest_on_triangle

wp.set_module_options({"enable_backward": False})

_ROUNDS = wp.constant(4)
"""Boxes that are searched, each twice as wide as the one before."""


@wp.func
def body_at(sample: int, body: wp.array[wp.vec3], faces: wp.array2d[int]) -> wp.vec3:
    """A sample of the skin: the vertices come first, then the middles of faces."""
    f = sample - body.shape[0]
    if f < 0:
        return body[sample]
    return (body[faces[f, 0]] + body[faces[f, 1]] + body[faces[f, 2]]) / 3.0


@wp.kernel
def above_kernel(
    lift: float,
    body: wp.array[wp.vec3],
    cut: Cut,
    # output
    places: wp.array[wp.vec3],
) -> None:
    """The places `lift` [m] above each vertex, and above the middle of each face after those."""
    i = wp.tid()
    f = i - body.shape[0]
    if f < 0:
        places[i] = body[i] + lift * normal_at(i, body, cut)
    else:
        places[i] = body_at(i, body, cut.faces) + lift * wp.normalize(area_normal(f, body, cut.faces))


@wp.kernel
def nearest_kernel(
    tree: wp.uint64,
    farthest: float,
    body: wp.array[wp.vec3],
    faces: wp.array2d[int],
    above: wp.array[wp.vec3],
    of_samples: bool,
    winding_above: wp.array[int],
    points: wp.array[wp.vec3],
    is_inside: wp.array[int],
    # outputs
    foot: wp.array[wp.vec3],
    normal: wp.array[wp.vec3],
) -> None:
    """For each point inside: the closest place on open skin, and its normal; zero where none is within `farthest` [m].

    A face is open where there is no interior `above` its middle. With `of_samples`, only the middles and vertices
    themselves count.
    """
    i = wp.tid()
    normal[i] = wp.vec3()
    if is_inside[i] == 0:
        return
    p = points[i]
    n = body.shape[0]
    reach = farthest / wp.static(2.0 ** (_ROUNDS - 1))
    found = bool(False)
    for _ in range(_ROUNDS):
        best = reach * reach
        side = wp.vec3(reach, reach, reach)
        query = wp.mesh_query_aabb(tree, p - side, p + side)
        f = int(0)
        while wp.mesh_query_aabb_next(query, f):
            a = body[faces[f, 0]]
            b = body[faces[f, 1]]
            c = body[faces[f, 2]]
            for k in range(wp.where(of_samples, 4, 1)):
                sample = n + f
                if k > 0:
                    sample = faces[f, k - 1]
                if winding_above[sample] == 0:
                    at = body_at(sample, body, faces)
                    if not of_samples:
                        w, _feature = closest_on_triangle(p, a, b, c)
                        at = w[0] * a + w[1] * b + w[2] * c
                    squared = wp.length_sq(at - p)
                    if squared < best:
                        best = squared
                        found = True
                        foot[i] = at
                        normal[i] = wp.normalize(above[sample] - body_at(sample, body, faces))
        if found:
            break
        reach *= 2.0
