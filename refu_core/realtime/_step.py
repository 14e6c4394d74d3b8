"""A frame as one function of tensors, with the same work for any input: what a CUDA graph is captured of."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor

from refu_core.backbones import TailorNet, style_shape
from refu_core.body import Shape, SmplBody
from refu_core.errors import MeshError
from refu_core.frames import N_STYLES
from refu_core.realtime._collisions import Collisions
from refu_core.realtime._outfit import Outfit
from refu_core.realtime._outputs import GarmentStats
from refu_core.realtime._turn import RootTurn
from refu_core.realtime._wearable import Figures, Wearable

if TYPE_CHECKING:
    from numpy.typing import NDArray

_N_NUMBERS = 5
"""`n_inside`, `n_pushed`, `n_unresolved`, `max_depth` and `n_layered` of a garment."""


class Worn(NamedTuple):
    """One garment of one person, on the host."""

    local: NDArray[np.float32]
    """Vertices [m], shape (V, 3)."""
    raw: NDArray[np.float32]
    """The same before collision handling [m], shape (V, 3)."""
    counts: GarmentStats


class Step:
    """What the pipeline does with a batch of persons, from pose to vertices, without ever waiting for the device.

    Nothing in it hangs on a number that the device would have to be asked for: no vertex is picked out, no launch is
    left out, no pivot is looked up. So the same launches do for any pose, any (β, γ), and can be captured. All that
    comes out is packed in one tensor, so that it is copied to the host once.
    """

    def __init__(
        self, body: SmplBody, wearables: Mapping[str, Wearable], *, collisions: Collisions | None, outfit: Outfit | None
    ) -> None:
        """For garments by name; `collisions` must not be those of a band."""
        self._body, self._wearables, self._collisions, self._outfit = body, wearables, collisions, outfit
        self._order = list(wearables) if outfit is None else outfit.order
        sizes = [body.n_vertices * 3]
        for wearable in wearables.values():
            sizes += [wearable.template.n_vertices * 3] * 2 + [_N_NUMBERS]
        self._ends = np.cumsum([0, *sizes]).tolist()
        self._known: tuple[Figures, dict[str, Tensor]] | None = None

    @torch.no_grad()
    def inputs(self, pose: Tensor, figures: Figures) -> dict[str, Tensor]:
        """What a call takes, by name, for poses (B, 24, 3) [rad]: the same tensors as long as the figures are."""
        if self._known is None or self._known[0] is not figures:
            n = len(figures.betas)
            style = figures.betas.new_zeros(n, N_STYLES) if figures.style is None else figures.style
            fixed = {"betas": figures.betas, "style": style}
            fixed |= {"body": figures.body.vertices, "joints": figures.body.joints}
            for name, wearable in self._wearables.items():
                fixed |= {f"rest {name}": figures.rest[name], f"mean rest {name}": figures.mean_rest[name]}
                if isinstance(wearable.backbone, TailorNet):
                    fixed[f"mixture {name}"] = wearable.backbone.run_time_mixture(style_shape(figures.betas, style))
            self._known = figures, fixed
        return {"pose": pose, **self._known[1]}

    @torch.no_grad()
    def __call__(self, inputs: Mapping[str, Tensor], margins: tuple[float, ...]) -> Tensor:
        """All results, float32 of the shape (B, …), as `unpacked` reads them; `margins` [m] of the garments."""
        pose = inputs["pose"]
        names = list(self._wearables)
        figures = Figures(
            b"",
            inputs["betas"],
            inputs["style"],
            Shape(inputs["body"], inputs["joints"]),
            {name: inputs[f"rest {name}"] for name in names},
            {name: inputs[f"mean rest {name}"] for name in names},
        )
        turns, at_root = RootTurn.taken_off(pose, figures.body.joints)
        posed = self._body.posed(at_root, figures.body)
        dressed = {
            name: wearable.dress(
                pose, figures, posed.transforms, self._collisions, mixture=inputs.get(f"mixture {name}")
            )
            for name, wearable in self._wearables.items()
        }
        margin_of = dict(zip(names, margins, strict=True))
        rows = []
        for person, (body, turn) in enumerate(zip(posed.vertices, turns, strict=True)):
            if self._collisions is not None:
                self._collisions.update(body)
            worn: dict[str, Tensor] = {}
            parts: dict[str, tuple[Tensor, ...]] = {}
            for name in self._order:
                one = dressed[name]
                raw = vertices = one.posed[person]
                n_layered, numbers = raw.new_zeros(1), raw.new_zeros(_N_NUMBERS - 1)
                if self._outfit is not None:
                    vertices, n_layered = self._outfit.queued(name, vertices, worn)
                if self._collisions is not None:
                    near = None if one.near is None else one.near[person]
                    vertices, numbers = self._collisions.queued(
                        name, vertices, margin=margin_of[name], scale=one.scale[person], near=near
                    )
                worn[name] = vertices
                parts[name] = turn(vertices), turn(raw), numbers, n_layered
            rows.append(torch.cat([turn(body).flatten(), *(part.flatten() for name in names for part in parts[name])]))
        return torch.stack(rows)

    def unpacked(self, packed: NDArray[np.float32]) -> Iterator[tuple[NDArray[np.float32], dict[str, Worn]]]:
        """The body [m], shape (V, 3), and the garments of each person, of what a call gave; nothing is copied.

        Raises:
            MeshError: it isn't finite. A graph can't be interrupted to say so earlier.
        """
        if not np.isfinite(packed.sum(dtype=np.float64)):
            bad = int((~np.isfinite(packed)).any(axis=1).sum())
            msg = f"vertices must be finite, got NaN or infinite ones of {bad} of {len(packed)} persons"
            raise MeshError(msg)
        for row in packed:
            body, *parts = (row[start:end] for start, end in pairwise(self._ends))
            garments = {}
            for i, name in enumerate(self._wearables):
                local, raw, numbers = parts[3 * i : 3 * i + 3]
                n_inside, n_pushed, n_unresolved, max_depth, n_layered = numbers.tolist()
                counts = GarmentStats(int(n_inside), int(n_pushed), int(n_unresolved), max_depth, int(n_layered))
                garments[name] = Worn(local.reshape(-1, 3), raw.reshape(-1, 3), counts)
            yield body.reshape(-1, 3), garments
