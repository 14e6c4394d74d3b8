"""The methods compared: what each predicts with, how it handles collisions, and which command trains it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

from refu_core.modes import DEFAULT_MARGIN

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
_SDFS: tuple[SdfName, ...] = ("approx", "accurate")
_RUN_TIME_SDF: Mapping[str, SdfName] = {"approx": "approx", "accurate": "accurate", "hybrid": "approx"}
"""Hybrid uses the accurate distance in the training loss, the approximate one in ReFU (paper, Sec. "Settings")."""


def _variant(of: Method, suffix: str, label: str, **changes: Any) -> Method:
    """A changed method, with `suffix` appended to its name and `label` to its label."""
    return replace(of, name=of.name + suffix, label=of.label + label, **changes)


def _skinned() -> Iterator[Method]:
    alone = Method("skinned", "skinned template (no network)", backbone="skinned", base="skinned")
    yield alone
    for handling in ("naive", "optimisation"):
        label = f"skinned, {handling} post-process, accurate"
        yield replace(alone, name=f"skinned-{handling}", label=label, handling=handling, sdf="accurate")
    label = "the node, skinned, accurate"
    yield replace(alone, name="node-skinned", label=label, mode="accurate", handling="node", sdf="accurate")


def _post_processes() -> Iterator[Method]:
    for sdf in _SDFS:
        drape = Method(f"optimisation-{sdf}", f"optimisation post-process, {sdf}", handling="optimisation", sdf=sdf)
        yield Method(f"naive-{sdf}", f"naive post-process, {sdf}", handling="naive", sdf=sdf)
        yield drape
        yield _variant(drape, "-margin", ", with ReFU's margin", margin=DEFAULT_MARGIN)
        yield Method(f"collision-loss-{sdf}", f"collision loss, {sdf}", mode=f"collision-{sdf}")
    for name, label, is_kept in (("optimisation", "", False), ("optimisation-kept", " kept everywhere", True)):
        yield Method(
            f"{name}-on-hybrid",
            f"optimisation post-process, approx, with ReFU's margin{label}, on ReFU hybrid's backbone",
            mode="hybrid",
            handling="optimisation",
            sdf="approx",
            margin=DEFAULT_MARGIN,
            is_kept=is_kept,
        )


def _refu() -> Iterator[Method]:
    """ReFU as trained; without blending and margin at run time; trained without them (the paper's layer); the node."""
    for mode, sdf in _RUN_TIME_SDF.items():
        refu = Method(f"refu-{mode}", f"ReFU, {mode}", mode=mode, handling="refu", sdf=sdf)
        yield from _ablated(refu)
        yield replace(refu, name=f"node-{mode}", label=f"the node, {mode}", handling="node")
        yield _trained_bare(refu, f"bare-{mode}", folder="bare")
    for sdf in _SDFS:
        fixed = Method(f"fixed-{sdf}", f"fixed scale, {sdf}", mode=sdf, folder="fixed", handling="refu", sdf=sdf)
        yield from _ablated(fixed)
        yield _trained_bare(fixed, f"fixed-bare-{sdf}", folder="fixed-bare")
    for n in (1, 2):
        label = f"Alt. {n}, approx"
        yield Method(f"alt{n}-approx", label, mode="approx", folder=f"alt{n}", handling="refu", sdf="approx")


def _ablated(whole: Method) -> Iterator[Method]:
    yield whole
    yield _variant(whole, "-unblended", ", not blended", is_blended=False)
    yield _variant(whole, "-bare", ", not blended, ε = 0", is_blended=False, margin=0.0)


def _trained_bare(whole: Method, name: str, *, folder: str) -> Method:
    """The same method with the weights in `folder`, whose ε is 0 already."""
    label = f"{whole.label}, not blended, ε = 0, trained so (the paper's)"
    return replace(whole, name=name, label=label, folder=folder, is_blended=False)


def _other_backbones() -> Iterator[Method]:
    gcnn = Method("gcnn", "GCNN", backbone="gcnn", base="gcnn")
    yield gcnn
    for mode, sdf in _RUN_TIME_SDF.items():
        yield _variant(gcnn, f"-refu-{mode}", f" with ReFU, {mode}", mode=mode, handling="refu", sdf=sdf)
    for shapes in SEQUENCE_SHAPES:
        name, label = f"mlp-{shapes}", f"{shapes} shapes"
        mlp = Method(name, f"MLP, {label}", backbone="mlp", folder=f"sequence-{shapes}", base=name)
        yield mlp
        with_refu = f"MLP with ReFU, approx, {label}"
        yield replace(mlp, name=f"{name}-refu-approx", label=with_refu, mode="approx", handling="refu", sdf="approx")


METHODS: Mapping[str, Method] = {
    method.name: method
    for method in (
        *_skinned(),
        Method("tailornet", "backbone alone (TailorNet)"),
        *_post_processes(),
        *_refu(),
        *_other_backbones(),
    )
}
"""All methods by name."""
