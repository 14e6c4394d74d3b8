"""Strain limiting: edges that are too long draw their ends together. One code for CPU and CUDA."""

import warp as wp

from refu_core.contact._layers_kernels import Cut

wp.set_module_options({"enable_backward": False})


@wp.struct
class Net:
    """A garment and memory to draw it together in."""

    rest: wp.array[wp.vec3]
    """Vertices in the rest pose [m]."""
    before: wp.array[wp.vec3]
    """Vertices before contact [m]."""
    points: wp.array[wp.vec3]
    other: wp.array[wp.vec3]
    """Vertices [m], and the same a sweep later."""
    cut: Cut
    limit: float
    """How many times their rest length edges may be, unless they were longer before contact."""
    rows: wp.array[int]
    """On a CPU the ends of edges that are too long, in the order in which they were found."""
    is_listed: wp.array[int]
    count: wp.array[int]


@wp.func
def longest_squared(v: int, w: int, net: Net) -> float:
    """The square of how long an edge may be [m²]."""
    at_rest = net.limit * net.limit * wp.length_sq(net.rest[v] - net.rest[w])
    return wp.max(at_rest, wp.length_sq(net.before[v] - net.before[w]))


@wp.func
def is_long(v: int, w: int, points: wp.array[wp.vec3], net: Net) -> bool:
    return wp.length_sq(points[v] - points[w]) > longest_squared(v, w, net)


@wp.func
def drawn(v: int, points: wp.array[wp.vec3], net: Net) -> wp.vec3:
    """Where a vertex's edges draw it: by half of the excess length of each, on average.

    Edges that aren't too long count, too: so a vertex that was thrown out comes back, and its neighbours hardly follow.
    """
    total = wp.vec3()
    for r in range(net.cut.ring_start[v], net.cut.ring_start[v + 1]):
        w = net.cut.ring[r]
        way = points[w] - points[v]
        ratio = longest_squared(v, w, net) / wp.max(wp.length_sq(way), 1.0e-18)
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
def sweep_kernel(net: Net, points: wp.array[wp.vec3], other: wp.array[wp.vec3]) -> None:
    """One sweep, one vertex a thread."""
    v = wp.tid()
    other[v] = drawn(v, points, net)


@wp.kernel
def limit_kernel(net: Net, sweeps: int) -> None:
    """All sweeps, by one thread: over the ends of edges that are too long, or become so."""
    for v in range(net.points.shape[0]):
        if net.points[v] == net.before[v]:
            continue  # an edge that contact has made longer has an end that was moved
        for r in range(net.cut.ring_start[v], net.cut.ring_start[v + 1]):
            w = net.cut.ring[r]
            if is_long(v, w, net.points, net):
                enlist(v, net)
                enlist(w, net)
    for _ in range(sweeps):
        i = int(0)
        while i < net.count[0]:
            v = net.rows[i]
            net.other[v] = drawn(v, net.points, net)
            for r in range(net.cut.ring_start[v], net.cut.ring_start[v + 1]):
                if net.is_listed[net.cut.ring[r]] == 0 and is_long(v, net.cut.ring[r], net.points, net):
                    enlist(net.cut.ring[r], net)
            i += 1
        for i in range(net.count[0]):
            net.points[net.rows[i]] = net.other[net.rows[i]]
    for i in range(net.count[0]):
        net.is_listed[net.rows[i]] = 0
