"""Winding numbers of points by the faces that lie straight before or behind them: one code for CPU and CUDA.

The points are listed by the cells of a grid over x and y, those of the front half apart from those of the back half.
A point in front looks along +z, one behind along -z, so that most see nothing. Which faces a line crosses is decided
in double precision, where differences of float32 are exact. Each edge gives both of its faces the same answer, so no
line slips between two faces, or crosses both.
"""

import warp as wp

from refu_core.body._bundle_kernels import greater, lesser
from refu_core.sdf._crossing_kernels import double

# Contracted multiply-adds would round a x b and b x a differently.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})

CELLS = wp.constant(64)
"""Cells of the grid along x and along y."""
_ZERO = wp.constant(wp.float64(0.0))


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
def per_metre_of(grid: wp.array[wp.vec3]) -> wp.vec3:
    """Cells per metre; a hair fewer than there are, so that the last point is in the last cell."""
    extent = grid[1] - grid[0]
    cells = wp.static(0.9999 * CELLS)
    return wp.vec3(
        cells / wp.max(extent[0], 1.0e-6), cells / wp.max(extent[1], 1.0e-6), cells / wp.max(extent[2], 1.0e-6)
    )


@wp.kernel
def extent_kernel(
    wanted: wp.array[int],
    each: wp.array[int],
    points: wp.array[wp.vec3],
    # output, which is infinite before
    grid: wp.array[wp.vec3],
) -> None:
    """The corners of the box around the points. Like all of these kernels it does nothing where `wanted` is 0."""
    if wanted[0] == 0:
        return
    begin = wp.tid() * each[0]
    low = points[begin]
    high = low
    for q in range(begin + 1, wp.min(begin + each[0], points.shape[0])):
        low = lesser(low, points[q])
        high = greater(high, points[q])
    wp.atomic_min(grid, 0, low)
    wp.atomic_max(grid, 1, high)


@wp.kernel
def bin_kernel(
    wanted: wp.array[int],
    points: wp.array[wp.vec3],
    grid: wp.array[wp.vec3],
    # outputs
    first: wp.array[int],
    following: wp.array[int],
    farthest_in: wp.array[float],
) -> None:
    """Lists the points by cell; `farthest_in` is the least distance of a cell's points from the middle plane."""
    if wanted[0] == 0:
        return
    q = wp.tid()
    p = points[q]
    per_metre = per_metre_of(grid)
    ahead = p[2] - 0.5 * (grid[0][2] + grid[1][2])
    cell = cell_along(p[1], grid[0][1], per_metre[1]) * CELLS + cell_along(p[0], grid[0][0], per_metre[0])
    if ahead < 0.0:
        cell += CELLS * CELLS
    following[q] = wp.atomic_exch(first, cell, q)
    wp.atomic_min(farthest_in, cell, wp.abs(ahead))


@wp.kernel
def crossings_kernel(
    each: int,
    body: wp.array[wp.vec3],
    faces: wp.array[wp.vec3i],
    wanted: wp.array[int],
    points: wp.array[wp.vec3],
    grid: wp.array[wp.vec3],
    first: wp.array[int],
    following: wp.array[int],
    farthest_in: wp.array[float],
    # output
    winding: wp.array[int],
) -> None:
    """Each face adds itself to the winding numbers of the points that look through it; `each` faces a thread."""
    if wanted[0] == 0:
        return
    low = grid[0]
    high = grid[1]
    per_metre = per_metre_of(grid)
    middle = 0.5 * (low[2] + high[2])
    begin = wp.tid() * each
    for f in range(begin, wp.min(begin + each, faces.shape[0])):
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
                            if farthest_in[cell] <= reach:
                                q = int(first[cell])
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
