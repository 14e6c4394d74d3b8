"""Closest faces within a band of the skin: the points lie in cells, the faces look for them there. For one CPU core.

The grid repeats itself after 128 × 64 × 64 cells, so no place is outside it and no size depends on the pose. Two
places that share a cell cost a test and change no answer. Cells are kept in rows along y, and one word says which of a
row's 64 cells hold a point: most of what a face passes is empty, and is passed a row at a time. The points are sorted
by row and cell, so what a face sees of a row is read in one go.
"""

import warp as wp

from refu_core.body._bundle_kernels import greater, lesser
from refu_core.sdf._closest_kernels import PosedMesh, closest_on_triangle, measured_to

wp.set_module_options({"enable_backward": False})

ROWS_X = wp.constant(128)
ROWS_Z = wp.constant(64)
ROW = wp.constant(64)
_LAST_X = wp.constant(127)
_LAST_Z = wp.constant(63)
_LAST = wp.constant(63)

NEAR = wp.constant(0)  # closest face within the band: distance and side are known
JOINED = wp.constant(1)  # the same, and its piece has been seen
ASKED = wp.constant(2)  # may be inside: must be asked
OUTSIDE = wp.constant(3)  # of a large piece with vertices of the band, which are outside
UNREACHED = wp.constant(4)  # 4 + number of its patch
_SMALL = wp.constant(256)
"""A piece of up to this many vertices isn't trusted. The outside of a worn garment is connected, or nearly."""

_MOST_CELLS = wp.constant(1.0e9)  # farther from the origin a cell's number would overflow, so it is clamped


@wp.func
def cell_number(x: float, per_metre: float) -> int:
    cell = x * per_metre
    cell = wp.where(cell < _MOST_CELLS, cell, _MOST_CELLS)
    return int(wp.floor(wp.where(cell > -_MOST_CELLS, cell, -_MOST_CELLS)))


@wp.func
def row_of(i: int, j: int) -> int:
    return (i & _LAST_X) * ROWS_Z + (j & _LAST_Z)


@wp.func
def row_mask(first: int, last: int) -> wp.uint64:
    """The bits of cells `first` to `last` in a row that repeats itself."""
    if last - first >= _LAST:
        return ~wp.uint64(0)
    bits = (wp.uint64(1) << wp.uint64(last - first + 1)) - wp.uint64(1)
    shift = wp.uint64(first & _LAST)
    if shift == wp.uint64(0):
        return bits
    return (bits << shift) | (bits >> (wp.uint64(ROW) - shift))


@wp.struct
class Cells:
    """Points in the cells of the grid, and what is closest to each so far."""

    limit: wp.float32
    """Distance [m] beyond which no face is close."""
    per_metre: wp.float32
    number_of_row: wp.array[wp.int32]
    rows: wp.array[wp.int32]
    occupied: wp.array[wp.uint64]
    start: wp.array2d[wp.int32]
    """Cell k of the row numbered r holds the sorted points `start[r, k]` to `start[r, k + 1]`."""
    extent: wp.array[wp.vec3]
    """Least and greatest coordinates of the points."""
    slot: wp.array[wp.int32]
    """Where point q lies among those sorted."""
    points: wp.array[wp.vec3]
    squared: wp.array[wp.float32]
    face: wp.array[wp.int32]
    """Sorted points, the squared distance of the closest face, and that face, or -1."""


