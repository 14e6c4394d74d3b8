"""What the pipeline returns: garments, and statistics of the frame."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from refu_core.frames import SmplFrame


@dataclass(frozen=True)
class SkinShift:
    """How far the collider is from the skin, so as not to intersect itself; where nothing overlaps, nothing moves."""

    n_moved: int = 0
    """Vertices of the body that were moved by more than 0.1 mm."""
    largest: float = 0.0
    """The farthest that any vertex moved [m]."""
    mean: float = 0.0
    """How far vertices moved on average, including those that stayed [m]."""
    n_held: int = 0
    """Vertices that moved as far as skin, or their arm, may (`Collider.shift`): there the body may still run through
    itself, deeper than any real body does, and cloth has no room."""

    @classmethod
    def of(cls, numbers: Sequence[float]) -> SkinShift:
        """From these four numbers, in this order."""
        n_moved, largest, mean, n_held = numbers
        return cls(int(n_moved), largest, mean, int(n_held))


@dataclass(frozen=True)
class GarmentStats:
    """What collision handling found and did for one garment in one frame."""

    n_inside: int = 0
    """Vertices inside the body beforehand; for an outer garment, once it is off the inner ones."""
    n_pushed: int = 0
    """Vertices that were moved since they were inside, or nearer to the skin than the margin."""
    n_unresolved: int = 0
    """Vertices inside the body (the collider) afterwards, certified by their winding numbers; if the pipeline was
    loaded with `certify=False`, only according to the distances that pushed them. 0 with `sdf="none"`."""
    max_depth: float = 0.0
    """Deepest penetration beforehand, likewise [m]."""
    n_layered: int = 0
    """Vertices that were moved since they were under another garment, or closer to it than the gap between garments."""
    ms: float = 0.0
    """Wall time of the stages that were run for this garment alone: backbone, layers and refu [ms]; 0 in a graph."""

    @classmethod
    def of(cls, numbers: Sequence[float], *, ms: float = 0.0) -> GarmentStats:
        """From `n_inside`, `n_pushed`, `n_unresolved`, `max_depth` and `n_layered`."""
        n_inside, n_pushed, n_unresolved, max_depth, n_layered = numbers
        return cls(int(n_inside), int(n_pushed), int(n_unresolved), max_depth, int(n_layered), ms)


@dataclass(frozen=True)
class FrameStats:
    """How long the stages of one frame took, and what they did."""

    stage_ms: Mapping[str, float]
    """Wall time of each stage, all garments together [ms]: body, collider, backbone, sdf (new pose), refu (distances,
    pushes), layers where garments are worn over each other, and adjust after `GarmentPipeline.adjusted`; on CUDA, where
    a graph merges them all, only step."""
    garments: Mapping[str, GarmentStats] = field(default_factory=dict)
    is_certified: bool = False
    """Whether `n_unresolved` counts every vertex inside, whatever the frame."""
    within_promise: bool = True
    """Whether "nothing inside" is promised for the frame (docs/reliability.md): joints, β and γ are within a range, and
    no two parts of the body overlap deeper than skin can give way (`shift.n_held`)."""
    skipped: Mapping[str, int] = field(default_factory=dict)
    """How much was left out since it would change nothing. `band`: vertices too far off the skin for their distance to
    matter (accurate); `rest`: the body and garments of a (β, γ) before they are posed, known from an earlier frame;
    `unchanged`: 1 for a person whose (β, θ, γ) are those of the last frame and who keeps those garments."""
    shift: SkinShift = field(default_factory=SkinShift)
    """How far the collider is from the skin; zeros without one."""

    def __repr__(self) -> str:
        counts = (f"{name}: {one.n_inside} inside, {one.n_unresolved} left" for name, one in self.garments.items())
        certified = "certified" if self.is_certified else "not certified"
        return f"FrameStats({'; '.join((f'{sum(self.stage_ms.values()):.1f} ms', *counts, certified))})"


@dataclass(frozen=True, eq=False)
class GarmentMesh:
    """A garment on a body, in SMPL axes."""

    local: NDArray[np.float32]
    """Vertices relative to the body's own origin, that is without the translation [m], shape (V, 3)."""
    before: Callable[[], NDArray[np.float32]]
    """Makes `raw` when it is asked for."""
    faces: NDArray[np.int64]
    """Counter-clockwise from outside, shape (F, 3)."""
    transl: NDArray[np.float64]
    """Translation of the person [m], shape (3,)."""

    @property
    def raw(self) -> NDArray[np.float32]:
        """Vertices before collision handling, without the translation [m], shape (V, 3)."""
        return self.before()

    @cached_property
    def vertices(self) -> NDArray[np.float64]:
        """Vertices with the translation [m], shape (V, 3); added in float64, so that distant bodies stay precise."""
        placed = self.local + self.transl
        placed.flags.writeable = False  # what is written would be seen by whoever asks next
        return placed

    def __reduce__(self) -> tuple[Any, ...]:
        """Copies and pickles have all arrays made."""
        return GarmentMesh, (self.local, partial(np.asarray, self.raw), self.faces, self.transl)

    def __repr__(self) -> str:
        return f"GarmentMesh({len(self.local)} vertices, {len(self.faces)} faces)"


@dataclass(frozen=True, eq=False)
class PipelineOutput(Mapping[str, GarmentMesh]):
    """The garments of one person in one frame, by name."""

    garments: Mapping[str, GarmentMesh]
    posed_body: Callable[[], NDArray[np.float32]]
    """Makes `body` when it is asked for."""
    posed_skin: Callable[[], NDArray[np.float32]]
    """Makes `skin` when it is asked for."""
    stats: FrameStats

    @property
    def body(self) -> NDArray[np.float32]:
        """The collider, which garments were brought off: the skin with its overlaps pulled apart, the skin itself with
        `collider=False`. Vertices without the translation, SMPL axes [m], shape (V, 3)."""
        return self.posed_body()

    @property
    def skin(self) -> NDArray[np.float32]:
        """Vertices of the posed body without the translation, SMPL axes [m], shape (V, 3)."""
        return self.posed_skin()

    @property
    def transl(self) -> NDArray[np.float64]:
        """Translation of the person [m], shape (3,): `body + transl` is where `vertices` of the garments are."""
        return next(iter(self.garments.values())).transl

    def at(self, frame: SmplFrame) -> PipelineOutput:
        """The same arrays for a person who has moved without changing pose."""
        garments = {name: replace(mesh, transl=frame.transl) for name, mesh in self.items()}
        counts = {name: replace(one, ms=0.0) for name, one in self.stats.garments.items()}
        stage_ms = dict.fromkeys(self.stats.stage_ms, 0.0)
        took = replace(self.stats, stage_ms=stage_ms, garments=counts, skipped={"unchanged": 1})
        return PipelineOutput(garments, self.posed_body, self.posed_skin, took)

    def __getitem__(self, name: str) -> GarmentMesh:
        try:
            return self.garments[name]
        except KeyError as error:
            raise KeyError(f"no garment {name!r}: this person wears {', '.join(self.garments)}") from error

    def __reduce__(self) -> tuple[Any, ...]:
        """Copies and pickles have all arrays made."""
        made = partial(np.asarray, self.body), partial(np.asarray, self.skin)
        return PipelineOutput, (self.garments, *made, self.stats)

    def __repr__(self) -> str:
        return f"PipelineOutput({dict(self.garments)})"

    def __iter__(self) -> Iterator[str]:
        return iter(self.garments)

    def __len__(self) -> int:
        return len(self.garments)
