"""Winding numbers of points by the faces that lie straight before or behind them: one code for CPU and CUDA.

The points are listed by the cells of a grid over x and y, those of the front half apart from those of the back half.
A point in front looks along +z, one behind along -z, so that most see nothing. Which faces a line crosses is decided
in double precision, where differences of float32 are exact. Each edge gives both of its faces the same answer, so no
line slips between two faces, or crosses both.

On a CPU, where a launch costs as much as hundreds of points, one thread takes all steps (`only` is -1). On a GPU each
launch takes one step, number `only`, and each of its `stride` threads takes every `stride`-th item.
"""

import warp as wp

from refu_core.body._bundle_kernels import greater, lesser
from refu_core.sdf._crossing_kernels import double

# Contracted multiply-adds would round a x b and b x a differently.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})

CELLS = wp.constant(64)
"""Cells of the grid along x and along y."""
STEPS = 4
_ZERO = wp.constant(wp.float64(0.0))


@wp.struct
class Bins:
    """The points by cell: first those in front, then those behind."""

    first: wp.array[int]
    """The first point of each cell, -1 for none."""
    nearest: wp.array[float]
    """How near the points of each cell come to the middle plane [m]."""
    box: wp.array[wp.vec3]
    """The corners of the box around all points [m]."""


@wp.func
def cell_along(x: float, low: float, per_metre: float) -> int:
    cell = int((x - low) * per_metre)
    cell = wp.where(cell < CELLS, cell, CELLS - 1)
    return wp.where(cell > 0, cell, 0)


@wp.func
def turns(a: wp.vec3d, b: wp.vec3d) -> int:
    """1 if an edge from a to b passes the z axis at +x towards +y, -1 towards -y, else 0; each end counts once."""
    rises = a[1] <= _ZERO
    if rises == (b[1] <= _ZERO):
        return 0
    side = a[0] * b[1] - a[1] * b[0]
    if rises:
        return wp.where(side > _ZERO, 1, 0)
    return wp.where(side < _ZERO, -1, 0)


@wp.func
def crossing(a: wp.vec3, b: wp.vec3, c: wp.vec3, p: wp.vec3, half: int) -> int:
    """What a face adds to the winding number of p, which looks along +z, or along -z in the other half."""
    to_a = double(a) - double(p)
    normal = wp.cross(double(b) - double(a), double(c) - double(a))
    ahead = wp.dot(normal, to_a) * normal[2]
    if (half == 0 and ahead > _ZERO) or (half == 1 and ahead < _ZERO):
        to_b = double(b) - double(p)
        to_c = double(c) - double(p)
        passes = turns(to_a, to_b) + turns(to_b, to_c) + turns(to_c, to_a)
        return wp.where(half == 0, passes, -passes)
    return 0


@wp.func
def per_metre_of(box: wp.array[wp.vec3]) -> wp.vec3:
    """Cells per metre; a hair fewer than there are, so that the last point is in the last cell."""
    extent = box[1] - box[0]
    cells = wp.static(0.9999 * CELLS)
    return wp.vec3(
        cells / wp.max(extent[0], 1.0e-6), cells / wp.max(extent[1], 1.0e-6), cells / wp.max(extent[2], 1.0e-6)
    )


@wp.func
def enlist(q: int, points: wp.array[wp.vec3], following: wp.array[int], bins: Bins) -> None:
    """Lists a point by its cell."""
    p = points[q]
    low = bins.box[0]
    per_metre = per_metre_of(bins.box)
    ahead = p[2] - 0.5 * (low[2] + bins.box[1][2])
    cell = cell_along(p[1], low[1], per_metre[1]) * CELLS + cell_along(p[0], low[0], per_metre[0])
    if ahead < 0.0:
        cell += CELLS * CELLS
    following[q] = wp.atomic_exch(bins.first, cell, q)
    wp.atomic_min(bins.nearest, cell, wp.abs(ahead))


@wp.func
def look_through(
    begin: int,
    stride: int,
    body: wp.array[wp.vec3],
    faces: wp.array[wp.vec3i],
    points: wp.array[wp.vec3],
    following: wp.array[int],
    bins: Bins,
    winding: wp.array[int],
) -> None:
    """Each face adds itself to the winding numbers of the points that look through it."""
    low = bins.box[0]
    high = bins.box[1]
    per_metre = per_metre_of(bins.box)
    middle = 0.5 * (low[2] + high[2])
    for f in range(begin, faces.shape[0], stride):
        corners = faces[f]
        a = body[corners[0]]
        b = body[corners[1]]
        c = body[corners[2]]
        box_low = lesser(lesser(a, b), c)
        box_high = greater(greater(a, b), c)
        if box_low[1] <= high[1] and box_high[1] >= low[1] and box_low[0] <= high[0] and box_high[0] >= low[0]:
            front = box_high[2] - middle
            back = middle - box_low[2]
            i0 = cell_along(box_low[0], low[0], per_metre[0])
            i1 = cell_along(box_high[0], low[0], per_metre[0])
            j0 = cell_along(box_low[1], low[1], per_metre[1])
            j1 = cell_along(box_high[1], low[1], per_metre[1])
            for half in range(2):
                reach = wp.where(half == 0, front, back)
                if reach >= 0.0:
                    for j in range(j0, j1 + 1):
                        row = (half * CELLS + j) * CELLS
                        for cell in range(row + i0, row + i1 + 1):
                            if bins.nearest[cell] <= reach:
                                q = int(bins.first[cell])
                                while q >= 0:
                                    p = points[q]
                                    # Most points are ruled out by this test, and few by those after it.
                                    sees = wp.where(half == 0, p[2] <= box_high[2], p[2] >= box_low[2])
                                    along = p[0] >= box_low[0] and p[0] <= box_high[0]
                                    if sees and along and p[1] >= box_low[1] and p[1] <= box_high[1]:
                                        found = crossing(a, b, c, p, half)
                                        if found != 0:
                                            wp.atomic_add(winding, q, found)
                                    q = following[q]


@wp.kernel
def winding_kernel(
    only: int,
    stride: int,
    body: wp.array[wp.vec3],
    faces: wp.array[wp.vec3i],
    bins: Bins,
    wanted: wp.array[int],
    points: wp.array[wp.vec3],
    following: wp.array[int],
    # output, zeros before
    winding: wp.array[int],
) -> None:
    """The winding numbers of the points, in `STEPS` steps; nothing is done where `wanted` is 0."""
    if wanted[0] == 0:
        return
    begin = wp.tid()
    low = points[0]
    high = low
    if only < 0 or only == 0:
        for cell in range(begin, bins.first.shape[0], stride):
            bins.first[cell] = -1
            bins.nearest[cell] = wp.inf
        bins.box[0] = low
        bins.box[1] = high
    if only < 0 or only == 1:
        for q in range(begin, points.shape[0], stride):
            low = lesser(low, points[q])
            high = greater(high, points[q])
        wp.atomic_min(bins.box, 0, low)
        wp.atomic_max(bins.box, 1, high)
    if only < 0 or only == 2:
        for q in range(begin, points.shape[0], stride):
            enlist(q, points, following, bins)
    if only < 0 or only == 3:
        look_through(begin, stride, body, faces, points, following, bins, winding)
