"""Closest face by boxes of eight: a tree for one CPU core and points that know a face near by.

A node has eight children, and their boxes lie together by coordinate, so that a processor looks at all eight at once.
Node b has the children 8 b + 1 to 8 b + 8, faces come after the last node: no links are stored, and none followed.
"""

from typing import TYPE_CHECKING

import warp as wp

from refu_core.sdf._closest_kernels import PosedMesh, closest_on_face, closest_on_triangle

WIDTH = wp.constant(8)
_FAR = wp.constant(1.0e36)  # [m²]
_LAST = wp.constant(63)
_FEW = wp.constant(12)
"""While no more nodes than this wait, the oldest is next, else the newest. Twelve and six levels of seven more fit."""
MAX_FACES = 8**6

if TYPE_CHECKING:
    Eight = wp.Vector[float]
    _Queue = wp.Vector[int]
else:
    Eight = wp.types.vector(length=8, dtype=wp.float32)
    _Queue = wp.types.vector(length=64, dtype=wp.int32)


@wp.struct
class Boxes:
    """A tree of boxes around the faces of a posed body."""

    bounds: wp.array2d[Eight]
    """Of each node's children: least x, y, z, greatest x, y, z [m]; where there is no child, the box is empty."""
    order: wp.array[wp.int32]
    """Faces in their order after the last node; empty where there is no tree."""
    first: wp.int32
    """Number of the first face."""


@wp.func
def least(a: float, b: float, c: float) -> float:
    """The least of three, without the check for NaN that wp.min makes."""
    lower = wp.where(b < a, b, a)
    return wp.where(c < lower, c, lower)


@wp.func
def least_of(eight: Eight) -> float:
    return least(
        least(eight[0], eight[1], eight[2]),
        least(eight[3], eight[4], eight[5]),
        wp.where(eight[7] < eight[6], eight[7], eight[6]),
    )


@wp.kernel(enable_backward=False)
def fit_kernel(
    faces: wp.array2d[int],
    boxes: Boxes,
    points: wp.array[wp.vec3],
    # output
    bounds: wp.array3d[float],
) -> None:
    """Fits the boxes to a pose, from the faces to the root; `bounds` are those of `boxes`, number by number."""
    n = boxes.order.shape[0]
    last = (boxes.first + n - 2) // WIDTH
    n_above = (boxes.first - 1) // WIDTH
    for back in range(last + 1):
        node = last - back
        if node >= n_above:
            for k in range(8):
                place = WIDTH * (node - n_above) + k
                if place < n:
                    face = boxes.order[place]
                    a = points[faces[face, 0]]
                    b = points[faces[face, 1]]
                    c = points[faces[face, 2]]
                    for axis in range(3):
                        bounds[node, axis, k] = least(a[axis], b[axis], c[axis])
                        bounds[node, axis + 3, k] = -least(-a[axis], -b[axis], -c[axis])
        if node > 0:
            above = (node - 1) // WIDTH
            child = (node - 1) & 7
            for axis in range(3):
                bounds[above, axis, child] = least_of(boxes.bounds[node, axis])
                bounds[above, axis + 3, child] = -least_of(-boxes.bounds[node, axis + 3])


@wp.func
def squared_gaps(p: wp.vec3, node: int, boxes: Boxes) -> Eight:
    """Squared distance from p to the boxes of a node's children."""
    x = Eight(p[0])
    y = Eight(p[1])
    z = Eight(p[2])
    none = Eight()
    along_x = wp.max(wp.max(boxes.bounds[node, 0] - x, x - boxes.bounds[node, 3]), none)
    along_y = wp.max(wp.max(boxes.bounds[node, 1] - y, y - boxes.bounds[node, 4]), none)
    along_z = wp.max(wp.max(boxes.bounds[node, 2] - z, z - boxes.bounds[node, 5]), none)
    return wp.cw_mul(along_x, along_x) + wp.cw_mul(along_y, along_y) + wp.cw_mul(along_z, along_z)


@wp.func
def guess(p: wp.vec3, boxes: Boxes) -> int:
    """A face that isn't far: from each node on to the child with the closest box."""
    place = int(0)
    while place < boxes.first:
        gaps = squared_gaps(p, place, boxes)
        place = WIDTH * place + 1 + int(wp.argmin(gaps))
    return boxes.order[wp.min(place - boxes.first, boxes.order.shape[0] - 1)]


@wp.func
def closest_in_boxes(p: wp.vec3, near: int, boxes: Boxes, mesh: PosedMesh) -> int:
    """The face closest to p, whatever face is `near`; the nearer that is, the shorter the search.

    No box is farther from p than what is in it. A node or face is left out only when its box, or the face's plane,
    isn't closer than the closest face so far. So what is found is the closest face of all, but for rounding; of several
    equally close ones, `near` or any.
    """
    face = near
    _w, _feature, offset = closest_on_face(p, face, mesh.points, mesh.faces)
    squared = wp.dot(offset, offset)
    if not squared < _FAR:  # NaN for a face without area
        squared = _FAR
    # First in, first out: so a processor can start on the next node while it still compares boxes of this one.
    queue = _Queue()  # begins with the root
    head = int(0)
    tail = int(1)
    while head < tail:
        place = queue[head & _LAST]
        if tail - head <= _FEW:
            head += 1
        else:
            tail -= 1
            place = queue[tail & _LAST]
        if place < boxes.first:
            gaps = squared_gaps(p, place, boxes)
            for k in range(8):
                # Always written, but counted only if it is of use: there is no branch to predict.
                queue[tail & _LAST] = 8 * place + 1 + k
                tail += wp.where(gaps[k] < squared, 1, 0)
        else:
            other = boxes.order[place - boxes.first]
            a = mesh.points[mesh.faces[other, 0]]
            ab = mesh.points[mesh.faces[other, 1]] - a
            ac = mesh.points[mesh.faces[other, 2]] - a
            normal = wp.cross(ab, ac)
            height = wp.dot(normal, p - a)
            if other != near and height * height < squared * wp.dot(normal, normal):
                w, _feature = closest_on_triangle(p, a, a + ab, a + ac)
                offset = (p - a) - (w[1] * ab + w[2] * ac)
                length = wp.dot(offset, offset)
                if length < squared:
                    squared = length
                    face = other
    return face
