"""Moves arms that are inside the body, or each other, aside, before skin gives way."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import embedding_bag

from refu_core._cache import remembered
from refu_core._warp import Recorded, Repeated, as_warp, ints, is_plain, memory, readable, refit
from refu_core.body import _aside_kernels as kernels
from refu_core.body._collider_gradient import weights_at, within
from refu_core.body._collider_kernels import Means
from refu_core.body._kinematics import rotvec_to_rotmat
from refu_core.body._model import SmplBody
from refu_core.body._parts import ARMS, joints_of, part_of_faces
from refu_core.body._segments import SOFTNESS, Solids, cut
from refu_core.mesh import Connectivity, linked

Array = NDArray[np.float64]

_SLICES = 24
"""Slices of a forearm with its hand: one every 2 cm, as thick as a finger."""
_FEWEST = 4
"""A piece with fewer vertices gets no middle."""
_UPPER_SLICES = 4
"""Slices of the half of an upper arm that is nearer to the elbow; the other half is too near its pivot to swing out.
With them 2.0 % of 343 recorded colliders are cut near a skinned shirt, without them 2.6 %. 2 to 6 slices do the same;
with 6, arms move aside in 25 % of the frames, with fewer in 16 %."""
_THIN = 0.02
"""A piece beside the palm with a smaller radius is a thumb [m]. It makes no dent that cloth could follow, whose edges
are about as long, and goes out as far beyond the surface as it was inside, until it is wholly out. Of 1,152 tops on
other studios' motion, 15 weren't free of the body without this; 8 aren't."""
_TINY = 1e-18  # added to a square [m²]
_FOREARMS = (joints_of("left_forearm"), joints_of("right_forearm"))
_UPPER_ARMS = (joints_of("left_upper_arm"), joints_of("right_upper_arm"))