@wp.kernel
def sort_kernel(cells: Cells, points: wp.array[wp.vec3], sizes: wp.array[int]) -> None:
    """Sorts the first `sizes[0]` points into cells, replacing the last ones; `sizes[1]` becomes the number of rows."""
    for r in range(sizes[1]):
        cells.number_of_row[cells.rows[r]] = -1
    n = sizes[0]
    n_rows = int(0)
    low = points[0]
    high = points[0]
    for q in range(n):
        p = points[q]
        low = lesser(low, p)
        high = greater(high, p)
        row = row_of(cell_number(p[0], cells.per_metre), cell_number(p[2], cells.per_metre))
        r = cells.number_of_row[row]
        if r < 0:
            r = n_rows
            n_rows += 1
            cells.number_of_row[row] = r
            cells.rows[r] = row
            cells.occupied[r] = wp.uint64(0)
            for k in range(ROW + 2):
                cells.start[r, k] = 0
        cell = cell_number(p[1], cells.per_metre) & _LAST
        cells.occupied[r] = cells.occupied[r] | (wp.uint64(1) << wp.uint64(cell))
        cells.start[r, cell + 2] = cells.start[r, cell + 2] + 1
        cells.slot[q] = r * ROW + cell
    sizes[1] = n_rows
    before = int(0)
    for r in range(n_rows):
        for k in range(ROW + 2):
            before += cells.start[r, k]
            cells.start[r, k] = before
    # Now cell k begins at start[r, k + 1], which is counted up to where it ends, and so to where cell k + 1 begins.
    for q in range(n):
        r = cells.slot[q] // ROW
        cell = cells.slot[q] & _LAST
        s = cells.start[r, cell + 1]
        cells.start[r, cell + 1] = s + 1
        cells.slot[q] = s
        cells.points[s] = points[q]
        cells.squared[s] = cells.limit * cells.limit
        cells.face[s] = -1
    cells.extent[0] = low
    cells.extent[1] = high


@wp.func
def beyond(x: float, low: float, high: float) -> float:
    """How far x is outside an interval; without the check for NaN that wp.max makes."""
    under = low - x
    over = x - high
    most = wp.where(under > over, under, over)
    return wp.where(most > 0.0, most, 0.0)


@wp.kernel
def scan_kernel(mesh: PosedMesh, cells: Cells) -> None:
    """Each face asks the sorted points in the cells around it whether it is the closest one so far."""
    f = wp.tid()
    a = mesh.points[mesh.faces[f, 0]]
    b = mesh.points[mesh.faces[f, 1]]
    c = mesh.points[mesh.faces[f, 2]]
    wide = cells.limit * 1.0001  # a hair more, for rounding
    reach = wp.vec3(wide, wide, wide)
    box_low = lesser(lesser(a, b), c)
    box_high = greater(greater(a, b), c)
    low = greater(box_low - reach, cells.extent[0])
    high = lesser(box_high + reach, cells.extent[1])
    if low[0] > high[0] or low[1] > high[1] or low[2] > high[2]:
        return
    i0 = cell_number(low[0], cells.per_metre)
    j0 = cell_number(low[2], cells.per_metre)
    k0 = cell_number(low[1], cells.per_metre)
    # Once around the grid is enough, however large the face.
    i1 = wp.min(cell_number(high[0], cells.per_metre), i0 + _LAST_X)
    j1 = wp.min(cell_number(high[2], cells.per_metre), j0 + _LAST_Z)
    k1 = wp.min(cell_number(high[1], cells.per_metre), k0 + _LAST)
    mask = row_mask(k0, k1)
    first_cell = k0 & _LAST
    last_cell = first_cell + (k1 - k0)
    normal = wp.normalize(wp.cross(b - a, c - a))
    for i in range(i0, i1 + 1):
        for j in range(j0, j1 + 1):
            r = cells.number_of_row[row_of(i, j)]
            if r >= 0 and (cells.occupied[r] & mask) != wp.uint64(0):
                here = cells.start[r, first_cell]
                end = cells.start[r, wp.min(last_cell, _LAST) + 1]
                rest = int(0)  # points at the row's beginning, as it repeats itself
                if last_cell > _LAST:
                    rest = cells.start[r, last_cell - _LAST] - cells.start[r, 0]
                while here < end or rest > 0:
                    if here == end:
                        here = cells.start[r, 0]
                        end = here + rest
                        rest = 0
                    p = cells.points[here]
                    height = wp.dot(normal, p - a)
                    x = beyond(p[0], box_low[0], box_high[0])
                    y = beyond(p[1], box_low[1], box_high[1])
                    z = beyond(p[2], box_low[2], box_high[2])
                    beside = x * x + y * y + z * z
                    above = height * height
                    # A face is never nearer than its plane or its box.
                    if wp.where(above > beside, above, beside) < cells.squared[here]:
                        w, _feature = closest_on_triangle(p, a, b, c)
                        offset = (p - a) - (w[1] * (b - a) + w[2] * (c - a))
                        length = wp.dot(offset, offset)
                        if length < cells.squared[here]:
                            cells.squared[here] = length
                            cells.face[here] = f
                    here += 1


