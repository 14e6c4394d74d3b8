"""What the steps of a `Resolver` read and write: a garment, a frame of it, and numbers.

Kernels fill lists of vertices, and `counts[NAME]` is the length of each. On a CPU a list is in order, on a GPU in any
order; nothing depends on it. On a CPU one thread goes through a list. To know the length of a list, a GPU would have to
be waited for. So its launches have as many threads as the list may have entries, and those beyond its end do nothing.
"""

import warp as wp

# What a kernel counts.
NEAR = wp.constant(0)  # vertices nearer than the margin, which are pushed
REACHED = wp.constant(1)  # vertices that are pushed, or that a push reaches through neighbours
SUSPECTS = wp.constant(2)  # vertices at the ends of edges along which distances contradict each other
RAISED = wp.constant(3)  # ends of edges that cut the skin
CHANGED = wp.constant(4)  # distances that were replaced
SHIFTED = wp.constant(5)  # vertices that were moved since the last call
ASTRAY = wp.constant(6)  # vertices that aren't anywhere near
CUTTING = wp.constant(7)  # edges that may cut the skin; the counts of `max_pushes` rounds follow

# Marks of a vertex: reached by a push, or pushed itself.
BESIDE = wp.constant(1)
SOURCE = wp.constant(2)


@wp.struct
class Cloth:
    """The part of a garment that doesn't change."""

    ring_start: wp.array[wp.int32]
    ring: wp.array[wp.int32]
    """The neighbours of vertex i are `ring[ring_start[i]:ring_start[i + 1]]`."""
    edges: wp.array2d[wp.int32]
    """Each edge once, lower vertex first; those whose lower vertex is i begin at `edge_start[i]`."""
    edge_start: wp.array[wp.int32]


@wp.struct
class Rules:
    """The margin and what the kernels read of `ContactSettings`."""

    margin: wp.float32
    tolerance: wp.float32
    max_displacement: wp.float32
    max_pushes: wp.int32
    gap: wp.float32


@wp.struct
class State:
    """A garment in one frame, by vertex; lengths in metres."""

    origin: wp.array[wp.vec3]
    """Where each vertex was before. The `first` distance, gradient and face are those there."""
    first: wp.array[wp.float32]
    first_gradient: wp.array[wp.vec3]
    first_face: wp.array[wp.int32]
    place: wp.array[wp.vec3]
    """The best place so far. The distance, gradient and face that follow are those there."""
    distance: wp.array[wp.float32]
    gradient: wp.array[wp.vec3]
    face: wp.array[wp.int32]
    way: wp.array[wp.float32]
    """How far a vertex has to go along the gradient."""
    goal: wp.array[wp.float32]
    """The distance from the skin that this leads to."""
    mark: wp.array[wp.int32]
    fresh: wp.array[wp.int32]
    """Whether a vertex isn't where the last call left it. The others are as far off the skin as they can be."""
    counts: wp.array[wp.int32]
    begins: wp.array[wp.int32]
    ends: wp.array[wp.int32]
    """On a GPU, the part of each list that launches go through; `_round_kernels.close_kernel` sets it."""
    near: wp.array[wp.int32]
    reached: wp.array[wp.int32]
    """The lists; `reached` also holds the suspects before a push, and the raised ends of edges after it."""
    alpha: wp.array[wp.float32]
    """The scale α of each vertex in `near`; before that the distance that it is predicted from."""
    field: wp.array[wp.vec3]
    smoother: wp.array[wp.vec3]
    """How far vertices are taken along, and the same a sweep later; zero between frames."""
    moved: wp.array[wp.int32]
    """Whether the end of an edge was raised in the last round."""
    suspects: wp.array[wp.int32]
    deficit: wp.array[wp.float32]
    rise: wp.array[wp.vec3]
    """Edges that may run too low; for those that do, how much they lack, and the way up."""
    largest: wp.array[wp.float32]
    """The largest deficit of the edges at each vertex."""


@wp.func
def length(which: int, state: State) -> int:
    """The length of a list; on a GPU, when it was closed."""
    return wp.min(state.ends[which], state.counts[which])


@wp.func
def listed(k: int, which: int, rows: wp.array[int], state: State) -> int:
    """Entry k of a list, -1 beyond its end."""
    if k < state.ends[which]:
        return rows[k]
    return -1


@wp.func
def bounded(moved: wp.vec3, origin: wp.vec3, most: float) -> wp.vec3:
    """`moved`, drawn back to within `most` of where the vertex began."""
    way = moved - origin
    return origin + way * wp.min(1.0, most / wp.max(wp.length(way), 1.0e-12))


@wp.func
def keep(i: int, place: wp.vec3, distance: float, gradient: wp.vec3, face: int, state: State) -> None:
    state.place[i] = place
    state.distance[i] = distance
    state.gradient[i] = gradient
    state.face[i] = face