class Aside:
    """Swings arms about their shoulders until no middle of an arm, palm, finger or thumb is inside the body or an arm.

    Flesh gives way to what dents it, but not to what is wholly inside: the two sides of a hand would move apart, and
    the skin around it has no reason to move at all. Cloth around a hip would have to go through the arm. A part whose
    middle is outside is inside by half of its thickness at most, so it is a dent. Only a thumb bores a hole narrower
    than the cloth's triangles, so it goes farther out.

    Each middle that is inside asks for the least turn that brings it to the surface, of both arms if it is inside the
    other one; deep ones count most. So arms move continuously, and where no middle is inside, nothing moves. The
    exception is an arm that is half-way through the trunk, a thigh or the other arm: there the nearest way out changes
    sides, and the arm leaps. In the other arm, which is thin, some middle is always close to that.
    """

    def __init__(self, body: SmplBody, mesh: Connectivity, *, farthest: float, rounds: int) -> None:
        """For a body with a closed `mesh`. No arm moves by more than `farthest` [m], in `rounds` Newton steps."""
        self._farthest, self._rounds = farthest, rounds
        device = self._device = body.device
        rest, weights, joints = (
            one.double().cpu().numpy() for one in (body.v_template, body.weights, body.joint_template)
        )
        self._is_serial = device.type == "cpu"
        share = np.stack([weights[:, list(one)].sum(1) for one in ARMS], axis=1)
        solids = cut(mesh.faces, np.concatenate((1 - share.sum(1, keepdims=True), share), axis=1))
        means = _means_of(rest, weights, joints, mesh, solids)
        self._first_cap = means.first_cap
        self._start, self._vertex = self._tensor(means.start), self._tensor(means.vertex)
        self._weight, self._arm = self._tensor(means.weight), self._tensor(means.arm)
        self._thumb = self._tensor(means.thumb)
        self._is_of = self._arm == torch.arange(len(ARMS), device=device)[:, None]
        """Which of the C middles belong to each arm, shape (2, C)."""
        self._share = self._tensor(share.T[:, :, None])
        """How much of a vertex moves with each arm, shape (2, V, 1)."""
        self._joints = [self._tensor(np.array(one, np.int64)) for one in ARMS]
        self._faces = self._tensor(np.concatenate(solids.faces).astype(np.int64))
        """Faces of the body without its arms and of each arm, all closed, shape (F, 3)."""
        self._corners = [self._tensor(np.unique(one)) for one in solids.faces]
        """The points of each of these solids."""
        self._box = memory(2, len(solids.faces), 3, device=device)
        """Their lowest and highest corners [m]."""
        self._points = memory(len(rest) + len(means.start) - self._first_cap, 3, device=device)
        at_rest = body.v_template.to(self._points)
        self._points.copy_(torch.cat((at_rest, self._means(at_rest)[self._first_cap :])))
        points = as_warp(self._points, wp.vec3)
        self._trees = [wp.Mesh(points, ints(one.ravel(), device)) for one in solids.faces]
        trees = wp.array([one.id for one in self._trees], dtype=wp.uint64, device=str(device))
        first_face = ints(np.cumsum([0, *map(len, solids.faces)]), device)
        box = [as_warp(corner, wp.vec3) for corner in self._box]
        known = [trees, first_face, *box]
        self._find = Repeated(kernels.inside_kernel, (wp.int32, wp.vec3, wp.int32, wp.vec3), known)
        self._asked = torch.cat((torch.zeros_like(self._arm), len(ARMS) - self._arm)).int()
        """The solids that middles are looked for in: the body, and then the other arm, shape (2 C,)."""
        if self._is_serial:
            self._look, places = self._recorded_look(solids, weights, box)
            self._looks = [
                self._recorded_find(known, asked, places, fitted)
                for asked, fitted in zip(self._asked.chunk(2), (self._trees[:1], self._trees[1:]), strict=True)
            ]

    def __call__(self, skin: Tensor, rotation: Tensor) -> tuple[Tensor, Tensor]:
        """One body's skin (V, 3) [m] and the joints' `rotation` (24, 3, 3), both with the arms moved aside.

        Differentiable. Where nothing is inside a CPU returns the very same tensors; on a GPU that isn't checked.
        """
        if self._is_serial and not self._is_any_inside(skin):
            return skin, rotation
        means = self._means(skin)
        pivots, middles = means[: len(ARMS)], means[len(ARMS) : self._first_cap]
        arm = middles - pivots[self._arm]
        points = torch.cat((skin, means[self._first_cap :]))
        if not self._is_serial:  # on a CPU the check above has fitted boxes and trees
            self._points.copy_(points.detach())
            self._box.copy_(torch.stack([torch.stack(self._points[one].aminmax(dim=0)) for one in self._corners], 1))
            refit(self._trees, self._device)
        longest = torch.where(self._is_of, arm.norm(dim=1), 0.0).amax(1)
        turn = skin.new_zeros(len(ARMS), 3)
        for _ in range(self._rounds):
            turn = turn + self._step(points, pivots, arm, turn)
            turn = within(turn, torch.zeros_like(turn), self._farthest / longest)
        turns = rotvec_to_rotmat(turn)
        for pivot, by, share, joints in zip(means, turns, self._share.to(skin), self._joints, strict=False):
            skin = skin + share * ((skin - pivot) @ by.T - (skin - pivot))
            rotation = rotation.index_copy(0, joints, by @ rotation[joints])
        return skin, rotation

    def _step(self, points: Tensor, pivots: Tensor, arm: Tensor, turn: Tensor) -> Tensor:
        """How much farther each arm has to turn [rad], shape (2, 3): a Newton step.

        A middle with the lever r from its shoulder and the way out w asks for the least turn that takes it there,
        r × w / r². Inside the other arm it asks both, for r × w / (r² + s²) and -s × w / (r² + s²), where s is its
        lever from the other shoulder. An arm turns by the mean of what is asked of it, weighted by w².

        Args:
            points: The skin and the caps before any arm turned [m].
            pivots: The shoulders [m], shape (2, 3).
            arm: The middles before, from their shoulders [m], shape (C, 3).
            turn: How far each arm has turned [rad], shape (2, 3).
        """
        turns, of = rotvec_to_rotmat(turn), self._arm
        other, by_other = pivots.flip(0)[of], turns.flip(0)[of]
        at = (turns[of] @ arm[..., None])[..., 0]
        from_other = pivots[of] + at - other
        # The other arm's tree hasn't turned, so the middle is turned back with it.
        seen = other + (from_other[:, None] @ by_other)[:, 0]
        of_body, of_arm = self._way_out(points, torch.cat((pivots[of] + at, seen))).view(2, -1, 3)
        of_arm = (by_other @ of_arm[..., None])[..., 0]
        lever, way = torch.stack((at, at, from_other)), torch.stack((of_body, of_arm, -of_arm))
        lever2, way2 = lever.square().sum(2, keepdim=True), way.square().sum(2, keepdim=True)
        both2 = lever2 + torch.stack((torch.zeros_like(lever2[0]), lever2[2], lever2[1]))
        asked = torch.linalg.cross(lever, way) / both2
        is_of = self._is_of.to(arm)
        whose = torch.cat((is_of, is_of, is_of.flip(0)), 1)
        total = whose @ way2.flatten(0, 1)
        step: Tensor = whose @ (way2 * asked).flatten(0, 1) / torch.where(total > 0, total, 1.0)
        return step

    def _means(self, skin: Tensor) -> Tensor:
        return embedding_bag(self._vertex, skin, self._start, mode="sum", per_sample_weights=self._weight.to(skin))

    def _recorded_look(self, solids: Solids, weights: Array, box: list[Any]) -> tuple[Recorded, Tensor]:
        """A launch that finds boxes, caps and middles (C, 3), and counts middles near each solid (`_n_near`)."""
        corners, solid, parts = [], [], [joints for joints, _ in SOFTNESS]
        for s, faces in enumerate(solids.faces):
            own = faces[(faces < len(weights)).all(1)]
            part_of = part_of_faces(torch.from_numpy(weights), torch.from_numpy(own).long(), parts).numpy()
            for k in np.unique(part_of):
                corners.append(np.unique(own[part_of == k]))
                solid.append(s)
        means, n_middles = Means(), len(self._arm)
        start = np.append(self._start.numpy(), len(self._vertex))[len(ARMS) :]  # of all but the shoulders
        means.start, means.vertex = ints(start, "cpu"), ints(self._vertex, "cpu")
        segments = (np.cumsum([0, *map(len, corners)]), np.concatenate(corners), solid)
        means.weight = wp.array(self._weight.numpy(), dtype=wp.float32, device="cpu")
        places, n_near = memory(len(start) - 1, 3), memory(len(self._trees), dtype=torch.int32)
        self._n_near = readable(n_near)
        means.mean = as_warp(places, wp.vec3)
        arguments = [as_warp(self._points, wp.vec3), len(weights), ints(self._arm, "cpu"), means]
        arguments += [*(ints(one, "cpu") for one in segments), *box, as_warp(n_near, wp.int32)]
        return Recorded(kernels.near_kernel, 1, arguments, "cpu"), places[:n_middles]

    def _recorded_find(
        self, known: list[Any], asked: Tensor, places: Tensor, trees: list[Any]
    ) -> tuple[list[Any], Recorded, NDArray[Any]]:
        """Trees, a launch that looks for the middles at `places` (C, 3) in these, and the faces that it finds."""
        face, weights = memory(len(places), dtype=torch.int32), memory(len(places), 3)
        found = [as_warp(one, kind) for one, kind in ((asked, wp.int32), (places, wp.vec3), (face, wp.int32))]
        launch = Recorded(kernels.inside_kernel, len(places), [*known, *found, as_warp(weights, wp.vec3)], "cpu")
        return trees, launch, readable(face)

    def _is_any_inside(self, skin: Tensor) -> bool:
        """Whether any middle is inside the body or the other arm. A tree is asked only if one is near its solid.

        Only for a CPU. Where this is true, boxes and trees have been fitted to `skin`.
        """
        self._points[: len(skin)].copy_(skin.detach())
        self._look.launch()
        is_near = (bool(self._n_near[0]), bool(self._n_near[1:].any()))
        found = False
        for (trees, look, faces), is_asked in zip(self._looks, is_near, strict=True):
            if is_asked:
                refit(trees, self._device)
                look.launch()
                found |= bool(faces.max() >= 0)
        for (trees, *_), is_fitted in zip(self._looks, is_near, strict=True):
            if found and not is_fitted:
                refit(trees, self._device)
        return found

    def _inside(self, at: Tensor) -> tuple[Tensor, Tensor]:
        """The solids' closest faces to the middles at (2 C, 3) [m], -1 outside, and the weights of their corners."""
        at = at.detach().float().contiguous()
        face, weights = torch.empty(len(at), dtype=torch.int32, device=self._device), torch.zeros_like(at)
        self._find((len(at),), self._asked, at, face, weights)
        return face, weights

    def _way_out(self, points: Tensor, at: Tensor) -> Tensor:
        """The way out of the body and of the other arm (2 C, 3) [m], from the middles; zeros for those outside."""
        face, known = self._inside(at)
        corners = points[self._faces[face.clamp_min(0).long()]]
        weights = known if is_plain(points) else weights_at(at, corners, known.to(at))
        out = (weights[..., None] * corners).sum(1) - at
        depth = (out * out).sum(1, keepdim=True).clamp_min(_TINY).sqrt()
        out = out + (self._thumb.repeat(2, 1) / depth).clamp(max=1.0) * out
        return torch.where((face >= 0)[:, None], out, torch.zeros_like(out))

    def _tensor(self, values: NDArray[Any]) -> Tensor:
        return torch.as_tensor(np.ascontiguousarray(values), device=self._device)


