"""Strain limiting: edges that are too long draw their ends together. One code for CPU and CUDA."""

import warp as wp

from refu_core.contact._layers_kernels import Cut

wp.set_module_options({"enable_backward": False})


@wp.struct
class Net:
    """A garment and memory to draw it together in."""

    other: wp.array[wp.vec3]
    """On a CPU the vertices that are listed, a sweep later [m]."""
    cut: Cut
    limit: float
    """How many times their rest length edges may be, unless they were longer before contact."""
    rows: wp.array[int]
    """On a CPU the ends of edges that are too long, in the order in which they were found."""
    is_listed: wp.array[int]
    count: wp.array[int]


@wp.func
def longest_squared(v: int, w: int, before: wp.array[wp.vec3], rest: wp.array[wp.vec3], net: Net) -> float:
    """The square of how long an edge may be [m²], by its vertices `before` contact and in the `rest` pose [m]."""
    at_rest = net.limit * net.limit * wp.length_sq(rest[v] - rest[w])
    return wp.max(at_rest, wp.length_sq(before[v] - before[w]))


@wp.func
def is_long(
    v: int, w: int, points: wp.array[wp.vec3], before: wp.array[wp.vec3], rest: wp.array[wp.vec3], net: Net
) -> bool:
    return wp.length_sq(points[v] - points[w]) > longest_squared(v, w, before, rest, net)


@wp.func
def drawn(v: int, points: wp.array[wp.vec3], before: wp.array[wp.vec3], rest: wp.array[wp.vec3], net: Net) -> wp.vec3:
    """Where a vertex's edges draw it: by half of the excess length of each, on average.

    Edges that aren't too long count, too: so a vertex that was thrown out comes back, and its neighbours hardly follow.
    """
    total = wp.vec3()
    for r in range(net.cut.ring_start[v], net.cut.ring_start[v + 1]):
        w = net.cut.ring[r]
        way = points[w] - points[v]
        ratio = longest_squared(v, w, before, rest, net) / wp.max(wp.length_sq(way), 1.0e-18)
        if ratio < 1.0:
            total += (0.5 - 0.5 * wp.sqrt(ratio)) * way
    return points[v] + total / float(wp.max(net.cut.ring_start[v + 1] - net.cut.ring_start[v], 1))


@wp.func
def enlist(v: int, net: Net) -> None:
    if net.is_listed[v] == 0:
        net.is_listed[v] = 1
        net.rows[net.count[0]] = v
        net.count[0] += 1


@wp.kernel
def sweep_kernel(
    net: Net,
    points: wp.array[wp.vec3],
    before: wp.array[wp.vec3],
    rest: wp.array[wp.vec3],
    # output
    limited: wp.array[wp.vec3],
) -> None:
    """One sweep, one vertex a thread."""
    v = wp.tid()
    limited[v] = drawn(v, points, before, rest, net)


@wp.kernel
def limit_kernel(
    net: Net,
    sweeps: int,
    points: wp.array[wp.vec3],
    before: wp.array[wp.vec3],
    rest: wp.array[wp.vec3],
    # output, only if any edge is too long
    limited: wp.array[wp.vec3],
) -> None:
    """All sweeps, by one thread: over the ends of edges that are too long, or become so."""
    net.count[0] = 0
    for v in range(points.shape[0]):
        if points[v] == before[v]:
            continue  # an edge that contact has made longer has an end that was moved
        for r in range(net.cut.ring_start[v], net.cut.ring_start[v + 1]):
            w = net.cut.ring[r]
            if is_long(v, w, points, before, rest, net):
                enlist(v, net)
                enlist(w, net)
    if net.count[0] == 0:
        return
    for v in range(points.shape[0]):
        limited[v] = points[v]
    for _ in range(sweeps):
        i = int(0)
        while i < net.count[0]:
            v = net.rows[i]
            net.other[v] = drawn(v, limited, before, rest, net)
            for r in range(net.cut.ring_start[v], net.cut.ring_start[v + 1]):
                w = net.cut.ring[r]
                if net.is_listed[w] == 0 and is_long(v, w, limited, before, rest, net):
                    enlist(w, net)
            i += 1
        for i in range(net.count[0]):
            limited[net.rows[i]] = net.other[net.rows[i]]
    for i in range(net.count[0]):
        net.is_listed[net.rows[i]] = 0
