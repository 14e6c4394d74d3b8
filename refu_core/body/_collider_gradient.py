"""The collider in torch, with its derivative: kernels find what is closest to what, all else is computed anew."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from refu_core.body import _collider_kernels as kernels
from refu_core.body._closest import weights_at
from refu_core.body._creases import LEVELS
from refu_core.body._kinematics import PARENTS

if TYPE_CHECKING:
    from refu_core.body._collider import Collider


def part_with_gradient(collider: Collider, skin: Tensor, rotation: Tensor) -> Tensor:
    """As `Collider._part`, differentiable in `skin` (V, 3) and the joints' `rotation` (24, 3, 3), in any precision."""
    how = collider.settings
    p = skin
    is_moved = torch.zeros(len(skin), dtype=torch.bool, device=skin.device)
    between, bent = _between(rotation)
    for _ in range(how.crease_rounds):
        step = _crease_step(collider, skin, p, between, bent)
        is_moved = is_moved | (step.detach() != 0).any(1)
        p = p + step
    p = _within(p, skin, collider.anatomy.farthest.to(skin))
    p = _smooth(collider, skin, p, is_moved, how.smooth_first)
    points = collider.with_caps(p)
    touched = collider.touched(p)
    normals = _unit(
        torch.einsum("vj,jab,vb->va", collider.anatomy.weights.to(p), rotation, collider.anatomy.normals.to(p))
    )
    start, own = p, collider.anatomy.own
    vertex, segment = torch.nonzero(touched, as_tuple=True)
    for _ in range(how.part_rounds):
        sunk = ((start - p) * normals).sum(1)
        ratio, keeps = collider.anatomy.ratio[own[vertex], segment].to(p), collider.anatomy.kept[vertex, segment].to(p)
        step = _ways_out(
            collider, points, normals, p[vertex], normals[vertex], sunk[vertex], segment, ratio=ratio, keeps=keeps
        )
        step = _together(step, vertex, len(p))
        is_moved = is_moved | (step.detach() != 0).any(1)
        p = p + step
    is_parted = (p.detach() != start.detach()).any(1)
    p = torch.where(is_parted[:, None], _within(p, skin, collider.anatomy.farthest.to(skin)), p)
    p = _smooth(collider, skin, p, is_moved, how.smooth_last)
    for _ in range(how.edge_rounds):
        step = _edge_step(collider, points, normals, start, p, touched)
        is_raised = (step.detach() != 0).any(1)
        p = torch.where(is_raised[:, None], _within(p + step, skin, collider.anatomy.farthest.to(skin)), p)
    return p


def _within(p: Tensor, skin: Tensor, farthest: Tensor) -> Tensor:
    """Points (V, 3) [m], or what is `farthest` (V,) [m] from the skin on the way to each of them."""
    away = p - skin
    squared = (away * away).sum(1, keepdim=True)
    farthest = farthest[:, None]
    is_far = squared > farthest**2
    return torch.where(is_far, skin + farthest / torch.where(is_far, squared, 1.0).sqrt() * away, p)


def _between(rotation: Tensor) -> tuple[Tensor, Tensor]:
    """Rotations on the way from a joint's parent to it, one a level, (24 L, 3, 3), and how bent it is, (24 L,)."""
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


def _crease_step(collider: Collider, skin: Tensor, p: Tensor, between: Tensor, bent: Tensor) -> Tensor:
    seams = collider.anatomy.creases
    n_stations = len(seams.station_start) - 1
    of_station = torch.repeat_interleave(torch.arange(n_stations), torch.as_tensor(seams.station_start).long().diff())
    weighted = skin[torch.as_tensor(seams.station_vertex).long()] * torch.as_tensor(seams.station_weight).to(p)[:, None]
    stations = p.new_zeros(n_stations, 3).index_add(0, of_station.to(p.device), weighted)
    weights = torch.as_tensor(seams.weights).to(p)
    through = (stations[torch.as_tensor(seams.stations).long()] * weights[..., None]).sum(1)
    of_seam = torch.as_tensor(seams.rotation).long()
    rotated = between[of_seam]
    normal = (rotated @ torch.as_tensor(seams.normal).to(p)[..., None])[..., 0]
    vertex = torch.as_tensor(seams.vertex).long().to(p.device)
    lacks = bent[of_seam] * (collider.anatomy.least.to(p) - ((p[vertex] - through) * normal).sum(1))
    return _together(lacks.clamp_min(0)[:, None] * normal, vertex, len(p))