class _Averaged(NamedTuple):
    """The skin that is averaged: around each shoulder, in the pieces of the arms, and where they were cut off."""

    start: NDArray[np.int64]
    """Where the vertices of each row begin, shape (R,)."""
    vertex: NDArray[np.int64]
    """Shape (E,)."""
    weight: Array
    """How much each vertex counts; those of a row sum to one, shape (E,)."""
    arm: NDArray[np.int64]
    """Which arm each of the pieces is of, shape (C,)."""
    thumb: NDArray[np.float32]
    """Radius of a piece of a thumb [m], else 0, shape (C, 1)."""
    first_cap: int
    """The first row of those where an arm was cut off."""


@remembered(4)  # every pipeline of a body asks for the same
def _means_of(rest: Array, weights: Array, joints: Array, mesh: Connectivity, solids: Solids) -> _Averaged:
    """Of a body's skin (V, 3) [m], skinning weights (V, 24) and joints (24, 3) [m], cut into `solids`."""
    share = np.stack([weights[:, list(one)].sum(1) for one in ARMS])
    rows = [np.clip(0.25 - np.abs(one - 0.5), 0.0, None) for one in share]
    arm: list[int] = []
    thumbs: list[float] = []
    for i, (fore, upper) in enumerate(zip(_FOREARMS, _UPPER_ARMS, strict=True)):
        shoulder, elbow, hand = joints[upper[0]], joints[fore[0]], joints[fore[-1]]
        is_fore, is_upper = (weights[:, list(one)].sum(1) > 0.5 for one in (fore, upper))
        is_upper &= (rest - (shoulder + elbow) / 2) @ (elbow - shoulder) > 0
        is_hand = weights[:, list(fore[1:])].sum(1) > 0.5
        pieces = _pieces(rest, mesh, is_fore, hand - elbow, _SLICES, is_hand)
        pieces += _pieces(rest, mesh, is_upper, elbow - shoulder, _UPPER_SLICES, is_hand)
        for members, thumb in pieces:
            rows.append(members)
            thumbs.append(thumb)
            arm.append(i)
    first_cap = len(rows)
    caps = np.split(solids.middle_vertex, solids.middle_start[1:-1])
    rows += [np.bincount(some, minlength=len(rest)).astype(np.float64) for some in caps]
    row, vertex = np.nonzero(rows)
    weight = np.stack(rows)[row, vertex]
    return _Averaged(
        np.searchsorted(row, np.arange(len(rows))),
        vertex,
        weight / np.bincount(row, weight)[row],
        np.array(arm, np.int64),
        np.array(thumbs, np.float32)[:, None],
        first_cap,
    )


