"""Kernels that pull a posed body apart when no derivative is needed: memory, creases and levelling, vertex by vertex.

A set of segments is stored as the bits of an integer. `touched` holds the segments that a vertex has to give way to.
"""

import math
from typing import TYPE_CHECKING

import warp as wp

from refu_core import _warp  # noqa: F401  (quiets Warp before it starts)
from refu_core.body._creases import LEVELS, N_STATIONS

wp.set_module_options({"enable_backward": False})

N_LEVELS = len(LEVELS)
STRAIGHT = wp.constant(math.cos(0.05))
"""Cosine of half the angle up to which a joint folds no skin: 0.1 rad."""
BENT = wp.constant(math.cos(0.15))
"""The same for 0.3 rad, from which on the joint's seams hold in full."""
if TYPE_CHECKING:
    Stations = wp.Vector[int]
    StationWeights = wp.Vector[float]
else:
    Stations = wp.types.vector(length=N_STATIONS, dtype=wp.int32)
    StationWeights = wp.types.vector(length=N_STATIONS, dtype=wp.float32)

_VISIBLE = wp.constant(1.0e-4)
"""Skin that was moved by more than this counts as moved [m]."""


@wp.kernel
def shift_kernel(
    most_aside: float,
    most_way: wp.array[float],
    skin: wp.array2d[wp.vec3],
    aside: wp.array2d[wp.vec3],
    apart: wp.array2d[wp.vec3],
    each: wp.array[int],
    # output
    numbers: wp.array2d[float],
) -> None:
    """Computes `Collider.shift`, `each` vertices per thread; `numbers` must be zero before."""
    b, strip = wp.tid()
    n_moved = float(0.0)
    largest = float(0.0)
    total = float(0.0)
    n_held = float(0.0)
    n = skin.shape[1]
    for v in range(strip * each[0], wp.min((strip + 1) * each[0], n)):
        way = wp.length(apart[b, v] - skin[b, v])
        total += way
        largest = wp.max(largest, way)
        n_moved += wp.where(way > _VISIBLE, 1.0, 0.0)
        is_held = wp.length(skin[b, v] - aside[b, v]) > most_aside or wp.length(apart[b, v] - aside[b, v]) > most_way[v]
        n_held += wp.where(is_held, 1.0, 0.0)
    wp.atomic_add(numbers, b, 0, n_moved)
    wp.atomic_max(numbers, b, 1, largest)
    wp.atomic_add(numbers, b, 2, total / float(n))
    wp.atomic_add(numbers, b, 3, n_held)


@wp.struct
class Bones:
    """A posed body's joints, and how skin hangs on them."""

    rotation: wp.array[wp.mat33]
    """Rotation of each joint."""
    between: wp.array[wp.mat33]
    """Rotation of each of a joint's seams, between the parent's rotation and the joint's."""
    bent: wp.array[float]
    """How much each joint's seams hold: not at all where it is straight."""
    start: wp.array[int]
    joint: wp.array[int]
    weight: wp.array[float]
    normal: wp.array[wp.vec3]
    """Normals of the skin in the rest pose, smoothed."""
    parent: wp.array[int]
    levels: wp.array[float]
    """Levels of the seams of a joint."""


@wp.struct
class Seams:
    """The rows of `Creases`; those of `vertex[i]` begin at `start[i]`."""

    vertex: wp.array[int]
    start: wp.array[int]
    rotation: wp.array[int]
    normal: wp.array[wp.vec3]
    least: wp.array[float]
    """Height over the plane that skin keeps [m]."""
    stations: wp.array[Stations]
    weights: wp.array[StationWeights]


@wp.struct
class Means:
    """Points that are weighted means of others; the rows of mean i begin at `start[i]`."""

    start: wp.array[int]
    vertex: wp.array[int]
    weight: wp.array[float]
    mean: wp.array[wp.vec3]


@wp.struct
class Work:
    """The memory that a call works in; `counts` holds the lengths of the lists."""

    skin: wp.array[wp.vec3]
    points: wp.array[wp.vec3]
    """Skin without creases, then the middles of caps."""
    here: wp.array[wp.vec3]
    there: wp.array[wp.vec3]
    """The two buffers that sweeps alternate between."""
    farthest: wp.array[float]
    """How far skin may be moved [m]."""
    around: wp.array[float]
    """How far each vertex of `moved`, or a neighbour of it, was moved before it is levelled [m]."""
    moved: wp.array[int]
    """Vertices that were moved, and their neighbours: those that are levelled."""
    near: wp.array[int]
    """Vertices that may be within the gap of another segment, by its boxes."""
    boxed: wp.array[int]
    """Those segments, for each vertex of `near`."""
    touching: wp.array[int]
    """Vertices with segments in `touched`."""
    front: wp.array2d[int]
    """Vertices that got new segments in `touched`: at first, then in each round that looks deeper."""
    hot: wp.array[int]
    """Edges with an end in `touching`."""
    ends: wp.array[int]
    """Vertices of those edges."""
    is_moved: wp.array[int]
    is_end: wp.array[int]
    """1 for a vertex in `ends`; once it was moved with its edges, 2 plus the last round in which it was."""
    is_front: wp.array[int]
    """The last round in whose front a vertex was, counted from 1."""
    touched: wp.array[int]
    outside: wp.array[int]
    parted: wp.array[wp.vec3]
    """Where each vertex in `touching` was moved to by giving way to segments, before it was levelled."""
    reach: wp.array[float]
    """Upper bound of the distance from there to the surfaces of those segments [m]."""
    steps: wp.array[wp.vec3]
    """The step of each edge."""
    counts: wp.array[int]
    """Lengths of `moved`, `near`, `touching`, `hot` and `ends`; as bits, the segments whose distances are needed and
    the joints that are bent; the length of each row of `front`."""


