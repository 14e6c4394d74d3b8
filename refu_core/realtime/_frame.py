"""A frame as one function of tensors: poses in, worn garments out."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from refu_core._warp import side_by_side
from refu_core.errors import MeshError
from refu_core.realtime._contact import N_NUMBERS, ContactStage, Worn
from refu_core.realtime._dress import Dressed, dress, require_adjusted, scale_of
from refu_core.realtime._wearer import Outfit, Wearer

Adjust = Callable[[Dressed], Dressed]
"""Changes what was predicted: garments, not bodies."""
N_SHIFT = 4


class Person(NamedTuple):
    """One person of a frame."""

    turn: Callable[[Tensor], Tensor]
    """Brings the fields below to the world's axes."""
    body: Tensor
    """The collider [m], shape (V, 3)."""
    skin: Tensor
    """The posed body before its overlaps were pulled apart [m], shape (V, 3)."""
    shift: Tensor
    """`n_moved`, `largest`, `mean` and `n_held` of a `SkinShift`, shape (4,)."""
    garments: Mapping[str, Worn]


class StageClock:
    """Wall time by stage, and by garment [ms]."""

    def __init__(self) -> None:
        self.stages: dict[str, float] = {}
        self.garments: dict[str, float] = {}
        self._last = time.perf_counter()

    def start(self, shared: StageClock, *, share: float) -> None:
        """Begins a lap, and takes over a share of another clock's times."""
        for mine, others in ((self.stages, shared.stages), (self.garments, shared.garments)):
            mine.update({name: share * ms for name, ms in others.items()})
        self._last = time.perf_counter()

    def lap(self, stage: str, garment: str | None = None) -> None:
        """Adds the time since the last lap to a stage, and to a garment if it was for one."""
        now = time.perf_counter()
        ms, self._last = 1e3 * (now - self._last), now
        self.stages[stage] = self.stages.get(stage, 0.0) + ms
        if garment is not None:
            self.garments[garment] = self.garments.get(garment, 0.0) + ms