def _pieces(
    rest: Array, mesh: Connectivity, is_on: NDArray[np.bool_], along: Array, n_slices: int, is_hand: NDArray[np.bool_]
) -> list[tuple[Array, float]]:
    """Each connected piece of each slice of an arm's part: fingers are separate pieces, thumbs beside the palm.

    Which vertices it has, 1 or 0, (V,), and its radius if it is a thumb's [m], else 0.
    """
    (on,) = np.nonzero(is_on)
    height = rest[on] @ along
    slices = np.full(len(rest), -1)
    slices[on] = np.digitize(height, np.linspace(height.min(), height.max(), n_slices + 1)[1:-1])
    of_ends = slices[mesh.edges]
    _, piece = linked(mesh.edges[(of_ends[:, 0] == of_ends[:, 1]) & (of_ends[:, 0] >= 0)], len(rest))
    names, sizes = np.unique(piece[on], return_counts=True)
    members = [np.flatnonzero(piece == name) for name in names[sizes >= _FEWEST]]
    radius = [float(np.linalg.norm(rest[some] - rest[some].mean(0), axis=1).mean()) for some in members]
    thick = {slices[some[0]] for some, r in zip(members, radius, strict=True) if r >= _THIN}
    return [
        (
            np.bincount(some, minlength=len(rest)).astype(np.float64),
            r if r < _THIN and slices[some[0]] in thick and is_hand[some].mean() > 0.5 else 0.0,
        )
        for some, r in zip(members, radius, strict=True)
    ]
