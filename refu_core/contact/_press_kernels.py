"""What presses cloth to the skin that it lies on, vertex by vertex: one code for CPU and CUDA."""

import warp as wp

from refu_core.body._bundle_kernels import Bundles, greater, is_near, lesser

wp.set_module_options({"enable_backward": False})

WANTED = wp.constant(0)  # limbs that may be near some vertex, as bits
NEAR = wp.constant(1)  # vertices that some limb may be near
PRESSED = wp.constant(2)  # vertices that limbs draw back, and on a CPU also those that sweeps reach from them
N_COUNTS = 3


@wp.struct
class Feel:
    """The `ContactSettings` that the kernels read."""

    room: wp.float32
    beside: wp.float32
    lies: wp.float32


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
    """For each vertex in `near`, the limbs that may be near it, as bits."""
    near: wp.array[int]
    rows: wp.array[int]
    """On a CPU the vertices that are drawn back; a GPU goes through all."""
    cut: wp.array[float]
    spread: wp.array[float]
    """How far each vertex is drawn back [m], and the same a sweep later; on a CPU, a sweep before."""
    front: wp.array[int]
    """On a CPU the vertices drawn back farther in this sweep and in the last one, each in one half."""
    in_front: wp.array[int]
    """The last sweep that put a vertex into `front`, counted from 1."""
    counts: wp.array[int]


@wp.func
def beside(height: float, feel: Feel) -> float:
    """How far to the side of a limb cloth at this height feels it [m]."""
    return wp.min(feel.beside, 2.0 * height * height / feel.lies)


@wp.kernel
def look_kernel(fabric: Fabric, bundles: Bundles, feel: Feel) -> None:
    """Lists the vertices that may feel a limb, by boxes; one piece a thread."""
    i = wp.tid()
    first = fabric.start[i]
    last = fabric.start[i + 1]
    low = fabric.points[fabric.vertex[first]]
    high = low
    foreign = int(0)
    highest = float(0.0)
    for c in range(first, last):
        v = fabric.vertex[c]
        low = lesser(low, lesser(fabric.points[v], fabric.skin[v]))
        high = greater(high, greater(fabric.points[v], fabric.skin[v]))
        highest = wp.max(highest, wp.length(fabric.points[v] - fabric.skin[v]))
        foreign |= fabric.foreign[v]
    found = int(0)
    for k in range(bundles.group_low.shape[0]):
        if (foreign >> k) & 1 == 1 and is_near(low, high, k, beside(highest, feel), bundles):
            found |= 1 << k
    if found == 0:
        return
    wanted = int(0)
    for c in range(first, last):
        v = fabric.vertex[c]
        low = lesser(fabric.points[v], fabric.skin[v])
        high = greater(fabric.points[v], fabric.skin[v])
        height = wp.length(fabric.points[v] - fabric.skin[v])
        boxed = int(0)
        if height > feel.room and height < 2.0 * feel.lies:
            for k in range(bundles.group_low.shape[0]):
                if ((fabric.foreign[v] & found) >> k) & 1 == 1 and is_near(low, high, k, beside(height, feel), bundles):
                    boxed |= 1 << k
        if boxed != 0:
            wanted |= boxed
            fabric.boxed[v] = boxed
            fabric.near[wp.atomic_add(fabric.counts, NEAR, 1)] = v
    wp.atomic_or(fabric.counts, WANTED, wanted)