class FrameStep:
    """All that is computed for a batch of persons, from poses to worn garments.

    On a GPU nothing in it depends on a number that would have to be read back from the device. So the same launches
    serve any pose and any (β, γ), and can be captured (`StepGraphs`).
    """

    def __init__(self, outfit: Outfit, contact: ContactStage | None) -> None:
        """Without `contact` collisions aren't handled. One call at a time: both arguments have memory to work in."""
        self.outfit, self.contact = outfit, contact
        self._order = list(outfit.wearables) if contact is None else contact.order
        self._sizes = [outfit.body.n_vertices * 3] * 2 + [N_SHIFT]
        for one in outfit.wearables.values():
            self._sizes += [one.template.n_vertices * 3] * 2 + [N_NUMBERS]

    @torch.no_grad()
    def __call__(
        self,
        pose: Tensor,
        wearer: Wearer,
        margins: Sequence[float],
        clocks: Sequence[StageClock] = (),
        adjust: Adjust | None = None,
        *,
        past: Tensor | None = None,
        up: Tensor | None = None,
    ) -> list[Person]:
        """Persons in poses (B, 24, 3) [rad]; `past` and `up` as in `dress`, `margins` [m] one per garment.

        `clocks`, one per person, are told how long the stages took; time spent on all at once is shared out equally.
        `adjust` may change what was predicted before collisions are handled.
        """
        shared = StageClock()
        dressed = dress(pose, replace(wearer, outfit=self.outfit), past=past, up=up, lap=shared.lap)
        if adjust is not None:
            dressed = require_adjusted(adjust(dressed), dressed)
            shared.lap("adjust")
        margin_of = dict(zip(self.outfit.wearables, margins, strict=True))
        persons = []
        if self.outfit.collider is None:
            shifts = dressed.body.new_zeros(len(pose), N_SHIFT)
        else:
            shifts = self.outfit.collider.shift(dressed.skin, dressed.aside, dressed.body)
        for person, (body, skin, turn) in enumerate(zip(dressed.body, dressed.skin, dressed.turns, strict=True)):
            clock = clocks[person] if clocks else StageClock()
            clock.start(shared, share=1 / len(pose))
            if self.contact is not None:
                self.contact.update(body)
            clock.lap("sdf")
            raw = {name: drape.vertices[person] for name, drape in dressed.drapes.items()}
            garments: dict[str, Worn] = {}
            if self.contact is None:
                for name in self._order:
                    garments[name] = Worn(raw[name], raw[name], body.new_zeros(N_NUMBERS), 0)
            else:
                laid = self.contact.laid(raw, dressed.transforms.rotation[person])
                if len(self._order) > 1:
                    clock.lap("layers")
                for name in self._order:
                    drape = dressed.drapes[name]
                    vertices, n_layered = self.contact.lift(name, laid[name], garments)
                    if len(self._order) > 1:
                        clock.lap("layers", name)
                    garments[name] = self.contact.resolve(
                        name,
                        vertices,
                        garments,
                        raw=raw[name],
                        laid=laid[name],
                        on_mean=drape.on_mean[person],
                        rest=wearer.garments[name].rest[person],
                        margin=margin_of[name],
                        scale=scale_of(self.outfit.wearables[name], drape, person),
                        n_layered=n_layered,
                    )
                    clock.lap("refu", name)
            persons.append(Person(turn, body, skin, shifts[person], garments))
        return persons

    def packed(self, inputs: Mapping[str, Tensor], margins: tuple[float, ...]) -> Tensor:
        """The same from `pose`, `past`, `up` and a wearer's tensors, as one tensor (B, …), which `unpacked` reads."""
        rows = []
        wearer = Wearer.of_tensors(self.outfit, inputs)
        for person in self(inputs["pose"], wearer, margins, past=inputs.get("past"), up=inputs.get("up")):
            parts = [person.turn(person.body), person.turn(person.skin), person.shift]
            for name in self.outfit.wearables:
                worn = person.garments[name]
                parts += [person.turn(worn.vertices), person.turn(worn.raw), worn.numbers]
            rows.append(torch.cat([part.flatten() for part in parts]))
        return torch.stack(rows)

    def unpacked(self, packed: NDArray[np.float32]) -> Iterator[Person]:
        """The persons that were packed, already in the world's axes; nothing is copied.

        Raises `MeshError` for numbers that aren't finite: a graph can't be interrupted to say so earlier.
        """
        if not np.isfinite(packed.sum(dtype=np.float64)):
            bad = int((~np.isfinite(packed)).any(axis=1).sum())
            raise MeshError(f"vertices must be finite, got NaN or infinite ones of {bad} of {len(packed)} persons")
        for row in torch.from_numpy(packed):
            body, skin, shift, *parts = torch.split(row, self._sizes)
            garments = {
                name: Worn(parts[3 * i].view(-1, 3), parts[3 * i + 1].view(-1, 3), parts[3 * i + 2], 0)
                for i, name in enumerate(self.outfit.wearables)
            }
            yield Person(lambda points: points, body.view(-1, 3), skin.view(-1, 3), shift, garments)


def shares(n: int, parts: int) -> list[slice]:
    """Slices that share out a batch of n persons into so many parts, as equal in size as possible."""
    return [slice(start, end) for start, end in pairwise(n * i // parts for i in range(parts + 1))]


def packed_by(steps: Sequence[FrameStep], inputs: Mapping[str, Tensor], margins: tuple[float, ...]) -> Tensor:
    """`FrameStep.packed` of a batch that several steps share; on a GPU they run at the same time."""
    parts = shares(len(inputs["pose"]), min(len(steps), len(inputs["pose"])))
    works = [
        partial(step.packed, {name: tensor[part] for name, tensor in inputs.items()}, margins)
        for step, part in zip(steps, parts, strict=False)
    ]
    return torch.cat(side_by_side(works, inputs["pose"].device))
