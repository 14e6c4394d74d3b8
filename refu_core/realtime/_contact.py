"""Collision handling of a frame: brings garments off one posed body, and off each other."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from refu_core.contact import (
    ASKED_FROM,
    DEFAULT_CONTACT,
    ContactSettings,
    Layer,
    LimbMeshes,
    OwnSide,
    Parting,
    Press,
    Resolution,
    Resolver,
    Sheet,
    StrainLimit,
    Unfold,
    WayOut,
)
from refu_core.garments import GarmentTemplate, inner_first
from refu_core.mesh import Connectivity
from refu_core.modes import SdfMode
from refu_core.realtime._wearer import Outfit
from refu_core.refu import VertexScale
from refu_core.sdf import ApproxSdf, MeshSdf, SdfSample, exact_sdf


class Worn(NamedTuple):
    """One garment of one person, in the root's axes."""

    vertices: Tensor
    """[m], shape (V, 3)."""
    raw: Tensor
    """The same before collision handling [m], shape (V, 3)."""
    numbers: Tensor
    """`n_inside`, `n_pushed`, `n_unresolved`, `max_depth` and `n_layered` of a `GarmentStats`, float32, shape (5,)."""
    n_clipped: int | Tensor
    """How many vertices are so far off that their distance wasn't computed."""


N_NUMBERS = 5
_N_UNRESOLVED = 2


