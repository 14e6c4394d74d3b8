"""ReFU with an accurate distance, repeated for the few vertices that one push hasn't brought to safety."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from refu_core.contact import DEFAULT_CONTACT, Blend, Resolution
from refu_core.modes import DEFAULT_MARGIN
from refu_core.refu import MAX_DISPLACEMENT, VertexScale, repulse
from refu_core.sdf import BodySdf, SdfSample
from slow_contact._mend import mend

_SETTINGS = DEFAULT_CONTACT


@torch.no_grad()
def resolve(
    points: Tensor,
    sdf: BodySdf,
    *,
    margin: float = DEFAULT_MARGIN,
    scale: float | Tensor | VertexScale = 1.0,
    start: SdfSample | None = None,
    near: Tensor | None = None,
    blend: Blend | None = None,
    max_pushes: int = 4,
    tolerance: float = 2e-4,
    max_displacement: float = MAX_DISPLACEMENT,
    edges: Tensor | None = None,
) -> Resolution:
    """Pushes garment vertices to f ≥ `margin`, and looks again at those it pushed. Not differentiable.

    One push along the gradient (the paper's Eq. refu) can end inside another part of the body: in an armpit, between
    the thighs. So the pushed vertices, and no others, are asked again and pushed again while they are closer than
    `margin - tolerance`. Where limbs leave less room than twice the margin a vertex would be thrown to and fro: a push
    against the last one goes half as far, and the best position found is kept.

    Args:
        points: Garment vertices [m], shape (N, 3), in the frame of the body last given to `sdf`.
        sdf: The body's signed distance; an approximate one is only as safe as it is right.
        margin: ε ≥ 0 [m].
        scale: α of the first push: one number, shape (N,), or what predicts it for the vertices that are pushed
            (`Refu.of_body`). Where it is below 1 a vertex that got as far as predicted is left in peace, if outside.
        start: What is known already of the points' distances; those beyond `margin` + 2 mm may be clipped from above.
        near: A body face near each vertex, shape (N,), where `sdf` asks for such hints.
        blend: Where given, the neighbourhood of pushed vertices gives way with them: folds are kept, and the edges
            between pushed vertices and others don't cut through the skin.
        max_pushes: Upper bound on pushes of one vertex.
        tolerance: Shortfall of the margin that is let pass [m].
        max_displacement: Bound on each vertex's movement [m], all pushes together.
        edges: Pairs of vertices, shape (E, 2), such as a garment template's `edges`: where given, the middles of edges
            near the skin are checked, too, and both ends of those too close are raised. That clears the edges which cut
            a corner.
    """
    if start is None:
        start = sdf.query(points) if near is None else sdf.query(points, near=near)
    if near is not None and edges is not None and start.face is not None:
        start = mend(points, start, edges, margin=margin, look=lambda here, faces: sdf.query(here, near=faces))
    state = _State(
        vertices=points.clone(),
        distance=start.distance.clone(),
        # Beyond a band nothing is known.
        gradient=start.gradient.clone() if start.face is None else start.gradient * (start.face >= 0)[:, None],
        near=None if near is None else start.face.clone() if start.face is not None else near,
        origin=points,
        sdf=sdf,
        margin=margin,
        tolerance=tolerance,
        max_displacement=max_displacement,
    )
    rows = torch.nonzero(start.distance < margin)[:, 0]
    first = start.rows(rows)
    rounds = 0
    alpha = state.first_scale(scale, rows, first.distance)
    if blend is not None and len(rows):
        rows, first, alpha = _push_blended(state, rows, first, alpha, blend)
        rounds += 1
    rounds += _push(state, rows, first, alpha, max_pushes)
    if edges is not None:
        rounds += _raise_edges(state, edges, max_pushes)
    vertices, distance = state.vertices, state.distance
    depth = (-start.distance).amax(0, keepdim=True).clamp_min(0) if len(points) else start.distance.new_zeros(1)
    numbers = torch.stack(
        [
            (start.distance < 0).sum(),
            ((vertices != points).any(dim=-1) & (start.distance < margin)).sum(),
            (distance < 0).sum(),
        ]
    )
    face = torch.full((len(points),), -1, dtype=torch.int32) if state.near is None else state.near
    return Resolution(vertices, distance, state.gradient, face, torch.cat((numbers.to(depth), depth)))


@dataclass(eq=False)
class _State:
    """Best positions and distances so far, and the bounds on what may be done to them."""

    vertices: Tensor
    distance: Tensor
    gradient: Tensor
    """Of the distance; beyond the margin it may be that of an earlier place, or zero where it isn't known."""
    near: Tensor | None
    """Closest face of each vertex as last known, where the distance asks for such hints."""
    origin: Tensor
    sdf: BodySdf
    margin: float
    tolerance: float
    max_displacement: float

    def bounded(self, moved: Tensor, rows: Tensor) -> Tensor:
        """`moved`, drawn back to within the largest displacement from where rows began."""
        way = moved - self.origin[rows]
        length = torch.linalg.vector_norm(way, dim=-1, keepdim=True)
        bounded: Tensor = self.origin[rows] + way * (self.max_displacement / length.clamp_min(1e-12)).clamp_max(1.0)
        return bounded

    def query(self, points: Tensor, rows: Tensor) -> SdfSample:
        """The distance of `points` (R, 3), which are where vertices `rows` (R,) are or near there."""
        return self.sdf.query(points) if self.near is None else self.sdf.query(points, near=self.near[rows])

    def keep_better(self, rows: Tensor, moved: Tensor, sample: SdfSample) -> None:
        better = sample.distance > self.distance[rows]
        self.keep(rows[better], moved[better], sample.rows(better))

    def keep(self, rows: Tensor, moved: Tensor, sample: SdfSample) -> None:
        self.vertices[rows], self.distance[rows], self.gradient[rows] = moved, sample.distance, sample.gradient
        if self.near is not None and sample.face is not None:
            self.near[rows] = sample.face.to(self.near)

    def first_scale(self, scale: float | Tensor | VertexScale, rows: Tensor, distance: Tensor) -> Tensor:
        """α of the first push of `rows`, whose distance is given, shape (R,); large enough to take them outside."""
        if callable(scale) and not isinstance(scale, Tensor):
            alpha = scale(rows, distance)
        elif isinstance(scale, Tensor) and scale.ndim:
            alpha = scale[rows]
        else:
            alpha = torch.full_like(distance, float(scale))
        # Where α is below 1, the distance was predicted to exaggerate; its sign is trusted all the same.
        deficit, half = self.margin - distance, 0.5 * self.margin
        if half > 0:  # cloth stays in order: what is deeper ends lower, at half the margin at least
            alpha = alpha * (1 - half * (1 - torch.exp(-deficit / half)) / deficit)
        return torch.maximum(alpha, (min(self.tolerance, self.margin) - distance) / deficit)


def _push_blended(
    state: _State, rows: Tensor, sample: SdfSample, scale: Tensor, blend: Blend
) -> tuple[Tensor, SdfSample, Tensor]:
    """Pushes `rows` with their neighbourhood; returns those that aren't clear yet, their distances, and their α."""
    goal = torch.full_like(state.distance, state.margin)
    goal[rows] = (sample.distance + scale * (state.margin - sample.distance)).clamp_max(state.margin)
    is_pushed = torch.zeros_like(goal, dtype=torch.bool)
    is_pushed[rows] = True
    least = torch.full_like(goal, torch.inf)
    least[rows] = state.margin - sample.distance
    push = torch.zeros_like(state.origin)
    # Not by `repulse`: the least pushes are lost where they are added to a place.
    push[rows] = (scale * least[rows]).clamp_max(state.max_displacement)[:, None] * sample.gradient
    field = blend.spread(push[:, None], least=least[:, None])[:, 0]
    everyone = torch.nonzero((field != 0).any(dim=-1))[:, 0]
    moved = state.bounded(state.origin[everyone] + field[everyone], everyone)
    # No vertex gets nearer by more than it moves: those that stay beyond the margin needn't be asked.
    way = torch.linalg.vector_norm(moved - state.origin[everyone], dim=-1)
    floor = state.distance[everyone] - way
    is_near = is_pushed[everyone] | (floor < state.margin + state.tolerance)
    far = everyone[~is_near]
    state.vertices[far], state.distance[far] = moved[~is_near], floor[~is_near]

    asked, moved = everyone[is_near], moved[is_near]
    found = state.query(moved, asked)
    is_clear = found.distance >= goal[asked] - state.tolerance
    state.keep(asked[is_clear], moved[is_clear], found.rows(is_clear))
    # A neighbour that would come too close stays where it was; a pushed one goes on from the better of its two places.
    again = torch.nonzero(~is_clear & is_pushed[asked])[:, 0]
    is_better = found.distance[again] > state.distance[asked[again]]
    state.keep_better(asked[again], moved[again], found.rows(again))
    place = torch.empty_like(is_pushed, dtype=torch.int64)
    place[rows] = torch.arange(len(rows), device=rows.device)
    before = sample.rows(place[asked[again]])
    distance = torch.where(is_better, found.distance[again], before.distance)
    gradient = torch.where(is_better[:, None], found.gradient[again], before.gradient)
    rows = asked[again]
    return rows, SdfSample(distance, gradient), (goal[rows] - distance) / (state.margin - distance)


def _push(state: _State, rows: Tensor, sample: SdfSample, scale: Tensor, max_pushes: int) -> int:
    """Pushes `rows`, whose distance and gradient are `sample`, until they are clear; returns the rounds it took."""
    here, push, last = state.vertices[rows], scale, torch.zeros_like(sample.gradient)
    goal = (sample.distance + scale * (state.margin - sample.distance)).clamp_max(state.margin)
    for round_ in range(max_pushes):
        if not len(rows):
            return round_
        moved = repulse(here, sample, scale=push, margin=state.margin)
        here = state.bounded(moved, rows)
        last = sample.gradient
        sample = state.query(here, rows)
        state.keep_better(rows, here, sample)
        unclear = torch.nonzero(sample.distance < goal - state.tolerance)[:, 0]
        rows, here, last, goal = rows[unclear], here[unclear], last[unclear], goal[unclear]
        sample = sample.rows(unclear)
        push = torch.where((last * sample.gradient).sum(-1) < 0, 0.5, 1.0)
    return max_pushes


def _raise_edges(state: _State, edges: Tensor, max_rounds: int) -> int:
    """Raises both ends of the edges whose middle is closer to the body than half the margin; returns the rounds.

    The middle is no lower than either end by more than half the edge's length, whatever the skin is like. Most edges at
    the margin are longer than that can clear; of these the ones are asked for that skin may reach which bulges between
    their ends as far as a corner with the normals there does: around an elbow, a shoulder, a hand.
    """
    wanted = 0.5 * state.margin
    ends = state.distance[edges]
    first, second = edges.unbind(1)
    length = torch.linalg.vector_norm(state.vertices[first] - state.vertices[second], dim=-1)
    bulge = length / 4 * torch.linalg.vector_norm(state.gradient[first] - state.gradient[second], dim=-1)
    bulge *= state.gradient.any(dim=-1)[edges].all(dim=1)
    may_be_low = (ends.amax(dim=1) < wanted + 0.5 * length) & (ends.mean(dim=1) < wanted + bulge)
    low = edges[may_be_low & (ends.amin(dim=1) >= 0)]
    for round_ in range(max_rounds):
        # Both ends are often at the margin: rounding mustn't choose.
        of_first, of_second = state.distance[low].unbind(1)
        closer = torch.where(of_first <= of_second + state.tolerance, low[:, 0], low[:, 1])
        middle = state.query(state.vertices[low].mean(dim=1), closer)
        lack = wanted - middle.distance
        lack = lack * (2 - lack / _SETTINGS.gap).clamp(0, 1)
        is_low = lack > 0
        if not bool(is_low.any()):
            return round_
        low = low[is_low]
        deficit = lack[is_low].repeat_interleave(2)
        rise = deficit[:, None] * middle.gradient[is_low].repeat_interleave(2, dim=0)
        ends = low.reshape(-1)
        # A vertex of several low edges follows the lowest of them.
        largest = torch.zeros_like(state.distance).scatter_reduce(0, ends, deficit, "amax")
        wins = deficit == largest[ends]
        moves = torch.zeros_like(state.vertices).index_copy(0, ends[wins], rise[wins])
        rows = torch.nonzero(largest)[:, 0]
        moved = state.bounded(state.vertices[rows] + moves[rows], rows)
        sample = state.query(moved, rows)
        clear = sample.distance >= state.distance[rows].clamp_max(state.margin - state.tolerance)
        raised = rows[clear]
        state.keep(raised, moved[clear], sample.rows(clear))
        # Edges of which neither end could move have no room, and stay there.
        low = low[torch.isin(low, raised).any(dim=1)]
    return max_rounds