@wp.func
def press(v: int, fabric: Fabric, limbs: wp.array[wp.uint64], feel: Feel) -> None:
    """How far a vertex is drawn back to the skin that it lies on, to stay in front of a limb that comes in between.

    A limb within `beside` of the line from skin to vertex counts as in between, the less the farther to the side it is.
    The line is searched by ray marching: each step is as long as the limb is far away.
    """
    way = fabric.points[v] - fabric.skin[v]
    height = wp.length(way)
    whole = height + feel.room
    aside = beside(height, feel)
    least = float(whole)
    for k in range(limbs.shape[0]):
        if (fabric.boxed[v] >> k) & 1 == 1:
            at = float(0.0)
            while at < least:
                here = fabric.skin[v] + (at / height) * way
                off = aside * (least - at) / (whole - at)  # a limb farther off than this changes nothing
                hit = wp.mesh_query_point_no_sign(limbs[k], here, off)
                if hit.result:
                    off = wp.min(off, wp.length(wp.mesh_eval_position(limbs[k], hit.face, hit.u, hit.v) - here))
                    least = wp.min(least, at + (whole - at) * off / aside)
                at += wp.max(off, feel.room)
    if least < whole:
        # Cloth at the skin has nothing to give, and cloth far off doesn't lie on this skin.
        lies = wp.clamp(2.0 - height / feel.lies, 0.0, 1.0)
        lies *= wp.clamp(height / feel.room - 1.0, 0.0, 1.0)
        cut = lies * (height - wp.max(least - feel.room, 0.5 * least))
        if cut > 0.0:
            fabric.cut[v] = cut
            fabric.rows[wp.atomic_add(fabric.counts, PRESSED, 1)] = v


@wp.kernel
def spread_kernel(fabric: Fabric, slope: float, cut: wp.array[float], wider: wp.array[float]) -> None:
    """A vertex is drawn back as far as a neighbour, less `slope` times the way from there: a dent, not a tear."""
    v = wp.tid()
    most = cut[v]
    for k in range(fabric.ring_start[v], fabric.ring_start[v + 1]):
        w = fabric.ring[k]
        most = wp.max(most, cut[w] - slope * wp.length(fabric.points[v] - fabric.points[w]))
    wider[v] = most


@wp.func
def lower(v: int, fabric: Fabric, feel: Feel) -> None:
    """Draws a vertex back towards the skin, but no nearer than half the room, unless it was nearer before."""
    if fabric.cut[v] > 0.0:
        way = fabric.points[v] - fabric.skin[v]
        height = wp.length(way)
        left = wp.max(height - fabric.cut[v], wp.min(height, 0.5 * feel.room))
        fabric.points[v] = fabric.skin[v] + (left / wp.max(height, 1.0e-9)) * way


@wp.kernel
def press_kernel(fabric: Fabric, limbs: wp.array[wp.uint64], feel: Feel) -> None:
    """`press`, one vertex a thread."""
    i = wp.tid()
    if i < fabric.counts[NEAR]:
        press(fabric.near[i], fabric, limbs, feel)


@wp.kernel
def lower_kernel(fabric: Fabric, feel: Feel) -> None:
    """`lower`, one vertex a thread."""
    lower(wp.tid(), fabric, feel)


@wp.kernel
def press_all_kernel(fabric: Fabric, limbs: wp.array[wp.uint64], feel: Feel, sweeps: int, reach: int) -> None:
    """All steps after `look_kernel`, by one thread; a sweep goes on from vertices the last one drew back farther."""
    for i in range(fabric.counts[NEAR]):
        press(fabric.near[i], fabric, limbs, feel)
    n_front = int(fabric.counts[PRESSED])
    for i in range(n_front):
        fabric.front[i] = fabric.rows[i]
    first = int(0)
    for sweep in range(sweeps):
        rise = wp.where(sweep < reach, 0.0, 1.0)
        for i in range(n_front):
            v = fabric.front[first + i]
            fabric.spread[v] = fabric.cut[v]
        after = fabric.cut.shape[0] - first  # where the other half begins
        n_next = int(0)
        for i in range(n_front):
            v = fabric.front[first + i]
            for k in range(fabric.ring_start[v], fabric.ring_start[v + 1]):
                w = fabric.ring[k]
                cut = fabric.spread[v] - rise * wp.length(fabric.points[w] - fabric.points[v])
                if cut > fabric.cut[w]:
                    if fabric.cut[w] == 0.0:
                        fabric.rows[wp.atomic_add(fabric.counts, PRESSED, 1)] = w
                    fabric.cut[w] = cut
                    if fabric.in_front[w] != sweep + 1:
                        fabric.in_front[w] = sweep + 1
                        fabric.front[after + n_next] = w
                        n_next += 1
        first = after
        n_front = n_next
    for i in range(fabric.counts[PRESSED]):
        lower(fabric.rows[i], fabric, feel)
    for i in range(fabric.counts[PRESSED]):
        v = fabric.rows[i]
        fabric.in_front[v] = 0
        fabric.cut[v] = 0.0
