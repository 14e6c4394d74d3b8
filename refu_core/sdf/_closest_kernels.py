"""Closest point on a triangle mesh, with the sign of the angle-weighted pseudo-normal: one code for CPU and CUDA.

Barycentrics here weigh a face's vertices 0, 1, 2 in that order. The part of a face that holds the closest point is its
*feature*: 0 the interior, 1 to 3 the vertices 0 to 2, 4 to 6 the edges (0, 1), (1, 2), (2, 0).
"""

import warp as wp

from refu_core import _warp  # noqa: F401  (quiets Warp before it starts)

FACE = wp.constant(0)
VERTEX = wp.constant(1)  # 1, 2, 3
EDGE = wp.constant(4)  # 4, 5, 6

# Below this distance [m] the direction to a closest edge or vertex is rounding noise; the pseudo-normal stands in.
ON_SURFACE = wp.constant(1e-5)


@wp.struct
class PosedMesh:
    """A closed triangle mesh in one pose."""

    points: wp.array[wp.vec3]
    """Vertices [m]."""
    faces: wp.array2d[wp.int32]
    across: wp.array2d[wp.int32]
    fan_start: wp.array[wp.int32]
    fan_face: wp.array[wp.int32]
    """As in `Connectivity`."""


@wp.func
def closest_on_triangle(p: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3) -> tuple[wp.vec3, int]:
    """Barycentrics of the point of triangle abc closest to p, and its feature, by p's Voronoi region."""
    ab = b - a
    ac = c - a
    ap = p - a
    ab_ap = wp.dot(ab, ap)
    ac_ap = wp.dot(ac, ap)
    if ab_ap <= 0.0 and ac_ap <= 0.0:
        return wp.vec3(1.0, 0.0, 0.0), VERTEX

    bp = p - b
    ab_bp = wp.dot(ab, bp)
    ac_bp = wp.dot(ac, bp)
    if ab_bp >= 0.0 and ac_bp <= ab_bp:
        return wp.vec3(0.0, 1.0, 0.0), VERTEX + 1

    weight_c = ab_ap * ac_bp - ab_bp * ac_ap
    if weight_c <= 0.0 and ab_ap >= 0.0 and ab_bp <= 0.0 and ab_ap > ab_bp:  # otherwise a and b coincide
        t = ab_ap / (ab_ap - ab_bp)
        return wp.vec3(1.0 - t, t, 0.0), EDGE

    cp = p - c
    ab_cp = wp.dot(ab, cp)
    ac_cp = wp.dot(ac, cp)
    if ac_cp >= 0.0 and ab_cp <= ac_cp:
        return wp.vec3(0.0, 0.0, 1.0), VERTEX + 2

    weight_b = ab_cp * ac_ap - ab_ap * ac_cp
    if weight_b <= 0.0 and ac_ap >= 0.0 and ac_cp <= 0.0:
        t = ac_ap / (ac_ap - ac_cp)
        return wp.vec3(1.0 - t, 0.0, t), EDGE + 2

    weight_a = ab_bp * ac_cp - ab_cp * ac_bp
    if weight_a <= 0.0 and ac_bp - ab_bp >= 0.0 and ab_cp - ac_cp >= 0.0:
        t = (ac_bp - ab_bp) / ((ac_bp - ab_bp) + (ab_cp - ac_cp))
        return wp.vec3(0.0, 1.0 - t, t), EDGE + 1

    scale = 1.0 / (weight_a + weight_b + weight_c)
    t_b = weight_b * scale
    t_c = weight_c * scale
    return wp.vec3(1.0 - t_b - t_c, t_b, t_c), FACE


@wp.func
def area_normal(face: int, points: wp.array[wp.vec3], faces: wp.array2d[int]) -> wp.vec3:
    """A face's normal, as long as twice its area."""
    a = points[faces[face, 0]]
    return wp.cross(points[faces[face, 1]] - a, points[faces[face, 2]] - a)


@wp.func
def face_normal(face: int, mesh: PosedMesh) -> wp.vec3:
    return wp.normalize(area_normal(face, mesh.points, mesh.faces))


@wp.func
def vertex_normal(vertex: int, mesh: PosedMesh) -> wp.vec3:
    """Sum of the normals of the faces around a vertex, weighted by their angles there (Baerentzen and Aanaes, 2005)."""
    here = mesh.points[vertex]
    total = wp.vec3(0.0, 0.0, 0.0)
    for i in range(mesh.fan_start[vertex], mesh.fan_start[vertex + 1]):
        face = mesh.fan_face[i]
        k = wp.where(mesh.faces[face, 1] == vertex, 1, wp.where(mesh.faces[face, 2] == vertex, 2, 0))
        to_next = mesh.points[mesh.faces[face, (k + 1) % 3]] - here
        to_last = mesh.points[mesh.faces[face, (k + 2) % 3]] - here
        normal = wp.cross(to_next, to_last)
        total += wp.atan2(wp.length(normal), wp.dot(to_next, to_last)) * wp.normalize(normal)
    return total


@wp.func
def pseudo_normal(face: int, feature: int, mesh: PosedMesh) -> wp.vec3:
    """Unit vector whose side of the closest feature is the outside, for every point that feature is closest to."""
    normal = face_normal(face, mesh)
    if feature >= EDGE:
        normal += face_normal(mesh.across[face, feature - EDGE], mesh)
    elif feature >= VERTEX:
        normal = vertex_normal(mesh.faces[face, feature - VERTEX], mesh)
    return wp.normalize(normal)


