"""What keeps cloth that hangs behind a leg behind it, vertex by vertex: one code for CPU and CUDA."""

import warp as wp

wp.set_module_options({"enable_backward": False})

N_LEGS = 2
_KNEE = wp.constant(0)
_ANKLE = wp.constant(1)
_BEHIND = wp.constant(2)
N_PLACES = 3
"""Places that say how a shin stands: its knee, its ankle, and one behind the knee."""


@wp.struct
class ShinMeans:
    """The lower legs of a posed body, as affine means of their skin."""

    start: wp.array[int]
    vertex: wp.array[int]
    """Skin of leg i: `vertex[start[i]:start[i + 1]]`."""
    share: wp.array2d[float]
    """The weight of each of these vertices in each of the places, shape (n, N_PLACES)."""
    radius: wp.array[float]
    """How far a leg's skin is from its bone at rest [m]."""
    places: wp.array2d[wp.vec3]
    """The places of each leg [m]."""


@wp.kernel
def stand_kernel(body: wp.array[wp.vec3], shins: ShinMeans) -> None:
    """Knee, ankle, and the way backwards, a unit vector at right angles to the bone; one leg a thread."""
    leg = wp.tid()
    knee = wp.vec3()
    ankle = wp.vec3()
    behind = wp.vec3()
    for i in range(shins.start[leg], shins.start[leg + 1]):
        at = body[shins.vertex[i]]
        knee += shins.share[i, _KNEE] * at
        ankle += shins.share[i, _ANKLE] * at
        behind += shins.share[i, _BEHIND] * at
    bone = wp.normalize(ankle - knee)
    back = behind - knee
    shins.places[leg, _KNEE] = knee
    shins.places[leg, _ANKLE] = ankle
    shins.places[leg, _BEHIND] = wp.normalize(back - wp.dot(back, bone) * bone)


@wp.func
def lack_behind(at: wp.vec3, at_rest: float, leg: int, shins: ShinMeans) -> float:
    """How far a place has to go along the way backwards to be behind the tent over a leg [m]; negative behind it.

    The tent is a circle around the bone, continued at its sides by the tangents at 45 degrees. Nothing has to be
    farther behind the bone than it is at rest.
    """
    knee = shins.places[leg, _KNEE]
    bone = shins.places[leg, _ANKLE] - knee
    back = shins.places[leg, _BEHIND]
    along = wp.clamp(wp.dot(at - knee, bone) / wp.max(wp.dot(bone, bone), 1.0e-12), 0.0, 1.0)
    off = at - knee - along * bone
    behind = wp.dot(off, back)
    beside = wp.length(off - behind * back)
    radius = shins.radius[leg]
    edge = radius * wp.sqrt(0.5)
    tent = 2.0 * edge - beside
    if beside < edge:
        tent = wp.sqrt(radius * radius - beside * beside)
    return wp.min(tent, at_rest) - behind


@wp.func
def least_way(left: wp.vec3, n_left: float, right: wp.vec3, n_right: float) -> wp.vec3:
    """The shortest vector that goes `n_left` or more along the unit vector `left`, and `n_right` along `right`.

    Where the directions point apart it is the sum of both ways; otherwise it could grow without bound.
    """
    both = wp.max(wp.dot(left, right), 0.0)
    if n_left <= 0.0 and n_right <= 0.0:
        return wp.vec3()
    if n_left * both >= n_right:
        return n_left * left
    if n_right * both >= n_left:
        return n_right * right
    square = 1.0 - both * both
    return ((n_left - both * n_right) * left + (n_right - both * n_left) * right) / square


@wp.struct
class Hanging:
    """Cloth that hangs behind a leg."""

    vertex: wp.array[int]
    at_rest: wp.array2d[float]
    """How far each is behind each leg's bone at rest [m]."""
    weight: wp.array2d[float]
    """What share of the way out of each leg's tent each goes."""


@wp.kernel
def tent_kernel(hanging: Hanging, shins: ShinMeans, each: int, cloth: wp.array[wp.vec3]) -> None:
    """Brings the hanging vertices out of the tents over both legs; `each` of them a thread."""
    first = wp.tid() * each
    for i in range(first, wp.min(first + each, hanging.vertex.shape[0])):
        v = hanging.vertex[i]
        left = float(0.0)
        right = float(0.0)
        if hanging.weight[i, 0] > 0.0:
            left = hanging.weight[i, 0] * lack_behind(cloth[v], hanging.at_rest[i, 0], 0, shins)
        if hanging.weight[i, 1] > 0.0:
            right = hanging.weight[i, 1] * lack_behind(cloth[v], hanging.at_rest[i, 1], 1, shins)
        cloth[v] += least_way(shins.places[0, _BEHIND], left, shins.places[1, _BEHIND], right)
