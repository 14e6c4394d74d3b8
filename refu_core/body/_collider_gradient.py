"""The collider in torch, differentiable: kernels find the closest faces, and torch computes everything else again."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from refu_core._warp import as_torch
from refu_core.body import _collider_kernels as kernels
from refu_core.body._creases import LEVELS
from refu_core.skeleton import PARENTS

if TYPE_CHECKING:
    from refu_core.body._anatomy import Anatomy
    from refu_core.body._collider import Collider


def part_with_gradient(collider: Collider, skin: Tensor, rotation: Tensor) -> Tensor:
    """As `Collider._part`, differentiable in `skin` (V, 3) and the joints' `rotation` (24, 3, 3), in any precision."""
    how, known = collider.settings, collider.anatomy
    farthest, own = known.farthest.to(skin), known.own
    p = skin
    between, bent = _between(rotation)
    for _ in range(how.crease_rounds):
        p = p + _crease_step(known, skin, p, between, bent)
    is_moved = _is_around(known, (p != skin).any(1))
    p = within(p, skin, farthest)
    p = _smooth(known, skin, p, is_moved, how.smooth_first)
    points = torch.cat((p, _means(known.caps, p)))
    touched = collider.touched(p)
    normals = _unit(torch.einsum("vj,jab,vb->va", known.weights.to(p), rotation, known.normals.to(p)))
    start = p
    vertex, segment = torch.nonzero(touched, as_tuple=True)
    ratio, keeps = known.ratio[own[vertex], segment].to(p), known.kept[vertex, segment].to(p)
    for _ in range(how.part_rounds):
        sunk = ((start - p) * normals).sum(1)
        step = _ways_out(
            known, points, normals, p[vertex], normals[vertex], sunk[vertex], segment, ratio=ratio, keeps=keeps
        )
        p = p + _together(step, vertex, len(p))
    is_parted = (p != start).any(1)
    p = torch.where(is_parted[:, None], within(p, skin, farthest), p)
    p = _smooth(known, skin, p, is_moved | _is_around(known, is_parted), how.smooth_last)
    for _ in range(how.edge_rounds):
        step = _edge_step(known, points, normals, start, p, touched)
        is_raised = (step.detach() != 0).any(1)
        p = torch.where(is_raised[:, None], within(p + step, skin, farthest), p)
    return p


def _means(of: Any, points: Tensor) -> Tensor:
    """The weighted means that a `Means` describes, of points (V, 3) [m]."""
    start, vertex, weight = (as_torch(one) for one in (of.start, of.vertex, of.weight))
    n = len(start) - 1
    owner = torch.repeat_interleave(torch.arange(n, device=points.device), start.long().diff())
    return points.new_zeros(n, 3).index_add(0, owner, points[vertex.long()] * weight.to(points)[:, None])


def within(p: Tensor, skin: Tensor, farthest: Tensor) -> Tensor:
    """Points (V, 3), each pulled back to within `farthest` (V,) of its `skin` (V, 3), all [m]; or turns, all [rad]."""
    away = p - skin
    squared = (away * away).sum(1, keepdim=True)
    farthest = farthest[:, None]
    is_far = squared > farthest**2
    return torch.where(is_far, skin + farthest / torch.where(is_far, squared, 1.0).sqrt() * away, p)


def _between(rotation: Tensor) -> tuple[Tensor, Tensor]:
    """Rotations between each joint's parent and the joint, one per level, (24 L, 3, 3), and how bent it is, (24 L,)."""
    above = rotation[[max(parent, 0) for parent in PARENTS]]
    turn = above.transpose(1, 2) @ rotation
    w = 0.5 * (1 + turn.diagonal(dim1=1, dim2=2).sum(1)).clamp_min(1e-6).sqrt()
    axis = torch.stack(
        (turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]), 1
    ) / (4 * w[:, None])
    level = rotation.new_tensor(LEVELS)
    q = torch.cat((level[None, :, None] * axis[:, None], (level * w[:, None] + 1 - level)[..., None]), -1)
    x, y, z, r = _unit(q).unbind(-1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * r), 2 * (x * z + y * r)),
        (2 * (x * y + z * r), 1 - 2 * (x * x + z * z), 2 * (y * z - x * r)),
        (2 * (x * z - y * r), 2 * (y * z + x * r), 1 - 2 * (x * x + y * y)),
    )
    matrix = torch.stack([torch.stack(row, -1) for row in rows], -2)
    bent = ((kernels.STRAIGHT - w) / (kernels.STRAIGHT - kernels.BENT)).clamp(0, 1)
    return (above[:, None] @ matrix).flatten(0, 1), bent.repeat_interleave(len(LEVELS))


