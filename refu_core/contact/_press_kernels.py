"""What presses cloth to the skin that it lies on, vertex by vertex: one code for CPU and CUDA."""

import warp as wp

from refu_core.body._bundle_kernels import Bundles, greater, is_near, lesser

wp.set_module_options({"enable_backward": False})

WANTED = wp.constant(0)  # limbs that may be near any vertex, as bits
NEAR = wp.constant(1)  # vertices that any of them may be near
PRESSED = wp.constant(2)  # vertices with less room than height, and on a CPU those that sweeps reach from there
N_COUNTS = 3


@wp.struct
class Fabric:
    """A garment and memory to press it in."""

    skin: wp.array[wp.vec3]
    """What each vertex lies on [m]."""
    points: wp.array[wp.vec3]
    """The garment [m]."""
    start: wp.array[int]
    vertex: wp.array[int]
    """The vertices of piece i of the garment are `vertex[start[i]:start[i + 1]]`."""
    foreign: wp.array[int]
    """The limbs that each vertex doesn't lie on, as bits."""
    ring_start: wp.array[int]
    ring: wp.array[int]
    boxed: wp.array[int]
    """Limbs that may be near the piece of each of `near`, as bits."""
    near: wp.array[int]
    rows: wp.array[int]
    """On a CPU the vertices that are pressed, and as far as sweeps reach; on a GPU all."""
    is_row: wp.array[int]
    room: wp.array[float]
    spread: wp.array[float]
    """How far from the skin each vertex may be [m], and the same a sweep later."""
    counts: wp.array[int]


@wp.func
def find_near(i: int, fabric: Fabric, bundles: Bundles, clearance: float) -> None:
    """Lists the vertices of piece i if a limb may be between it and the skin, by boxes."""
    first = fabric.start[i]
    last = fabric.start[i + 1]
    low = fabric.points[fabric.vertex[first]]
    high = low
    foreign = int(0)
    for c in range(first, last):
        v = fabric.vertex[c]
        low = lesser(low, lesser(fabric.points[v], fabric.skin[v]))
        high = greater(high, greater(fabric.points[v], fabric.skin[v]))
        foreign |= fabric.foreign[v]
    found = int(0)
    for k in range(bundles.group_low.shape[0]):
        if (foreign >> k) & 1 == 1 and is_near(low, high, k, clearance, bundles):
            found |= 1 << k
    if found == 0:
        return
    wanted = int(0)
    for c in range(first, last):
        v = fabric.vertex[c]
        low = lesser(fabric.points[v], fabric.skin[v])
        high = greater(fabric.points[v], fabric.skin[v])
        boxed = int(0)
        for k in range(bundles.group_low.shape[0]):
            if ((fabric.foreign[v] & found) >> k) & 1 == 1 and is_near(low, high, k, clearance, bundles):
                boxed |= 1 << k
        if boxed != 0:
            wanted |= boxed
            fabric.boxed[v] = boxed
            fabric.near[wp.atomic_add(fabric.counts, NEAR, 1)] = v
    wp.atomic_or(fabric.counts, WANTED, wanted)


@wp.func
def press(v: int, fabric: Fabric, limbs: wp.array[wp.uint64], clearance: float) -> None:
    """How far from the skin that it lies on a vertex may be: where a limb comes in between, on this side of it."""
    way = fabric.points[v] - fabric.skin[v]
    height = wp.length(way)
    if height < clearance:
        return
    up = way / height
    least = float(height)
    for k in range(limbs.shape[0]):
        if (fabric.boxed[v] >> k) & 1 == 1:
            hit = wp.mesh_query_ray(limbs[k], fabric.skin[v], up, height + clearance)
            if hit.result and wp.dot(hit.normal, up) < 0.0:  # else nothing is there, or the skin itself is within it
                least = wp.min(least, wp.max(hit.t - clearance, 0.5 * hit.t))
    if least < height:
        fabric.room[v] = least
        fabric.is_row[v] = 1
        fabric.rows[wp.atomic_add(fabric.counts, PRESSED, 1)] = v


@wp.func
def spread(v: int, fabric: Fabric, slope: float, room: wp.array[float], wider: wp.array[float]) -> None:
    """A vertex has no more room than a neighbour of it, and what `slope` gives for the way from there."""
    least = room[v]
    for k in range(fabric.ring_start[v], fabric.ring_start[v + 1]):
        w = fabric.ring[k]
        least = wp.min(least, room[w] + slope * wp.length(fabric.points[v] - fabric.points[w]))
    wider[v] = least


@wp.func
def lower(v: int, fabric: Fabric, room: wp.array[float]) -> None:
    """Draws a vertex back to the room that it has, towards the skin."""
    way = fabric.points[v] - fabric.skin[v]
    height = wp.length(way)
    if height > room[v]:
        fabric.points[v] = fabric.skin[v] + (room[v] / height) * way


@wp.kernel
def look_kernel(fabric: Fabric, bundles: Bundles, clearance: float) -> None:
    """`find_near` of one piece a thread."""
    find_near(wp.tid(), fabric, bundles, clearance)


@wp.kernel
def press_kernel(fabric: Fabric, limbs: wp.array[wp.uint64], clearance: float) -> None:
    """`press` of one vertex a thread."""
    i = wp.tid()
    if i < fabric.counts[NEAR]:
        press(fabric.near[i], fabric, limbs, clearance)


@wp.kernel
def spread_kernel(fabric: Fabric, slope: float, room: wp.array[float], wider: wp.array[float]) -> None:
    """`spread` of one vertex a thread."""
    spread(wp.tid(), fabric, slope, room, wider)


@wp.kernel
def lower_kernel(fabric: Fabric, room: wp.array[float]) -> None:
    """`lower` of one vertex a thread."""
    lower(wp.tid(), fabric, room)


@wp.kernel
def press_all_kernel(
    fabric: Fabric, limbs: wp.array[wp.uint64], clearance: float, slope: float, sweeps: int, reach: int
) -> None:
    """All that follows, by one thread, of the vertices that it concerns."""
    for i in range(fabric.counts[NEAR]):
        press(fabric.near[i], fabric, limbs, clearance)
    first = int(0)
    for _ in range(sweeps):
        last = int(fabric.counts[PRESSED])
        for i in range(first, last):
            v = fabric.rows[i]
            for k in range(fabric.ring_start[v], fabric.ring_start[v + 1]):
                w = fabric.ring[k]
                if fabric.is_row[w] == 0:
                    fabric.is_row[w] = 1
                    fabric.rows[wp.atomic_add(fabric.counts, PRESSED, 1)] = w
        first = last
    n = int(fabric.counts[PRESSED])
    for sweep in range(sweeps):
        rise = wp.where(sweep < reach, 0.0, slope)
        for i in range(n):
            if sweep % 2 == 0:
                spread(fabric.rows[i], fabric, rise, fabric.room, fabric.spread)
            else:
                spread(fabric.rows[i], fabric, rise, fabric.spread, fabric.room)
    for i in range(n):
        v = fabric.rows[i]
        if sweeps % 2 == 0:
            lower(v, fabric, fabric.room)
        else:
            lower(v, fabric, fabric.spread)
    for i in range(n):
        v = fabric.rows[i]
        fabric.is_row[v] = 0
        fabric.room[v] = wp.inf
        fabric.spread[v] = wp.inf