class ContactStage:
    """Brings the garments of one person off the body and each other, from the skin outwards."""

    def __init__(
        self,
        outfit: Outfit,
        *,
        sdf: SdfMode,
        certify: bool = True,
        settings: ContactSettings = DEFAULT_CONTACT,
    ) -> None:
        """Uses the exact distance if `sdf` is accurate, or else the approximate one.

        With `certify`, vertices that winding numbers find inside are brought out, and those without a way out are
        counted.
        """
        self._outfit, self._settings = outfit, settings
        body, garments = outfit.body, {name: one.template for name, one in outfit.wearables.items()}
        self._is_serial = body.device.type == "cpu"
        self.sdf: MeshSdf = exact_sdf(body) if sdf is SdfMode.ACCURATE else ApproxSdf(body)
        self._skin = Sheet(Connectivity.of(body.faces.cpu(), body.n_vertices), body.v_template)
        self.way_out = WayOut(self._skin, settings=settings) if certify else None
        self.order = inner_first(garments)
        """Names from the skin outwards."""
        self._has_room = outfit.collider is not None
        """Whether a collider makes room for cloth beside limbs."""
        if outfit.collider is not None:
            self._limbs = LimbMeshes(body)
            thickness = outfit.collider.anatomy.thickness
            self.own_sides = {
                name: OwnSide(one, outfit.below[name].mean(thickness), settings=settings)
                for name, one in garments.items()
            }
            self._press = {
                name: Press(one.template, self._limbs, knows_arms=one.knows_arms, settings=settings)
                for name, one in outfit.wearables.items()
            }
            self._off_skin = {
                name: Parting(one.mesh, one.v_template, self._skin, settings=settings) for name, one in garments.items()
            }
        self._skin_of: dict[str, Tensor] = {}
        self._asked = {name: self.sdf.of_garment(one) for name, one in garments.items()}
        self.resolvers = {n: Resolver(one.faces, one.n_vertices, settings=settings) for n, one in garments.items()}
        self._strain = {name: StrainLimit(one.mesh, body.device, settings=settings) for name, one in garments.items()}
        self._unfold = {
            name: Unfold(one, [other for other in garments.values() if other is not one], settings=settings)
            for name, one in garments.items()
            if len(garments) > 1
        }
        self._layers = {
            name: {inner: _layer(garments[name], garments[inner], settings) for inner in self.order[:i]}
            for i, name in enumerate(self.order)
        }
        self._tucks = {
            name: {
                outer: _tuck(garments[name], garments[outer], settings)
                for outer in self.order[i + 1 :]
                if _is_too_wide(garments[name], garments[outer], self._layers[outer][name], settings)
            }
            for i, name in enumerate(self.order)
        }

    def update(self, body: Tensor) -> None:
        """Takes over the body's new pose (V, 3) [m]. Raises `MeshError` for a body that isn't finite."""
        self._body, self._skin_of = body, {}
        self.sdf.update(body)
        self._skin.take(body)
        if self._has_room:
            self._limbs.update(body)

    def unfold(self, name: str, vertices: Tensor, rotation: Tensor) -> Tensor:
        """Vertices (V, 3) [m], levelled where folded over beside another garment, for joint rotations (24, 3, 3)."""
        return self._unfold[name](vertices, rotation) if name in self._unfold else vertices

    def press(self, name: str, vertices: Tensor) -> Tensor:
        """Vertices (V, 3) [m], drawn back to their skin where a limb comes between (`Press`)."""
        if not self._has_room:
            return vertices
        return self._press[name](vertices, self._skin_below(name))

    def laid(self, predicted: Mapping[str, Tensor], rotation: Tensor) -> dict[str, Tensor]:
        """Garments as they lie before they are brought off anything, each (V, 3) [m], for joint rotations (24, 3, 3).

        They are unfolded and pressed. What is too wide for a garment above is tucked under it, from the outside in.
        """
        laid: dict[str, Tensor] = {}
        for name in reversed(self.order):
            vertices = self.press(name, self.unfold(name, predicted[name], rotation))
            for outer, tuck in self._tucks[name].items():
                for k in range(self._settings.max_pushes):
                    vertices, n_out = tuck(vertices, laid[outer], goes_on=k > 0)
                    if self._is_serial and not int(n_out):
                        break
            laid[name] = vertices
        return laid

    def _skin_below(self, name: str) -> Tensor:
        """The skin that each vertex of a garment lies on [m], shape (V, 3)."""
        if name not in self._skin_of:
            self._skin_of[name] = self._outfit.below[name](self._body[None])[0]
        return self._skin_of[name]

    def own_side(self, name: str, vertices: Tensor, on_mean: Tensor, reach: float) -> tuple[Tensor, SdfSample]:
        """Vertices (V, 3) [m], on their own side of the body where they were deep in it, and their distances.

        `on_mean` is as in `Drape`; distances are known up to `reach` [m].
        """
        start = self._asked[name](vertices, on_mean=on_mean, reach=reach)
        if not self._has_room:
            return vertices, start
        own_side = self.own_sides[name]
        if self._is_serial and not own_side.is_any_deep(start.distance):
            return vertices, start
        vertices = own_side(vertices, own_side.share(start.distance), self._skin_below(name))
        return vertices, self._asked[name](vertices, on_mean=on_mean, reach=reach)

    def lift(
        self, name: str, vertices: Tensor, worn: Mapping[str, Worn], *, goes_on: bool = False
    ) -> tuple[Tensor, Tensor]:
        """Vertices (V, 3) [m] off the `worn` inner garments, and how many were too near to one of them, shape (1,).

        With `goes_on` it continues from the last call for the same garments.
        """
        n_layered = vertices.new_zeros(1)
        for inner, garment in worn.items():
            vertices, n_low = self._layers[name][inner](vertices, garment.vertices, goes_on=goes_on)
            n_layered = n_layered + n_low
        return vertices, n_layered

    def resolve(
        self,
        name: str,
        vertices: Tensor,
        worn: Mapping[str, Worn],
        *,
        raw: Tensor,
        laid: Tensor,
        on_mean: Tensor,
        rest: Tensor,
        margin: float,
        scale: float | VertexScale,
        n_layered: Tensor,
    ) -> Worn:
        """Brings vertices (V, 3) [m] off the body, which has the last word, but within reach of `laid` (V, 3) [m].

        `raw` (V, 3) [m] are the vertices as they were predicted, `rest` (V, 3) [m] those of the wearer's garment in the
        rest pose, and `on_mean` is as in `Drape`.
        """
        given = vertices
        vertices, start = self.own_side(name, vertices, on_mean, margin + ASKED_FROM)
        if vertices is not given:
            laid = laid + (vertices - given)
        resolver = self.resolvers[name]
        done = resolver(vertices, self.sdf, start, margin=margin, scale=scale)
        numbers, n_clipped, kept = done.numbers[:4], done.numbers[4], margin
        if worn:
            vertices, _ = self.lift(name, done.vertices, worn, goes_on=True)
            kept = self._settings.layer_margin * margin
            done = resolver(vertices, self.sdf, None, margin=kept)
        vertices = self._strain[name](done.vertices, raw, rest)
        was_torn = vertices is not done.vertices
        if was_torn:
            done = resolver(vertices, self.sdf, None, margin=kept)
        if worn:
            done = self._part(name, done, margin=kept)
        vertices = done.vertices
        if self.way_out is None:  # which would count them by itself
            numbers[_N_UNRESOLVED] = torch.count_nonzero(done.distance < 0)
        if was_torn or worn:
            vertices = self._within_reach(vertices, laid)
        vertices = self._taken_out(vertices, laid, margin, numbers)
        if self._has_room:
            n_seen = resolver.glimpse(done, vertices, self.sdf)
            if not self._is_serial or int(n_seen):
                parted = self._off_skin[name].parted(vertices)
                if not self._is_serial:
                    parted = torch.where(n_seen > 0, parted, vertices)
                if parted is not vertices:
                    vertices = self._taken_out(self._within_reach(parted, laid), laid, margin, numbers)
        return Worn(vertices, raw, torch.cat((numbers, n_layered)), n_clipped)

    def _taken_out(self, vertices: Tensor, laid: Tensor, margin: float, numbers: Tensor) -> Tensor:
        """Vertices (V, 3) [m], those inside taken out (`WayOut`); how many have no way is written to `numbers`."""
        if self.way_out is not None:
            vertices, numbers[_N_UNRESOLVED] = self.way_out(vertices, laid, margin)
        return vertices

    def _within_reach(self, vertices: Tensor, laid: Tensor) -> Tensor:
        """No single step takes vertices (V, 3) [m] farther than this; together they may."""
        return laid + torch.renorm(vertices - laid, 2, 0, self._settings.max_displacement)

    def _part(self, name: str, done: Resolution, *, margin: float) -> Resolution:
        """Parts a garment that is off the body from inner ones where triangles still cut each other.

        Repeats as long as fewer cuts are left: in a crease without room the way out of one fold leads into the next.
        """
        partings = [layer.parting for layer in self._layers[name].values()]
        resolver, before = self.resolvers[name], done.vertices
        n_cut = torch.stack([parting.find(before) for parting in partings])
        for _ in range(self._settings.max_pushes):
            if self._is_serial and not int(n_cut.sum()):
                break
            cut_by = [one for one, n in zip(partings, n_cut, strict=True) if not self._is_serial or int(n)]
            vertices = done.vertices
            for parting in cut_by:
                vertices = parting.part(vertices)
            vertices = before + torch.renorm(vertices - before, 2, 0, self._settings.parting_most)
            parted = resolver(vertices, self.sdf, None, margin=margin)
            n_left = torch.stack([parting.find(parted.vertices) for parting in partings])
            is_better = n_left.sum() < n_cut.sum()
            done = Resolution(*(torch.where(is_better, new, old) for new, old in zip(parted, done, strict=True)))
            n_cut = torch.where(is_better, n_left, 0)  # none can't become fewer: this is the end, on a GPU, too
        return done


def _layer(above: GarmentTemplate, below: GarmentTemplate, settings: ContactSettings) -> Layer:
    return Layer(above.faces, above.v_template, below.faces, below.v_template, settings=settings)


def _is_too_wide(below: GarmentTemplate, above: GarmentTemplate, layer: Layer, settings: ContactSettings) -> bool:
    """Whether the garment below has to go under the one above: both hang from one place, and it is outside at rest.

    By the gap at least: the one above is lifted by that, and by the gap once more. A top that hangs over a skirt goes
    over it, however wide the skirt is.
    """
    if below.card.held_at_waist != above.card.held_at_waist:
        return False
    lifted = layer(above.v_template, below.v_template)[0] - above.v_template
    return bool(lifted.norm(dim=1).max() > 2 * settings.gap)


def _tuck(below: GarmentTemplate, above: GarmentTemplate, settings: ContactSettings) -> Layer:
    """Brings a garment to the inner side of the one above it, which is a layer whose sheet faces inwards.

    A wide sleeve is far outside of a narrow one, so the sheet is felt from as far as cloth may move.
    """
    far = replace(settings, layer_reach=settings.max_displacement)
    return Layer(below.faces, below.v_template, above.faces.flip(1), above.v_template, settings=far, asks_tree=False)
