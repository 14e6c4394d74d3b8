"""The methods compared: what each predicts with, how it handles collisions, what trains it, and its weights."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

from refu_core.body import load_fit
from refu_core.errors import WeightsError
from refu_core.garments import load_garment
from refu_core.modes import DEFAULT_MARGIN, BackboneName
from refu_core.realtime import GarmentPipeline, Wearable, wearable_of
from refu_core.weights import load_weights, weights_folder

Handling = Literal["none", "naive", "optimisation", "refu", "node"]
SdfName = Literal["approx", "accurate"]


@dataclass(frozen=True)
class Method:
    """One row of a table; the defaults are those of the backbone alone."""

    name: str
    label: str
    backbone: str = "tailornet"
    mode: str = "none"
    """How the backbone was trained; `none` without collision handling. Weights are called `<backbone>-<mode>`."""
    folder: str = ""
    """Subfolder of the garment's folder with these weights, if they were trained unlike those that ship."""
    handling: Handling = "none"
    """What is done to the backbone's garment: nothing; x - f ∇f (naive); sparse least squares (optimisation); ReFU as
    in the paper; or all that the node does in that mode: ReFU, a second look at what it moved, edges, limbs."""
    sdf: SdfName | None = None
    """Signed distance at run time."""
    margin: float | None = None
    """ε that replaces the trained one, or the optimisation's own 1 mm [m]."""
    is_kept: bool = False
    """Whether the optimisation keeps all vertices ε off the skin, also those outside, which DRAPE leaves alone."""
    is_blended: bool = True
    """Whether ReFU's pushes take neighbouring vertices along, which the paper's don't."""
    base: str = "tailornet"
    """The method whose colliding vertices the local Laplacian error is measured at."""

    @property
    def weights(self) -> str | None:
        """Path of the weights' files in the garment's folder, without suffix; None if no network is needed."""
        return None if self.backbone == "skinned" else f"{self.folder}/{self.backbone}-{self.mode}".lstrip("/")

    def train_command(self, garment: str) -> str:
        """The command that trains the weights; empty if none are needed."""
        if self.weights is None:
            return ""
        folder = f"weights/{garment}" + (f"/{self.folder}" if self.folder else "")
        special = f" {_TRAINING[self.folder]}" if self.folder in _TRAINING else ""
        return (
            f"refu train {garment} --data DIR --backbone {self.backbone} --mode {self.mode}{special} --output {folder}"
        )


_TRAINING: Mapping[str, str] = {
    "fixed": "--scale fixed",
    "fixed-bare": "--scale fixed --margin 0 --unblended",
    "alt1": "--scale shared",
    "alt2": "--scale distance",
    "bare": "--margin 0 --unblended",
}
"""Special options of `refu train` for the weights in each folder."""
SEQUENCE_SHAPES = (5, 17)
"""Numbers of body shapes in the paper's two sets of sequences."""
SDFS: tuple[SdfName, ...] = ("approx", "accurate")
_POST_PROCESSES: tuple[Handling, ...] = ("naive", "optimisation")
RUN_TIME_SDF: Mapping[str, SdfName] = {"approx": "approx", "accurate": "accurate", "hybrid": "approx"}
"""Hybrid uses the accurate distance in the training loss, the approximate one in ReFU (paper, Sec. "Settings")."""