MOVED = wp.constant(0)
NEAR = wp.constant(1)
TOUCHING = wp.constant(2)
HOT = wp.constant(3)
ENDS = wp.constant(4)
WANTED = wp.constant(5)
BENT_JOINTS = wp.constant(6)
FRONT = wp.constant(7)


@wp.struct
class Rings:
    """The neighbours of each vertex, and the edges of the mesh."""

    start: wp.array[int]
    vertex: wp.array[int]
    edge: wp.array[int]
    """The edge to each neighbour."""
    ends: wp.array[wp.vec2i]


@wp.kernel
def between_kernel(work: Work, bones: Bones) -> None:
    """Finds the rotations between each joint's parent and the joint, one per seam, and which joints are bent."""
    j = wp.tid()
    above = bones.rotation[bones.parent[j]]
    turn = wp.transpose(above) @ bones.rotation[j]
    w = 0.5 * wp.sqrt(wp.max(1.0 + wp.trace(turn), 1.0e-6))
    axis = wp.vec3(turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]) / (4.0 * w)
    bones.bent[j] = wp.clamp((STRAIGHT - w) / (STRAIGHT - BENT), 0.0, 1.0)
    if bones.bent[j] > 0.0:
        wp.atomic_or(work.counts, BENT_JOINTS, 1 << j)
    for i in range(bones.levels.shape[0]):
        t = bones.levels[i]
        q = wp.normalize(wp.quat(t * axis[0], t * axis[1], t * axis[2], t * w + 1.0 - t))
        bones.between[j * bones.levels.shape[0] + i] = above @ wp.quat_to_matrix(q)


@wp.func
def find_mean(i: int, points: wp.array[wp.vec3], means: Means) -> None:
    total = wp.vec3()
    for k in range(means.start[i], means.start[i + 1]):
        total += means.weight[k] * points[means.vertex[k]]
    means.mean[i] = total


@wp.kernel
def mean_kernel(points: wp.array[wp.vec3], means: Means) -> None:
    find_mean(wp.tid(), points, means)


@wp.func
def within(p: wp.vec3, skin: wp.vec3, farthest: float) -> wp.vec3:
    """p, pulled back to within `farthest` [m] of the skin."""
    away = wp.length(p - skin)
    if away > farthest:
        return skin + farthest / away * (p - skin)
    return p


@wp.func
def add(v: int, work: Work) -> None:
    """Adds a vertex to `moved`, once."""
    if wp.atomic_max(work.is_moved, v, 1) == 0:
        work.moved[wp.atomic_add(work.counts, MOVED, 1)] = v


@wp.func
def enlist(v: int, work: Work, rings: Rings) -> None:
    """Adds a vertex that was moved, and the skin next to it: left as it is, that would stand as a ridge."""
    add(v, work)
    for k in range(rings.start[v], rings.start[v + 1]):
        add(rings.vertex[k], work)


@wp.func
def hold(
    i: int, work: Work, stations: wp.array[wp.vec3], bones: Bones, seams: Seams, rings: Rings, rounds: int
) -> None:
    """Brings skin back to its own side of the nearby seams, above all of those that it is farthest beyond."""
    v = seams.vertex[i]
    p = work.skin[v]
    is_held = int(0)
    for _ in range(rounds):
        total = float(0.0)
        step = wp.vec3()
        for r in range(seams.start[i], seams.start[i + 1]):
            rotation = seams.rotation[r]
            bent = bones.bent[rotation // wp.static(N_LEVELS)]
            if bent > 0.0:
                through = wp.vec3()
                which = seams.stations[r]
                weights = seams.weights[r]
                for k in range(wp.static(N_STATIONS)):
                    through += weights[k] * stations[which[k]]
                normal = bones.between[rotation] @ seams.normal[r]
                lacks = bent * (seams.least[r] - wp.dot(p - through, normal))
                if lacks > 0.0:
                    step += lacks * lacks * lacks * normal
                    total += lacks * lacks
        if total == 0.0:
            break
        p += step / total
        is_held = 1
    if is_held == 1:
        p = within(p, work.skin[v], work.farthest[v])
        work.here[v] = p
        work.there[v] = p
        enlist(v, work, rings)


@wp.func
def look_around(v: int, work: Work, rings: Rings) -> None:
    """Finds how far a vertex or a neighbour of it was moved."""
    way = wp.length(work.here[v] - work.skin[v])
    for k in range(rings.start[v], rings.start[v + 1]):
        w = rings.vertex[k]
        way = wp.max(way, wp.length(work.here[w] - work.skin[w]))
    work.around[v] = wp.min(way, work.farthest[v])


@wp.func
def level(
    v: int, full: float, step: float, work: Work, rings: Rings, source: wp.array[wp.vec3], target: wp.array[wp.vec3]
) -> None:
    """Levels a vertex: it goes towards the mean of its neighbours, by `step` where one was moved by `full` [m].

    By that it gets no farther from the skin than what is around it.
    """
    around = work.around[v]
    total = wp.vec3()
    for k in range(rings.start[v], rings.start[v + 1]):
        total += source[rings.vertex[k]]
    mean = total / float(rings.start[v + 1] - rings.start[v])
    share = step * wp.min(around / full, 1.0)
    target[v] = within(source[v] + share * (mean - source[v]), work.skin[v], around)


@wp.func
def settle(v: int, sweeps: int, work: Work) -> None:
    """Makes the result of that many sweeps the input of all that follows."""
    p = work.here[v]
    if sweeps % 2 == 1:
        p = work.there[v]
    work.points[v] = p
    work.here[v] = p
    work.there[v] = p