@wp.kernel
def finish_kernel(
    mesh: PosedMesh,
    cells: Cells,
    points: wp.array[wp.vec3],
    beyond: wp.array[float],
    # outputs
    out_face: wp.array[int],
    out_distance: wp.array[float],
    out_gradient: wp.array[wp.vec3],
) -> None:
    """Signed distance and gradient from the closest faces; where there is none, only the distance `beyond`."""
    q = wp.tid()
    f = cells.face[cells.slot[q]]
    out_face[q] = f
    if f < 0:
        out_distance[q] = beyond[0]
        out_gradient[q] = wp.vec3(0.0, 1.0, 0.0)
        return
    distance, gradient = measured_to(points[q], f, mesh)
    out_distance[q] = distance
    out_gradient[q] = gradient


@wp.func
def is_free(p: wp.vec3, q: wp.vec3, distances: float) -> bool:
    """Whether no skin can lie between two points whose distances to it add up to `distances`."""
    # The balls around them hold no skin, and they overlap; less a hair for rounding.
    way = q - p
    return wp.dot(way, way) < distances * distances * 0.9999


@wp.kernel
def spread_sides_kernel(
    points: wp.array[wp.vec3],
    sizes: wp.array[int],
    link_start: wp.array[int],
    linked: wp.array[int],
    distance: wp.array[float],
    # kept up to date
    face: wp.array[int],
    # outputs
    state: wp.array[int],
    queue: wp.array[int],
    patch: wp.array[int],
) -> None:
    """On which side of the skin the vertices beyond the band are, by way of the garment's edges.

    `patch` lists one vertex of each large patch that no vertex of the band reaches, `sizes[2]` in all. Vertices beyond
    the band have the band as their distance.
    """
    n = sizes[0]
    tail = int(0)
    for q in range(n):
        state[q] = -1
        if face[q] >= 0:
            state[q] = NEAR
            if distance[q] < 0.0:
                state[q] = JOINED
                queue[tail] = q
                tail += 1
    # From the inside first: what both sides reach lies where the body runs into itself, and is asked.
    here = int(0)
    while here < tail:
        q = queue[here]
        here += 1
        for m in range(link_start[q], link_start[q + 1]):
            other = linked[m]
            if state[other] < 0 and is_free(points[q], points[other], wp.abs(distance[q]) + distance[other]):
                state[other] = ASKED
                face[other] = face[q]  # a face to begin from: it isn't far
                queue[tail] = other
                tail += 1
    # The rest forms connected pieces.
    patches = int(0)
    for seed in range(n):
        if state[seed] < 0:
            state[seed] = UNREACHED + patches
            queue[0] = seed
            here = int(0)
            tail = int(1)
            in_band = int(0)
            while here < tail:
                q = queue[here]
                here += 1
                for m in range(link_start[q], link_start[q + 1]):
                    other = linked[m]
                    if state[other] <= 0 and is_free(points[q], points[other], distance[q] + distance[other]):
                        if state[other] == NEAR:
                            state[other] = JOINED
                            in_band += 1
                        else:
                            state[other] = UNREACHED + patches
                        queue[tail] = other
                        tail += 1
            if tail <= _SMALL:
                for k in range(tail):
                    q = queue[k]
                    if state[q] != JOINED:
                        state[q] = ASKED
            elif in_band > 0:
                for k in range(tail):
                    q = queue[k]
                    if state[q] != JOINED:
                        state[q] = OUTSIDE
            else:
                patch[patches] = seed
                patches += 1
    sizes[2] = patches