def _methods() -> Iterator[Method]:
    skinned = Method("skinned", "skinned template (no network)", backbone="skinned", base="skinned")
    yield skinned
    accurate = replace(skinned, sdf="accurate")
    for post in _POST_PROCESSES:
        yield replace(accurate, name=f"skinned-{post}", label=f"skinned, {post} post-process, accurate", handling=post)
    yield replace(accurate, name="node-skinned", label="the node, skinned, accurate", mode="accurate", handling="node")
    yield Method("tailornet", "backbone alone (TailorNet)")
    for sdf in SDFS:
        drape = Method(f"optimisation-{sdf}", f"optimisation post-process, {sdf}", handling="optimisation", sdf=sdf)
        yield drape
        yield _variant(drape, "-margin", ", with ReFU's margin", margin=DEFAULT_MARGIN)
        yield Method(f"naive-{sdf}", f"naive post-process, {sdf}", handling="naive", sdf=sdf)
        yield Method(f"collision-loss-{sdf}", f"collision loss, {sdf}", mode=f"collision-{sdf}")
        if sdf == "approx":
            for kept, label in (("", ""), ("-kept", " kept everywhere")):
                label = f", with ReFU's margin{label}, on ReFU hybrid's backbone"
                on_hybrid = replace(drape, mode="hybrid", margin=DEFAULT_MARGIN, is_kept=bool(kept))
                yield replace(on_hybrid, name=f"optimisation{kept}-on-hybrid", label=drape.label + label)
    gcnn = Method("gcnn", "GCNN", backbone="gcnn", base="gcnn")
    yield gcnn
    for mode, sdf in RUN_TIME_SDF.items():
        refu = Method(f"refu-{mode}", f"ReFU, {mode}", mode=mode, handling="refu", sdf=sdf)
        yield from _ablated(refu, f"bare-{mode}", "bare")
        yield replace(refu, name=f"node-{mode}", label=f"the node, {mode}", handling="node")
        yield _variant(gcnn, f"-refu-{mode}", f" with ReFU, {mode}", mode=mode, handling="refu", sdf=sdf)
    for sdf in SDFS:
        fixed = Method(f"fixed-{sdf}", f"fixed scale, {sdf}", mode=sdf, folder="fixed", handling="refu", sdf=sdf)
        yield from _ablated(fixed, f"fixed-bare-{sdf}", "fixed-bare")
    approx: dict[str, Any] = {"mode": "approx", "handling": "refu", "sdf": "approx"}
    for n in (1, 2):
        yield Method(f"alt{n}-approx", f"Alt. {n}, approx", folder=f"alt{n}", **approx)
    for shapes in SEQUENCE_SHAPES:
        name, label = f"mlp-{shapes}", f"{shapes} shapes"
        mlp = Method(name, f"MLP, {label}", backbone="mlp", folder=f"sequence-{shapes}", base=name)
        yield mlp
        yield replace(mlp, name=f"{name}-refu-approx", label=f"MLP with ReFU, approx, {label}", **approx)


def _variant(of: Method, suffix: str, label: str, **changes: Any) -> Method:
    """A changed method, with `suffix` appended to its name and `label` to its label."""
    return replace(of, name=of.name + suffix, label=of.label + label, **changes)


def _ablated(whole: Method, bare: str, folder: str) -> Iterator[Method]:
    """As trained; without blending and margin at run time; and (`bare`) trained without, in a folder of its own."""
    yield whole
    yield _variant(whole, "-unblended", ", not blended", is_blended=False)
    without = _variant(whole, "-bare", ", not blended, ε = 0", is_blended=False, margin=0.0)
    yield without
    yield replace(without, name=bare, label=f"{without.label}, trained so (the paper's)", folder=folder, margin=None)


METHODS: Mapping[str, Method] = {method.name: method for method in _methods()}


class Library:
    """Trained weights: those in given folders, `<folder>/<garment>/<weights>`, before those that ship."""

    def __init__(self, folders: Sequence[Path] = (), *, collider: bool = True, body: str | None = None) -> None:
        """Searches `folders` first, in their order; collisions are resolved against the collider or against the skin.

        Networks are loaded for a `body`, given by name or file; None takes the one that each garment is made for.

        Raises `BodyError` if there is no such body, or garments can't be transferred to it.
        """
        self._folders = tuple(folders)
        self.collider = collider
        self.fit = None if body is None else load_fit(body)
        self._named = body

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickled without the body, which another process loads itself."""
        return partial(Library, collider=self.collider, body=self._named), (self._folders,)

    def find(self, name: str, garment: str) -> Path:
        """Path of the files of a garment's weights, without suffix. Raises `WeightsError` if there are none."""
        for folder in (weights_folder(garment, root) for root in (*self._folders, None)):
            if (folder / f"{name}.json").exists():
                return folder / name
        raise WeightsError("not trained")

    def load(self, method: Method, garment: str) -> Wearable:
        """A method's networks. Raises `WeightsError` if they are missing, damaged or for another body."""
        assert method.weights is not None
        stored = load_weights(self.find(method.weights, garment), expect={"garment": garment})
        return wearable_of(stored, load_garment(garment), self.fit)

    def pipeline(self, method: Method, *garments: str) -> GarmentPipeline:
        """The node's pipeline if the method is the node in some mode, else its backbone without collision handling.

        Raises `RefuError` if the garments, worn together, don't all have weights in one folder.
        """
        weights = None if method.weights is None else self.find(method.weights, garments[0]).parent.parent
        is_node = method.handling == "node"
        return GarmentPipeline.load(
            garments,
            body=None if self.fit is None else self.fit.body,
            sdf=method.mode if is_node else "none",
            backbone=BackboneName.AUTO if is_node and method.weights is not None else method.backbone,
            weights=weights,
            collider=self.collider,
        )