def _crease_step(known: Anatomy, skin: Tensor, p: Tensor, between: Tensor, bent: Tensor) -> Tensor:
    seams, stations = known.creases, _means(known.stations, skin)
    weights = torch.from_numpy(seams.weights).to(p)
    through = (stations[torch.from_numpy(seams.stations).long()] * weights[..., None]).sum(1)
    of_seam = torch.from_numpy(seams.rotation).long()
    normal = (between[of_seam] @ torch.from_numpy(seams.normal).to(p)[..., None])[..., 0]
    vertex = torch.from_numpy(seams.vertex).long().to(p.device)
    lacks = bent[of_seam] * (known.least.to(p) - ((p[vertex] - through) * normal).sum(1))
    return _together(lacks.clamp_min(0)[:, None] * normal, vertex, len(p))


def _smooth(known: Anatomy, skin: Tensor, p: Tensor, is_moved: Tensor, sweeps: int) -> Tensor:
    how, squared = known.settings, ((p - skin) ** 2).sum(1)
    # Where nothing was moved, the length has no derivative.
    has_way = squared.detach() > 0
    around = _largest_around(known, torch.where(has_way, torch.where(has_way, squared, 1.0).sqrt(), 0.0))
    around = torch.minimum(around, known.farthest.to(skin))
    share = ((around / how.smooth_full).clamp_max(1) * how.smooth_step)[:, None]
    start, ring = known.mesh.ring
    owner = torch.from_numpy(known.mesh.ring.owner).to(p.device)
    degree = torch.from_numpy(start).diff().to(p)[:, None]
    for _ in range(sweeps):
        mean = torch.zeros_like(p).index_add(0, owner, p[torch.from_numpy(ring).long()]) / degree
        p = torch.where(is_moved[:, None], within(p + share * (mean - p), skin, around), p)
    return p


def _largest_around(known: Anatomy, values: Tensor) -> Tensor:
    """The largest value among each vertex and its neighbours, of values (V,)."""
    ring = known.mesh.ring
    neighbour, owner = (torch.from_numpy(one).long().to(values.device) for one in (ring.items, ring.owner))
    return values.scatter_reduce(0, owner, values[neighbour], "amax")


def _is_around(known: Anatomy, chosen: Tensor) -> Tensor:
    """Which vertices are chosen themselves, or have a neighbour that is, bool, shape (V,)."""
    return _largest_around(known, chosen.float()) > 0


def _ways_out(
    known: Anatomy,
    points: Tensor,
    normals: Tensor,
    p: Tensor,
    normal: Tensor,
    sunk: Tensor,
    segment: Tensor,
    *,
    ratio: Tensor,
    keeps: Tensor,
) -> Tensor:
    """How each of the points (N, 3) [m] gives way to its own `segment`, shape (N, 3); zeros where it needn't."""
    face, about, sign = _closest(known, p, segment)
    corners = known.faces[face.clamp_min(0)]
    weights = weights_at(p, points[corners], about.to(p))
    away = p - (weights[..., None] * points[corners]).sum(1)
    squared = (away * away).sum(1)
    distance = sign.to(p) * torch.where(squared > 0, squared, 1.0).sqrt() * (squared > 0)
    lacks = keeps - distance - ratio * sunk
    padded = torch.cat((normals, normals.new_zeros(len(points) - len(normals), 3)))
    other = _unit((weights[..., None] * padded[corners]).sum(1))
    way = _unit(other - (other * normal).sum(1, keepdim=True).clamp_min(0) * normal - normal)
    rate = (way * other).sum(1) - ratio * (way * normal).sum(1)
    step = (lacks / torch.minimum(torch.maximum(rate, 0.5 + 0.5 * ratio), 1 + ratio))[:, None] * way
    is_needed = (face >= 0) & (lacks > 0)
    return torch.where(is_needed[:, None], step, torch.zeros_like(step))


