"""The methods that are compared: what each predicts with, how it handles collisions, and what trains it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

from refu_core.repulsion import DEFAULT_MARGIN

Handling = Literal["none", "naive", "optimisation", "refu", "node"]
SdfName = Literal["approx", "accurate"]


@dataclass(frozen=True, kw_only=True)
class Method:
    """One row of a table; the defaults are those of the backbone alone."""

    name: str
    label: str
    backbone: str = "tailornet"
    mode: str = "none"
    """How the backbone was trained; `none` without collision handling. Weights are called `<backbone>-<mode>`."""
    folder: str = ""
    """Folder below the garment's that they lie in, where they were trained other than those that ship."""
    handling: Handling = "none"
    """What happens to the backbone's garment: nothing; x - f ∇f (naive); sparse least squares (optimisation); ReFU as
    in the paper; or whatever the node does, in that mode: ReFU, a second look at what it moved, edges, limbs."""
    sdf: SdfName | None = None
    """Signed distance at run time."""
    margin: float | None = None
    """ε in place of the trained one, or of the optimisation's own 1 mm [m]."""
    is_kept: bool = False
    """Whether the optimisation keeps ε of all vertices: of those outside, too, which DRAPE leaves alone."""
    is_blended: bool = True
    """Whether ReFU's pushes take the neighbourhood along, which the paper's don't."""
    base: str = "tailornet"
    """The method whose colliding vertices are the region of the local Laplacian error."""

    @property
    def weights(self) -> str | None:
        """Path of the weights' files below the garment's folder, without suffix; None where no network is needed."""
        return None if self.backbone == "skinned" else f"{self.folder}/{self.backbone}-{self.mode}".lstrip("/")

    def train_command(self, garment: str) -> str:
        """The command that makes the weights; empty where none are needed."""
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
"""What is special about the training of the weights in each folder, as options of `refu train`."""
_SDFS: tuple[SdfName, ...] = ("approx", "accurate")


def _tailornet() -> list[Method]:
    methods = [Method(name="tailornet", label="backbone alone (TailorNet)")]
    for sdf in _SDFS:
        methods += [
            Method(name=f"naive-{sdf}", label=f"naive post-process, {sdf}", handling="naive", sdf=sdf),
            Method(
                name=f"optimisation-{sdf}", label=f"optimisation post-process, {sdf}", handling="optimisation", sdf=sdf
            ),
            Method(name=f"collision-loss-{sdf}", label=f"collision loss, {sdf}", mode=f"collision-{sdf}"),
        ]
        methods.append(
            Method(
                name=f"optimisation-{sdf}-margin",
                label=f"optimisation post-process, {sdf}, with ReFU's margin",
                handling="optimisation",
                sdf=sdf,
                margin=DEFAULT_MARGIN,
            )
        )
    on_hybrid = Method(
        name="optimisation-on-hybrid",
        label="optimisation post-process, approx, with ReFU's margin, on ReFU hybrid's backbone",
        mode="hybrid",
        handling="optimisation",
        sdf="approx",
        margin=DEFAULT_MARGIN,
    )
    methods += [
        on_hybrid,
        replace(
            on_hybrid,
            name="optimisation-kept-on-hybrid",
            label="optimisation post-process, approx, with ReFU's margin kept everywhere, on ReFU hybrid's backbone",
            is_kept=True,
        ),
    ]
    for mode, sdf in _RUN_TIME_SDF.items():
        refu = Method(name=f"refu-{mode}", label=f"ReFU, {mode}", mode=mode, handling="refu", sdf=sdf)
        methods += [
            *_ablated(refu),
            replace(refu, name=f"node-{mode}", label=f"the node, {mode}", handling="node"),
            _trained_bare(refu, f"bare-{mode}", folder="bare"),
        ]
    for sdf in _SDFS:
        fixed = Method(
            name=f"fixed-{sdf}", label=f"fixed scale, {sdf}", mode=sdf, folder="fixed", handling="refu", sdf=sdf
        )
        methods += [*_ablated(fixed), _trained_bare(fixed, f"fixed-bare-{sdf}", folder="fixed-bare")]
    methods += [
        Method(
            name=f"alt{number}-approx",
            label=f"Alt. {number}, approx",
            mode="approx",
            folder=f"alt{number}",
            handling="refu",
            sdf="approx",
        )
        for number in (1, 2)
    ]
    return methods


def _ablated(whole: Method) -> list[Method]:
    """A ReFU with all it has, without the blending, and with neither that nor a margin: exactly the paper's layer."""
    unblended = replace(whole, name=f"{whole.name}-unblended", label=f"{whole.label}, not blended", is_blended=False)
    bare = replace(unblended, name=f"{whole.name}-bare", label=f"{whole.label}, not blended, ε = 0", margin=0.0)
    return [whole, unblended, bare]


