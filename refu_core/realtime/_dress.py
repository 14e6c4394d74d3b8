"""The one forward pass: (θ, β, γ) to bodies and to garments on them, before anything is done about collisions."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from torch import Tensor

from refu_core._device import without_autocast
from refu_core.backbones import MAX_OFFSET, upright
from refu_core.body import RigidTransforms, require_batch
from refu_core.errors import FrameError, MeshError, RefuError, require_type
from refu_core.frames import LAGS, N_JOINTS, N_PAST
from refu_core.realtime._turn import RootTurn
from refu_core.realtime._wearer import Wearable, Wearer
from refu_core.refu import VertexScale
from refu_core.sdf import require_finite, require_tensor

Lap = Callable[[str, str | None], None]
"""Called at the end of a stage, with its name and the garment's, if it was for one."""


class Drape(NamedTuple):
    """One garment on a batch of bodies."""

    vertices: Tensor
    """In the root's axes; where skin gives way, cloth has moved along with it [m], shape (B, V, 3)."""
    unposed: Tensor
    """Before posing [m], shape (B, V, 3)."""
    on_mean: Tensor
    """The same on the mean shape [m], shape (B, V, 3): where `GarmentSdf` looks up what is near."""
    feature: Tensor | None
    """z = h(β, θ, γ), which the scale of ReFU is predicted from, shape (B, M); None where α is 1."""


class Dressed(NamedTuple):
    """A batch of bodies and what they wear, in the root's axes (`RootTurn`)."""

    body: Tensor
    """The collider: `skin` with its overlaps pulled apart, or `skin` if the outfit has none [m], shape (B, V, 3)."""
    skin: Tensor
    """The posed body, which runs through itself where limbs meet [m], shape (B, V, 3)."""
    aside: Tensor
    """`skin` with arms out of the body, before anything gives way (`Collider.aside`) [m], shape (B, V, 3)."""
    drapes: Mapping[str, Drape]
    turns: list[RootTurn]
    """Bring each person to the world's axes."""
    transforms: RigidTransforms
    """Those of the bodies' joints, with which skin and garments were posed, leading shape (B, 24)."""


def dress(
    pose: Tensor, wearer: Wearer, *, past: Tensor | None = None, up: Tensor | None = None, lap: Lap = lambda *_: None
) -> Dressed:
    """Bodies in poses (B, 24, 3) [rad], dressed by the backbones: posed as g = T(θ, β)(t(β, γ) + D(θ, β, γ)).

    Cloth hangs away from `up` (B, 3), of unit length and in the axes that roots are given in; +y by default.
    A backbone that heeds the past takes it from `past` (B, 4, 219), which `PoseHistory` explains; by default people
    stood still. Where a collider pulls the skin apart, the cloth that lies on it moves along (`SkinBelow`).
    Pipeline, CUDA graph, training, evaluation and benchmark all call this. It is a pure function of tensors: nothing is
    remembered, and no device is waited for. `lap` is called at the end of each stage.

    Differentiable, with one exception: how a TailorNet mixes its folds, which depends on (β, γ) alone, counts as
    constant (`TailorNet.mixture`). So derivatives along β and γ are approximate, those along the pose are not.
    """
    require_type(wearer, Wearer, "a Wearer, such as Wearer.of(outfit, betas) gives", error=FrameError)
    dtype = wearer.outfit.body.dtype
    require_batch("pose", pose, (N_JOINTS, 3), dtype=dtype, sizes=(len(wearer.betas),))
    if past is not None:
        require_batch("past", past, (len(LAGS), N_PAST), dtype=dtype, sizes=(len(pose),))
    if up is not None:
        require_batch("up", up, (3,), dtype=dtype, sizes=(len(pose),))
    with without_autocast(pose.device.type):
        posed = wearer.outfit.body.posed(pose, wearer.shape, in_root=True)
        turns = RootTurn.taken_off(posed)
        lap("body", None)
        outfit, body, aside = wearer.outfit, posed.vertices, posed.vertices
        if outfit.collider is not None:
            aside, rotation = outfit.collider.aside(posed.vertices, posed.transforms.rotation)
            body = outfit.collider.apart(aside, rotation)
            gave_way = body - posed.vertices
            lap("collider", None)
        drapes, seen = {}, pose if up is None else upright(pose, up)
        for name, garment in wearer.garments.items():
            wearable = outfit.wearables[name]
            style = wearable.template.own(wearer.style)
            told = {"past": past} if past is not None and wearable.backbone.heeds_past else {}
            predicted = wearable.backbone(garment.betas, seen, style, wearer_code=garment.code, **told)
            unposed, on_mean = garment.rest, garment.on_mean
            if predicted is not None:
                displacement = wearable.size * predicted.clamp(-MAX_OFFSET, MAX_OFFSET).to(unposed)
                unposed, on_mean = unposed + displacement, on_mean + displacement
            vertices = wearable.template.pose(unposed, posed.transforms)
            if outfit.collider is not None:
                vertices = vertices + outfit.below[name](gave_way)
            z = None if wearable.refu is None else wearable.refu.feature(garment.betas, seen, style)
            drapes[name] = Drape(vertices, unposed, on_mean, z)
            lap("backbone", name)
        return Dressed(body, posed.vertices, aside, drapes, turns, posed.transforms)


def require_adjusted(given: object, predicted: Dressed) -> Dressed:
    """`given`, which is `predicted` but for what its tensors say.

    Raises `RefuError` for anything but a `Dressed` of as many persons with the same garments, and `MeshError` for
    tensors of another shape or type, or with NaN in them: kernels would read beyond them, and cloth would be nowhere.
    """
    require_type(given, Dressed, "a Dressed from what adjusts it")
    assert isinstance(given, Dressed)
    require_type(given.drapes, Mapping, "garments by name from what adjusts them")
    if given.drapes.keys() != predicted.drapes.keys():
        wanted, got = (", ".join(map(str, one.drapes)) or "none" for one in (predicted, given))
        raise RefuError(f"wanted all garments back from what adjusts them ({wanted}), got {got}")
    if len(given.turns) != len(predicted.turns):
        raise RefuError(f"wanted the turns of {len(predicted.turns)} persons back, got {len(given.turns)}")
    _require_like("Dressed", given[:3], predicted[:3], Dressed._fields)
    for name, drape in given.drapes.items():
        require_type(drape, Drape, f"a Drape of {name} from what adjusts it")
        _require_like(name, drape, predicted.drapes[name], Drape._fields)
    return given


def _require_like(
    whose: str, given: Sequence[Tensor | None], wanted: Sequence[Tensor | None], fields: Sequence[str]
) -> None:
    for field, one, other in zip(fields, given, wanted, strict=False):
        if one is other or (one is None and field == "feature"):
            continue
        name = f"{whose}'s {field}"
        require_tensor(name, one)
        assert isinstance(one, Tensor)
        if other is None or (one.shape, one.dtype, one.device) != (other.shape, other.dtype, other.device):
            like = None if other is None else f"{other.dtype} of the shape {tuple(other.shape)} on {other.device}"
            got = f"{one.dtype} of the shape {tuple(one.shape)} on {one.device}"
            raise MeshError(f"{name}: wanted {like} from what adjusts it, got {got}")
        for row in one:
            require_finite(name, row)


def scale_of(wearable: Wearable, drape: Drape, person: int) -> float | VertexScale:
    """α of one of the persons, as `refu_core.contact` takes it."""
    return 1.0 if wearable.refu is None or drape.feature is None else wearable.refu.of_body(drape.feature[person])