@wp.func
def offset_from(p: wp.vec3, face: int, w: wp.vec3, points: wp.array[wp.vec3], faces: wp.array2d[int]) -> wp.vec3:
    """From a place on a face, given by its barycentrics, to p."""
    # Relative to a vertex: a difference of nearby positions keeps the digits that absolute ones lose.
    a = points[faces[face, 0]]
    return (p - a) - (w[1] * (points[faces[face, 1]] - a) + w[2] * (points[faces[face, 2]] - a))


@wp.func
def closest_on_face(
    p: wp.vec3, face: int, points: wp.array[wp.vec3], faces: wp.array2d[int]
) -> tuple[wp.vec3, int, wp.vec3]:
    """Barycentrics of the point of a face closest to p, its feature, and p's offset from it."""
    w, feature = closest_on_triangle(p, points[faces[face, 0]], points[faces[face, 1]], points[faces[face, 2]])
    return w, feature, offset_from(p, face, w, points, faces)


@wp.func
def is_below(offset: wp.vec3, face: int, feature: int, mesh: PosedMesh) -> bool:
    """Whether an offset from a feature of a face leads inside, by the pseudo-normal there."""
    below = bool(True)
    above = bool(True)
    if feature >= VERTEX and feature < EDGE:
        # Mostly all faces around a vertex agree, and their angles there needn't be known.
        vertex = mesh.faces[face, feature - VERTEX]
        for i in range(mesh.fan_start[vertex], mesh.fan_start[vertex + 1]):
            normal = area_normal(mesh.fan_face[i], mesh.points, mesh.faces)
            if wp.dot(offset, normal) < 0.0:
                above = False
            else:
                below = False
    if above == below:
        below = wp.dot(offset, pseudo_normal(face, feature, mesh)) < 0.0
    return below


@wp.func
def distance_and_gradient(
    offset: wp.vec3, face: int, feature: int, normal: wp.vec3, mesh: PosedMesh
) -> tuple[float, wp.vec3]:
    """Signed distance and its unit gradient from the offset from the closest point, which is on a feature of a face.

    In the face's interior the offset from any of its points will do. `normal` is the face's, of unit length.
    """
    if feature == FACE:
        return wp.dot(offset, normal), normal
    distance = wp.length(offset)
    if distance < ON_SURFACE:
        pseudo = pseudo_normal(face, feature, mesh)
        return wp.where(wp.dot(offset, pseudo) < 0.0, -distance, distance), pseudo
    outside = wp.where(is_below(offset, face, feature, mesh), -1.0, 1.0)
    return outside * distance, offset * (outside / distance)


@wp.func
def measured_to(p: wp.vec3, face: int, mesh: PosedMesh) -> tuple[float, wp.vec3]:
    """Signed distance at p and its unit gradient, if `face` is the closest."""
    _w, feature, offset = closest_on_face(p, face, mesh.points, mesh.faces)
    normal = face_normal(face, mesh)
    return distance_and_gradient(offset, face, feature, normal, mesh)


@wp.func
def distance_to_face(p: wp.vec3, face: int, mesh: PosedMesh) -> float:
    _w, _feature, offset = closest_on_face(p, face, mesh.points, mesh.faces)
    return wp.length(offset)


@wp.kernel(enable_backward=False)
def closest_kernel(
    tree: wp.uint64,
    mesh: PosedMesh,
    by_winding: bool,
    queries: wp.array[wp.vec3],
    near: wp.array[int],
    max_distance: wp.array[float],
    # outputs
    out_face: wp.array[int],
    out_distance: wp.array[float],
    out_gradient: wp.array[wp.vec3],
) -> None:
    """Closest point, signed distance there and its gradient; face -1 where nothing is within `max_distance`.

    Where a face `near` is known (not -1), nothing farther away than that is looked at.
    """
    i = wp.tid()
    p = queries[i]
    limit = max_distance[0]
    if near.shape[0] > 0 and near[i] >= 0:
        # Plus what rounding may amount to, here and in the tree.
        rounding = 1.0e-5 * (1.0 + wp.length(p))
        limit = wp.min(limit, 1.0001 * distance_to_face(p, near[i], mesh) + rounding)
    if by_winding:
        hit = wp.mesh_query_point_sign_winding_number(tree, p, limit)
    else:
        hit = wp.mesh_query_point_no_sign(tree, p, limit)
    if not hit.result:
        out_face[i] = -1
        out_distance[i] = wp.inf
        out_gradient[i] = wp.vec3(0.0, 1.0, 0.0)
        return

    face = hit.face
    distance, gradient = measured_to(p, face, mesh)
    if by_winding and hit.sign * distance < 0.0:
        distance = -distance
        if wp.abs(distance) > ON_SURFACE:  # nearer, the two signs may differ by rounding alone
            gradient = -gradient

    out_face[i] = face
    out_distance[i] = distance
    out_gradient[i] = gradient


@wp.kernel(enable_backward=False)
def feature_kernel(
    mesh: PosedMesh,
    queries: wp.array[wp.vec3],
    closest: wp.array[int],
    # outputs
    out_feature: wp.array[int],
    out_barycentrics: wp.array[wp.vec3],
    out_normal: wp.array[wp.vec3],
) -> None:
    """The feature of the closest face that is closest to each query, the place there, and the pseudo-normal."""
    i = wp.tid()
    face = closest[i]
    w = wp.vec3(1.0, 0.0, 0.0)
    feature = int(FACE)
    normal = wp.vec3(0.0, 1.0, 0.0)
    if face >= 0:
        w, feature, _offset = closest_on_face(queries[i], face, mesh.points, mesh.faces)
        normal = pseudo_normal(face, feature, mesh)
    out_feature[i] = feature
    out_barycentrics[i] = w
    out_normal[i] = normal