def _smooth(collider: Collider, skin: Tensor, p: Tensor, is_moved: Tensor, sweeps: int) -> Tensor:
    how = collider.settings
    away = p - skin
    # Where nothing was moved the length's derivative has no direction.
    length = torch.where(is_moved, (away * away).sum(1), 1.0).sqrt()
    share = torch.where(is_moved, (length / how.smooth_full).clamp_max(1) * how.smooth_step, 0.0)[:, None]
    start, ring = collider.anatomy.mesh.ring
    owner = torch.as_tensor(collider.anatomy.mesh.ring.owner).to(p.device)
    degree = torch.as_tensor(start).diff().to(p)[:, None]
    for _ in range(sweeps):
        mean = torch.zeros_like(p).index_add(0, owner, p[torch.as_tensor(ring).long()]) / degree
        p = torch.where(is_moved[:, None], _within(p + share * (mean - p), skin, collider.anatomy.farthest.to(skin)), p)
    return p


def _ways_out(
    collider: Collider,
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
    """How points (N, 3) [m] give way to a segment each, shape (N, 3); zeros where they needn't."""
    found = collider.closest(p, segment)
    corners = collider.anatomy.faces[found.face.clamp_min(0)]
    weights = weights_at(p, points[corners], found.weights.to(p))
    away = p - (weights[..., None] * points[corners]).sum(1)
    squared = (away * away).sum(1)
    distance = found.sign.to(p) * torch.where(squared > 0, squared, 1.0).sqrt() * (squared > 0)
    lacks = keeps - distance - ratio * sunk
    padded = torch.cat((normals, normals.new_zeros(len(points) - len(normals), 3)))
    other = _unit((weights[..., None] * padded[corners]).sum(1))
    way = _unit(other - (other * normal).sum(1, keepdim=True).clamp_min(0) * normal - normal)
    rate = (way * other).sum(1) - ratio * (way * normal).sum(1)
    step = (lacks / torch.minimum(torch.maximum(rate, 0.5 + 0.5 * ratio), 1 + ratio))[:, None] * way
    is_needed = (found.face >= 0) & (lacks > 0)
    return torch.where(is_needed[:, None], step, torch.zeros_like(step))


def _edge_step(
    collider: Collider, points: Tensor, normals: Tensor, start: Tensor, p: Tensor, touched: Tensor
) -> Tensor:
    own = collider.anatomy.own
    v, w = collider.anatomy.edges.T
    gone = start - p
    squared = ((gone[v] - gone[w]) ** 2).sum(1)
    steep = collider.settings.steep
    share = (torch.where(squared > steep**2, squared, 1.0).sqrt() / steep - 1).clamp_max(1)
    is_steep = squared > steep**2
    either = (touched[v] | touched[w]) & is_steep[:, None]
    edge, segment = torch.nonzero(either, as_tuple=True)
    v, w = v[edge], w[edge]
    is_other = (segment != own[v]) & (segment != own[w])
    edge, segment, v, w = edge[is_other], segment[is_other], v[is_other], w[is_other]
    sunk = 0.5 * ((gone[v] * normals[v]).sum(1) + (gone[w] * normals[w]).sum(1))
    keeps = torch.minimum(collider.anatomy.kept[v, segment], collider.anatomy.kept[w, segment]).to(p)
    ratio = collider.anatomy.ratio[own[v], segment].to(p)
    normal = _unit(normals[v] + normals[w])
    middle = 0.5 * (p[v] + p[w])
    step = _ways_out(collider, points, normals, middle, normal, sunk, segment, ratio=ratio, keeps=keeps)
    one_an_edge = _together(step, edge, len(collider.anatomy.edges)) * (share * is_steep)[:, None]
    v, w = collider.anatomy.edges.T
    return _together(torch.cat((one_an_edge, one_an_edge)), torch.cat((v, w)), len(p))


def _together(steps: Tensor, owner: Tensor, n: int) -> Tensor:
    """The steps (N, 3) of each owner as one, shape (n, 3): their mean by the square of their lengths.

    With the longest one alone the way would leap to another side where two are equally long.
    """
    squared = (steps * steps).sum(1, keepdim=True)
    total = steps.new_zeros(n, 1).index_add(0, owner, squared)
    mean = steps.new_zeros(n, 3).index_add(0, owner, squared * steps)
    return mean / torch.where(total > 0, total, 1.0)


def _unit(vectors: Tensor) -> Tensor:
    return vectors / (vectors * vectors).sum(-1, keepdim=True).clamp_min(1e-24).sqrt()