@torch.no_grad()
def _closest(known: Anatomy, points: Tensor, segment: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Where each of the points (N, 3) [m] is closest to its own segment (N,), in the pose last given to `touched`.

    The face (N,), -1 for none near; the weights of its corners (N, 3); and the sign of the distance (N,), -1 inside.
    """
    points, segment = points.float().contiguous(), segment.int()
    face, weights, sign = torch.zeros_like(segment), torch.zeros_like(points), torch.zeros_like(points[:, 0])
    known.ask_closest((len(points),), points, segment, face, weights, sign)
    return face.long(), weights, sign


def weights_at(p: Tensor, corners: Tensor, about: Tensor) -> Tensor:
    """Weights of a triangle's corners at its point closest to p, shape (N, 3).

    The rough weights `about` say whether that point is within the face, on an edge or at a corner.
    """
    a, b, c = corners.unbind(1)
    is_on = about > _ON
    ab, ac, ap = b - a, c - a, p - a
    d00, d01, d11 = (ab * ab).sum(1), (ab * ac).sum(1), (ac * ac).sum(1)
    d20, d21 = (ap * ab).sum(1), (ap * ac).sum(1)
    area = (d00 * d11 - d01 * d01).clamp_min(1e-30)
    v, w = (d11 * d20 - d01 * d21) / area, (d00 * d21 - d01 * d20) / area
    within = torch.stack((1 - v - w, v, w), 1)
    first, second = (is_on * about.new_tensor((3.0, 2.0, 1.0))).topk(2, dim=1).indices.unbind(1)
    rows = torch.arange(len(p), device=p.device)
    start, end = corners[rows, first], corners[rows, second]
    along = end - start
    t = ((p - start) * along).sum(1) / (along * along).sum(1).clamp_min(1e-30)
    t = torch.where(is_on.sum(1) > 1, t, torch.zeros_like(t))
    zeros = torch.zeros_like(within)
    on_edge = zeros.index_put((rows, first), 1 - t).index_put((rows, second), t, accumulate=True)
    return torch.where(is_on.all(1)[:, None], within, on_edge)


def _edge_step(known: Anatomy, points: Tensor, normals: Tensor, start: Tensor, p: Tensor, touched: Tensor) -> Tensor:
    own = known.own
    v, w = known.edges.T
    gone = start - p
    squared = ((gone[v] - gone[w]) ** 2).sum(1)
    steep = known.settings.steep
    share = (torch.where(squared > steep**2, squared, 1.0).sqrt() / steep - 1).clamp_max(1)
    is_steep = squared > steep**2
    either = (touched[v] | touched[w]) & is_steep[:, None]
    edge, segment = torch.nonzero(either, as_tuple=True)
    v, w = v[edge], w[edge]
    is_other = (segment != own[v]) & (segment != own[w])
    edge, segment, v, w = edge[is_other], segment[is_other], v[is_other], w[is_other]
    sunk = 0.5 * ((gone[v] * normals[v]).sum(1) + (gone[w] * normals[w]).sum(1))
    keeps = torch.minimum(known.kept[v, segment], known.kept[w, segment]).to(p)
    ratio = known.ratio[own[v], segment].to(p)
    normal = _unit(normals[v] + normals[w])
    middle = 0.5 * (p[v] + p[w])
    step = _ways_out(known, points, normals, middle, normal, sunk, segment, ratio=ratio, keeps=keeps)
    one_an_edge = _together(step, edge, len(known.edges)) * (share * is_steep)[:, None]
    v, w = known.edges.T
    return _together(torch.cat((one_an_edge, one_an_edge)), torch.cat((v, w)), len(p))


def _together(steps: Tensor, owner: Tensor, n: int) -> Tensor:
    """Combines the steps (N, 3) of each owner into one, shape (n, 3): their mean, weighted by squared length.

    Taking the longest step alone would make the direction jump where two are equally long.
    """
    squared = (steps * steps).sum(1, keepdim=True)
    total = steps.new_zeros(n, 1).index_add(0, owner, squared)
    mean = steps.new_zeros(n, 3).index_add(0, owner, squared * steps)
    return mean / torch.where(total > 0, total, 1.0)


def _unit(vectors: Tensor) -> Tensor:
    return vectors / (vectors * vectors).sum(-1, keepdim=True).clamp_min(1e-24).sqrt()


_ON = 1e-6
"""A closest point that has a smaller weight than this at a corner lies on the opposite edge."""