def _trained_bare(whole: Method, name: str, *, folder: str) -> Method:
    """The paper's layer trained as such, by the weights in `folder`: their ε is 0 already."""
    label = f"{whole.label}, not blended, ε = 0, trained so (the paper's)"
    return replace(whole, name=name, label=label, folder=folder, is_blended=False)


def _with_refu(backbone: str, label: str, modes: tuple[str, ...]) -> list[Method]:
    return [
        Method(name=backbone, label=label, backbone=backbone, base=backbone),
        *(
            Method(
                name=f"{backbone}-refu-{mode}",
                label=f"{label} with ReFU, {mode}",
                backbone=backbone,
                mode=mode,
                handling="refu",
                sdf=_RUN_TIME_SDF[mode],
                base=backbone,
            )
            for mode in modes
        ),
    ]


def _sequence() -> list[Method]:
    """The perceptron on continuous motion, trained on sequences of 5 or of 17 body shapes."""
    methods = []
    for shapes in SEQUENCE_SHAPES:
        name = f"mlp-{shapes}"
        alone = Method(name=name, label=f"MLP, {shapes} shapes", backbone="mlp", folder=f"sequence-{shapes}", base=name)
        methods += [
            alone,
            replace(
                alone,
                name=f"{name}-refu-approx",
                label=f"MLP with ReFU, approx, {shapes} shapes",
                mode="approx",
                handling="refu",
                sdf="approx",
            ),
        ]
    return methods


SEQUENCE_SHAPES = (5, 17)
"""Body shapes of the paper's two sets of sequences."""
_RUN_TIME_SDF: Mapping[str, SdfName] = {"approx": "approx", "accurate": "accurate", "hybrid": "approx"}
"""Hybrid: the accurate distance is in the training's loss, the approximate one in ReFU (paper, Sec. "Settings")."""

METHODS: Mapping[str, Method] = {
    method.name: method
    for method in (
        Method(name="skinned", label="skinned template (no network)", backbone="skinned", base="skinned"),
        Method(
            name="skinned-naive",
            label="skinned, naive post-process, accurate",
            backbone="skinned",
            handling="naive",
            sdf="accurate",
            base="skinned",
        ),
        Method(
            name="skinned-optimisation",
            label="skinned, optimisation post-process, accurate",
            backbone="skinned",
            handling="optimisation",
            sdf="accurate",
            base="skinned",
        ),
        Method(
            name="node-skinned",
            label="the node, skinned, accurate",
            backbone="skinned",
            mode="accurate",
            handling="node",
            sdf="accurate",
            base="skinned",
        ),
        *_tailornet(),
        *_with_refu("gcnn", "GCNN", ("approx", "accurate", "hybrid")),
        *_sequence(),
    )
}
"""All methods by name."""

SAMPLE_TABLES: Mapping[str, tuple[str, ...]] = {
    "comparison": (
        "skinned",
        "tailornet",
        "naive-approx",
        "naive-accurate",
        "optimisation-approx",
        "optimisation-accurate",
        "optimisation-approx-margin",
        "optimisation-accurate-margin",
        "optimisation-on-hybrid",
        "optimisation-kept-on-hybrid",
        "collision-loss-approx",
        "collision-loss-accurate",
        "refu-approx",
        "refu-accurate",
        "refu-hybrid",
        "node-skinned",
        "node-approx",
        "node-accurate",
        "node-hybrid",
    ),
    "ablation": (
        "tailornet",
        *(f"fixed-bare-{sdf}" for sdf in _SDFS),
        *(f"bare-{mode}" for mode in _RUN_TIME_SDF),
        *(f"fixed-{sdf}{kind}" for kind in ("-bare", "-unblended", "") for sdf in _SDFS),
        *(f"refu-{mode}{kind}" for kind in ("-bare", "-unblended", "") for mode in _RUN_TIME_SDF),
    ),
    "alpha": ("tailornet", "alt1-approx", "alt2-approx", "refu-approx"),
    "gcnn": ("gcnn", "gcnn-refu-approx", "gcnn-refu-accurate", "gcnn-refu-hybrid"),
    "laplacian": (
        "tailornet",
        "skinned-naive",
        "skinned-optimisation",
        "optimisation-approx",
        "optimisation-accurate",
        "optimisation-approx-margin",
        "optimisation-accurate-margin",
        "optimisation-on-hybrid",
        "optimisation-kept-on-hybrid",
        "refu-approx",
        "refu-accurate",
        "refu-hybrid",
        "node-hybrid",
    ),
    "energy": ("skinned", "tailornet", "refu-approx", "refu-accurate", "refu-hybrid"),
    "unseen": ("tailornet", "collision-loss-approx", "collision-loss-accurate", "refu-approx", "refu-hybrid"),
    "time": (
        "skinned-naive",
        "skinned-optimisation",
        "optimisation-approx",
        "optimisation-accurate",
        "optimisation-kept-on-hybrid",
        "refu-accurate",
        "refu-hybrid",
        "node-hybrid",
    ),
}
"""Which methods each table over test samples is about, in the order of its rows."""
