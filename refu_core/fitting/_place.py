"""Where a mesh of unknown unit, axes, place and pose belongs on a body."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from refu_core.body import SmplBody
from refu_core.errors import GarmentError
from refu_core.fitting._clean import no_opening
from refu_core.fitting._found import TOLERANCE, Place, told
from refu_core.fitting._mesh_file import F64, Ints, SurfaceMesh
from refu_core.fitting._placing import UNITS, Placing
from refu_core.fitting._posed import LEFT_HIP, LEFT_SHOULDER, RIGHT_ELBOW, RIGHT_SHOULDER, PosedBody, standing_pose
from refu_core.fitting._surround import NEAR, Samples, fits_of, lies_over, opens_behind, parts_legs, sample
from refu_core.fitting._ways import (
    HIGHEST,
    LIFTS,
    LYING,
    ROUND,
    about_y,
    heights,
    is_backward,
    is_sideways_turn,
    shifts,
    turns_of,
)

_SIZES = (0.12, 2.1)
"""The largest extent of a garment [m]: from a sock to a gown with a train."""
_ARMS = (0.0, 0.35, 0.6, 0.85, 1.1)
"""How far arms may hang when a search begins [rad]: T-pose to arms nearly down."""
_RARER = ((0.6, 0.1), (0.6, 0.25), (0.6, 0.45), (0.5, 0.0, 0.5), (0.9, 0.0, 0.5))
"""Arms lowered, legs spread and elbows bent when the search begins again, because it found nothing plain [rad]."""
_SLEEVES = (0.6, 0.0, 0.4)
"""The same for a mesh of no known unit [rad]: long sleeves on straight arms would be found too large."""
_BENDS = tuple(itertools.product((0.0, 0.2, 0.5, 0.8, 1.1), (0.0, 0.3)))
"""Elbows bent and arms brought forward when a search for them begins [rad]."""
_BENT = tuple(bend for bend in _BENDS if bend[0] >= 0.5)
"""The same for arms that are certainly bent: sleeves may fit nearly as badly on straight ones."""
_REACH = np.array([(-0.2, 1.3), (0.0, 0.6), (0.0, 1.6), (-0.3, 0.6)]).T
"""How far arms are lowered, legs spread, elbows bent, and arms brought forward at most [rad]."""
_TOUCHES = 1e-4
"""A mesh that lacks more than this [m] to be 1 cm off the skin, on average, is tried with bent elbows: of a loose shirt
with sleeves, 0.002 mm with straight arms, and 0.3 mm if elbows were bent by 10°."""
_N_POINTS = 400
_UNIT_TOLERANCE = 0.005
"""A mesh that had to be moved keeps a known unit unless another size fits this much better, likewise."""
MISFIT = 2.0
"""A mesh that fits in a known unit has that unit, unless another size fits this many times as well: loose cloth would
always fit better if it were smaller."""
_DOUBTFUL = 0.1
"""What fits this badly where it is by convention, as a share of its size, is looked for elsewhere, too, in the same
axes unless only sideways it fits at all: trousers are at 0.06, a shirt on the feet of a taller body at 0.18."""
_POSE_TOLERANCE = 0.002
"""A mesh is taken to be in the T-pose, and straight, unless something else fits this much better, likewise."""
_TRIED_SIZES = (0.25, 0.4, 0.6, 0.85, 1.2, 1.7)
"""Largest extents that a mesh of no known unit is tried with [m]."""
_NOTHING = 0.01
"""A mesh that fits has less than this share of it inside the body."""
_N_REFINED = 2
_MOST_ASKED, _SETTLED = 20, 1e-4
"""A search asks for the cost at most this many times per number that it varies, and ends where the costs that it
compares differ by less: 30 times, and a tenth of that, took a third longer and found costs that were lower by 0.0003.
"""
_NORMED = 1e-3
"""An extent this near to 1, 2 or another power of two was made so, as in data sets of shapes: it tells no unit. A
middle this near to the origin, as a share of the extent, was made so, too: the origin says nothing of the body."""
_AT_ORIGIN = 0.01
"""What was made so large was put with its middle or its low corner this near to the origin, likewise: elsewhere, a
length that is a power of two is chance, or a modeller's round number. A jacket of size 2 was 0.0025 off; clothes on a
body are off by 0.03 and more along some axis."""
_UNDER_ARMS = 0.1
"""How far below the joints of the shoulders a garment that is held at the waist ends [m]."""
_HAT = 0.3
"""How far above the body cloth reaches at most [m]; without this, a tube on the head was taken for wide cloth."""


def find_places(mesh: SurfaceMesh, body: SmplBody, placing: Placing) -> Iterator[Place]:
    """Where a mesh may belong on a body of mean shape, the likeliest first; places are only searched when asked for.

    The mesh stays as it is if it surrounds the body like that, or in another unit, with another axis up, standing on
    the floor, or in an A-pose. Else it is moved until it does; if that fails, it is scaled by a factor that is no unit.

    Raises `GarmentError`: in no unit is it as large as a garment, or it surrounds the body nowhere.
    """
    extent = float(np.ptp(mesh.vertices, axis=0).max())
    units = [placing.unit] if placing.unit else [u for u in UNITS.values() if _SIZES[0] <= u * extent <= _SIZES[1]]
    if not units or (placing.unit and not _SIZES[0] <= placing.unit * extent <= _SIZES[1]):
        size = f"{extent:.3g} units" + (f" = {placing.unit * extent:.3g} m" if placing.unit else "")
        msg = f"the mesh is {size} large: wanted a garment of {_SIZES[0]} to {_SIZES[1]} m; say its unit (--unit)"
        raise GarmentError(msg)
    search = _Search(mesh, body, placing, units)
    poses = [placing.pose] if placing.pose is not None else [standing_pose(arms) for arms in _ARMS]
    bodies = [PosedBody(body, pose) for pose in poses]
    turns = turns_of(placing.up, mesh, is_placed=placing.is_placed)
    in_units = cache(lambda: search.along(bodies, turns, units))  # only if it's needed, and once
    found = search.by_convention(bodies, turns) if search.has_origin else []
    if placing.is_whole and found and found[0].fit.is_near:
        yield search.told(found[0])
        return
    found += search.of_other_heights(found, bodies)
    if placing.pose is None and found and not any(one.fit.is_plain for one in found):
        found += search.by_convention([PosedBody(body, standing_pose(*angles)) for angles in _RARER], turns)
        near = sorted((one for one in found if one.fit.is_near), key=lambda one: one.cost(extent))
        likely = [search.refined(one, moves=False, scales=False, bends=_BENDS) for one in near[:_N_REFINED]]
        found += [one for one in likely if one.fit.is_good]
    good = [one for one in found if one.fit.is_plain]
    if good:
        least = min(one.cost(extent) for one in good)
        chosen = next(one for one in good if one.cost(extent) < least + TOLERANCE)  # plain assumptions come first
        first = [chosen]
        if placing.pose is None or chosen.lift:
            likes = sorted((one for one in found if one.is_like(chosen)), key=lambda one: one.cost(extent))
            refined = [search.refined(one, moves=False, scales=False) for one in likes[:2]]
            if min(one.fit.depth for one in refined) > _TOUCHES:
                best = min(refined, key=lambda one: one.cost(extent))
                refined.append(search.refined(best, moves=False, scales=False, bends=_BENDS))
            other = min(refined, key=lambda one: one.cost(extent))
            if other.cost(extent) < chosen.cost(extent) - _POSE_TOLERANCE or chosen.pose.any():
                first = [other, chosen]  # the second if a limb goes through it there
        least = first[0].cost(extent)
        if least > _DOUBTFUL and not placing.is_placed:
            moved = [one for one in in_units() if one.fit.is_plain]
            stands = not chosen.is_sideways or any(one.fit.is_good and not one.is_sideways for one in found)
            moved = [one for one in moved if not stands or one.faces_as(chosen)]
            first = [one for one in moved if MISFIT * one.cost(extent) < least] + first
        yield from map(search.told, first)
    rings = [one for one in found if one.fit.is_ring and not one.kind and not one.is_sideways]
    if rings and not good:  # a mesh around the body where it was modelled isn't searched elsewhere
        yield search.told(rings[0])
    found.sort(key=lambda one: (not one.fit.is_good, one.cost(extent)))
    tiers = found[:1]
    for one in tiers:
        if one.fit.is_good and one.fit.inside < _NOTHING and one.fit.distance < NEAR and not one.is_sideways:
            yield search.told(one)  # much of a glove faces other fingers
    if not placing.is_placed and search.has_unit:
        tiers += in_units()
    # A place by convention, or else one in a known unit, comes first unless it fits much worse.
    least = search.least(tiers)
    rough: list[Place] = []
    if not placing.is_placed and not placing.unit:
        rough = search.roughly(bodies, turns, [size / extent for size in _TRIED_SIZES], scales=True)
        # Refined, it costs a third less, not half: one that fits no better as it is needn't be, unless all others fail.
        if not search.has_unit or (rough and rough[0].cost(extent) < least):
            tiers, rough = tiers + search.best_of(rough, scales=True), []
    least = search.least(tiers)
    scaled = [one for one in tiers if search.has_unit and not search.knows(one) and MISFIT * one.cost(extent) >= least]
    tiers = [one for one in tiers if one not in scaled]
    handicap = [
        (k > 0) * TOLERANCE + (not search.knows(one) or one.fit.inside > _NOTHING) * _UNIT_TOLERANCE
        for k, one in enumerate(tiers)
    ]
    ranked = sorted(range(len(tiers)), key=lambda k: tiers[k].cost(extent) + handicap[k])
    order = [tiers[k] for k in ranked if tiers[k].fit.is_good]
    tight = [one for one in found if one.fit.is_tight and not one.fit.is_good and not one.is_sideways]
    tight = [one for one in tight if one.fit.depth or placing.is_placed]  # what stands beside the body isn't meant
    if tight and not good and search.has_unit:
        # A sleeve without an arm in it costs less, but faces the wrong way.
        best = min(tight, key=lambda one: one.cost(extent) + 4 * (1 - one.fit.facing))
        # A mesh in metres that is close to the skin isn't meant to be a sixth larger, or to lie.
        first = [one for one in order if search.knows(one) and one.faces_as(best)]
        order = [*first, best, *(one for one in order if one not in first)]
    order += [one for one in scaled if one.fit.is_good]  # if a limb goes through it everywhere else
    yield from map(search.told, order)
    scaled = [one for one in search.best_of(rough, scales=True) if one.fit.is_good]
    yield from map(search.told, scaled)
    order += scaled
    lying = [] if placing.up or placing.is_placed else search.along(bodies, LYING, units)
    least = min((one.cost(extent) for one in (*good, *order)), default=math.inf)
    # Nobody wears a garment on a hand, or upside down, that can be worn upright.
    lying = [one for one in lying if one.fit.is_plain and MISFIT * one.cost(extent) < least]
    yield from map(search.told, lying)
    if good or order or lying or any(one.fit.is_good for one in tiers):
        return
    or_else = "leave --as-placed out" if placing.is_placed else "place it on the body first"
    if not tiers:
        msg = "it reaches higher than it can: between the arms, where it is held at the waist, or far above the head; "
        raise GarmentError(msg + f"say its --unit or --up, or {or_else}")
    fit = min((one.fit for one in tiers), key=lambda fit: fit.cost)
    raise GarmentError(
        f"the mesh doesn't surround the body {body.name}: at best {100 * fit.inside:.0f} % of it is inside, it is "
        f"{1e3 * fit.distance:.0f} mm off, and {100 * fit.facing:.0f} % faces outward; say its --unit, --up or --pose, "
        f"or {or_else}{no_opening(mesh.faces)}"
    )


class _Search:
    """Looks for places of a mesh that isn't where it belongs."""

    def __init__(self, mesh: SurfaceMesh, body: SmplBody, placing: Placing, units: list[float]) -> None:
        self._mesh, self._body, self._placing, self._units = mesh, body, placing, units
        self._extent = float(np.ptp(mesh.vertices, axis=0).max())
        self._moving = PosedBody(body, standing_pose(0.0))
        self.samples = sample(mesh, _N_POINTS)
        under_arms = float(body.joint_template[[LEFT_SHOULDER, RIGHT_SHOULDER], 1].mean()) - _UNDER_ARMS
        self._highest = under_arms if placing.held_at == "waist" else math.inf
        low, high = mesh.vertices.min(0), mesh.vertices.max(0)
        middles = np.abs([(low + high) / 2, mesh.vertices.mean(0)])
        exponent, off = float(np.log2(self._extent)), middles.max(1).min()
        is_normed = abs(exponent - round(exponent)) < _NORMED
        is_normed &= np.minimum(middles.min(0), np.abs(low)).max() < _AT_ORIGIN * self._extent
        self.has_unit = placing.unit is not None or not is_normed
        """Whether the mesh is in a unit, and wasn't scaled to a size of one."""
        self.has_origin = bool(placing.is_placed or (self.has_unit and off > _NORMED * self._extent))
        """Whether its origin says where it belongs: it is in a unit, and its origin isn't its own middle."""

    def too_high(self, place: Place, body: PosedBody) -> bool:
        """Whether it reaches up between the arms, where it is held at the waist, or far above the head."""
        return place.top > min(self._highest, body.top + _HAT)

    def knows(self, place: Place) -> bool:
        """Whether its unit is one that the mesh may be in."""
        return bool(np.isclose(place.unit, self._units).any())

    def least(self, places: list[Place]) -> float:
        """The least cost of a good place in a unit that the mesh may be in."""
        costs = (one.cost(self._extent) for one in places if one.fit.is_good and self.knows(one))
        return min(costs, default=math.inf)

    def by_convention(self, bodies: list[PosedBody], turns: list[F64]) -> list[Place]:
        """The mesh where it may stand by convention, in each pose, turn and unit."""
        found = []
        for here in bodies:
            stands = shifts(here, is_placed=self._placing.is_placed)
            ways = [_Way(unit, turn, *stand) for turn, unit, stand in itertools.product(turns, self._units, stands)]
            found += [one for one in _at(self.samples, ways, here) if not self.too_high(one, here)]
        return found

    def of_other_heights(self, found: list[Place], bodies: list[PosedBody]) -> list[Place]:
        """The same higher and lower: the wearer may have been taller or shorter, or the body's origin elsewhere."""
        if self._placing.is_placed:
            return []
        lifted = []
        for here in bodies:
            ways = [
                _Way(one.unit, one.turn, one.kind, one.shift + lift * np.eye(3)[1], lift)
                for one in found
                if one.pose is here.pose and one.fit.is_near and one.turn[0, 0] > 0.5 and self.shows_height(one)
                for lift in LIFTS
            ]
            lifted += _at(self.samples, ways, here)
        return [one for one in lifted if one.fit.distance < NEAR and not self.too_high(one, bodies[0])]

    def told(self, place: Place) -> Place:
        """The place with what was found out, in words; turned round if the mesh would be worn back to front."""
        if is_backward(place.turn) and opens_behind(*self._worn(place)):
            vertices = place(self._mesh.vertices)
            middle = (vertices.min(0) + vertices.max(0)) / 2 * (1, 0, 1)
            start = replace(
                place, turn=ROUND @ place.turn, shift=ROUND @ (place.shift - middle) + middle, kind="searched"
            )
            # Arms that were brought forward for the other side are so no longer.
            other = self.refined(replace(start, lift=0.0), moves=True, scales=not self.knows(place), bends=_BENDS)
            if other.fit.is_good and other.cost(self._extent) < MISFIT * place.cost(self._extent):
                place = other
        return told(place)

    def shows_height(self, place: Place) -> bool:
        """Whether there is cloth over the shoulders or between the legs, so that it can be worn at one height only."""
        return lies_over(*self._worn(place)) or parts_legs(*self._worn(place))

    def _worn(self, place: Place) -> tuple[F64, Ints, SmplBody]:
        return place(self._mesh.vertices), self._mesh.faces, self._body

    def along(self, bodies: list[PosedBody], turns: list[F64], units: list[float]) -> list[Place]:
        """The best place at any height along the body, refined from there; none if there are no heights."""
        return self.best_of(self.roughly(bodies, turns, units, scales=False), scales=False)

    def roughly(self, bodies: list[PosedBody], turns: list[F64], units: list[float], *, scales: bool) -> list[Place]:
        """The best place of each turn at any height along the body, the best first."""
        few = Samples(*(array[::4] for array in self.samples))  # type: ignore[arg-type]
        few = few._replace(area=4 * few.area)
        bodies = bodies[::2]
        if scales:  # there is much to try, so what nobody does is left out
            bodies, turns = bodies[:2], [turn for turn in turns if not is_sideways_turn(turn)]
            if self._placing.pose is None:
                bodies.append(PosedBody(self._body, standing_pose(*_SLEEVES)))
        found = []
        for here in bodies:
            ways = [
                _Way(unit, turn, "searched", shift)
                for turn, unit in itertools.product(turns, units)
                for shift in heights(unit * self._mesh.vertices @ turn.T, here)
            ]
            found += [one for one in _at(few, ways, here) if not self.too_high(one, here)]
        found.sort(key=lambda one: one.cost(self._extent))
        return [one for k, one in enumerate(found) if not any(one.turn is other.turn for other in found[:k])]

    def best_of(self, rough: list[Place], *, scales: bool) -> list[Place]:
        """The best place, refined from the first ones.

        Where cloth touches skin on straight arms, the best with bent elbows comes second.
        """
        refined = [self.refined(one, moves=True, scales=scales) for one in rough[:_N_REFINED]]
        best = min(refined, key=lambda one: one.cost(self._extent), default=None)
        bent = []
        if best and best.fit.is_near and best.fit.depth > _TOUCHES and self._placing.pose is None:
            bent = [self.refined(best, moves=True, scales=scales, bends=bends) for bends in (_BENDS, _BENT)]
        first = sorted(refined + bent, key=lambda one: (not one.fit.is_good, one.cost(self._extent)))[:1]
        return first + [one for one in bent[-1:] if one not in first]

    def refined(self, start: Place, *, moves: bool, scales: bool, bends: Sequence[tuple[float, float]] = ()) -> Place:
        """The best place near `start`, by a simplex search over the pose, and over place and size if wanted.

        Arms come forward, and elbows bend, only if it is said where to begin: it takes twice as long. A mesh that moves
        then turns, too, as somebody does who was scanned.
        """
        body, samples = self._moving, self.samples
        body.move(start.pose)
        is_posed = self._placing.pose is not None
        has_legs = parts_legs(*self._worn(start))
        arms, elbows = start.pose[RIGHT_SHOULDER], start.pose[RIGHT_ELBOW, 1]
        angles = np.array([arms[2], max(0.02 * has_legs, start.pose[LEFT_HIP, 2]), elbows, arms[1]])
        x0 = np.concatenate((np.zeros(4), angles, [0.0]))
        bent = len(bends) > 0
        turning = np.array([0.1, 0.06 * has_legs, 0.15 * bent, 0.1 * bent]) * (not is_posed)
        rises = moves or start.lift != 0
        steps = np.array([0.06 * scales, 0.03 * moves, 0.03 * rises, 0.03 * moves, *turning, 0.1 * (moves and bent)])
        free = np.flatnonzero(steps)
        middle = samples.points.mean(0) @ start.turn.T
        floor = body.floor
        extent = float(np.ptp(samples.points, axis=0).max())

        def at(full: F64) -> Place:
            size, shift, angles, yaw = full[0], full[1:4], full[4:8], full[8]
            turn = about_y(yaw) @ start.turn
            if not is_posed:
                body.move(standing_pose(*np.clip(angles, *_REACH)))
            unit = min(start.unit * float(np.exp(np.clip(size, -0.5, 0.5))), _SIZES[1] / extent)
            moved = start.shift + shift + start.unit * middle - unit * (about_y(yaw) @ middle)  # the middle stays
            if start.kind == "floor":  # the floor is where the feet of this pose are
                moved[1] += body.floor - floor
            lift = start.lift and start.lift + float(shift[1])
            held = float(np.clip(lift, -HIGHEST, HIGHEST))
            moved[1] += held - lift
            return _at(samples, [_Way(unit, turn, start.kind, moved, held)], body)[0]

        def cost(full: F64) -> float:
            place = at(full)
            return place.cost(extent) + self.too_high(place, body)

        def there(values: NDArray[Any]) -> F64:
            full: F64 = x0.copy()
            full[free] += values * steps[free]
            return full

        def cost_there(values: NDArray[Any]) -> float:
            return cost(there(values))

        if not len(free):
            return start
        if bent and not is_posed:
            x0 = min((np.array([*x0[:6], *bend, x0[8]]) for bend in bends), key=cost)
        simplex = np.concatenate((np.zeros((1, len(free))), np.eye(len(free))))
        options: Any = {"initial_simplex": simplex, "maxfev": _MOST_ASKED * len(free), "xatol": 0.02, "fatol": _SETTLED}
        found = minimize(cost_there, np.zeros(len(free)), method="Nelder-Mead", options=options)
        best = there(found.x)
        straight = np.array([*best[:8], 0.0])
        if best[8] and cost(straight) < found.fun + _POSE_TOLERANCE:
            best = straight
        return at(best)


class _Way(NamedTuple):
    """A way to place a mesh; the fields are the first ones of `Place`."""

    unit: float
    turn: F64
    kind: str
    shift: F64
    lift: float = 0.0


def _at(samples: Samples, ways: Sequence[_Way], body: PosedBody) -> list[Place]:
    """The samples placed in each way on the body as it is posed."""
    if not ways:
        return []
    points = np.stack([way.unit * samples.points @ way.turn.T + way.shift for way in ways])
    normals = np.stack([samples.normals @ way.turn.T for way in ways])
    area = np.array([[way.unit**2] for way in ways]) * samples.area
    fits, tops = fits_of(points, normals, area, samples, body), points[:, :, 1].max(1).tolist()
    return [Place(*way, body.pose, fit, top) for way, fit, top in zip(ways, fits, tops, strict=True)]
