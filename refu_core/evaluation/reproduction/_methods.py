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
    variant: str = "none"
    """How the backbone was trained; `none` without collision handling. Weights are called `<backbone>-<variant>`."""
    handling: Handling = "none"
    """What happens to the backbone's garment: nothing; x - f ∇f (naive); sparse least squares (optimisation); ReFU as
    in the paper; or whatever the node does, in the mode `variant`: ReFU, a second look at what it moved, edges,
    limbs."""
    sdf: SdfName | None = None
    """Signed distance at run time."""
    margin: float | None = None
    """ε in place of the trained one, or of the optimisation's own 1 mm [m]."""
    is_blended: bool = True
    """Whether ReFU's pushes take the neighbourhood along, which the paper's don't."""
    base: str = "tailornet"
    """The method whose colliding vertices are the region of the local Laplacian error."""

    @property
    def weights(self) -> str | None:
        """Name of the weights' files without suffix; None where no network is needed."""
        return None if self.backbone == "skinned" else f"{self.backbone}-{self.variant}"

    def train_command(self, garment: str) -> str:
        """The command that makes the weights; empty where none are needed."""
        if self.weights is None:
            return ""
        return f"refu train {garment} --data DIR --backbone {self.backbone} --mode {self.variant}"


_SDFS: tuple[SdfName, ...] = ("approx", "accurate")


def _tailornet() -> list[Method]:
    methods = [Method(name="tailornet", label="backbone alone (TailorNet)")]
    for sdf in _SDFS:
        methods += [
            Method(name=f"naive-{sdf}", label=f"naive post-process, {sdf}", handling="naive", sdf=sdf),
            Method(
                name=f"optimisation-{sdf}", label=f"optimisation post-process, {sdf}", handling="optimisation", sdf=sdf
            ),
            Method(name=f"collision-loss-{sdf}", label=f"collision loss, {sdf}", variant=f"collision-loss-{sdf}"),
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
    methods.append(
        Method(
            name="optimisation-on-hybrid",
            label="optimisation post-process, approx, with ReFU's margin, of what ReFU hybrid's own backbone predicts",
            variant="hybrid",
            handling="optimisation",
            sdf="approx",
            margin=DEFAULT_MARGIN,
        )
    )
    for mode, sdf in _RUN_TIME_SDF.items():
        methods += _ablated(f"refu-{mode}", f"ReFU, {mode}", mode, sdf)
        methods.append(Method(name=f"node-{mode}", label=f"the node, {mode}", variant=mode, handling="node", sdf=sdf))
    for sdf in _SDFS:
        methods += _ablated(f"fixed-{sdf}", f"fixed scale, {sdf}", f"fixed-{sdf}", sdf)
    for number in (1, 2):
        name = f"alt{number}-approx"
        methods.append(Method(name=name, label=f"Alt. {number}, approx", variant=name, handling="refu", sdf="approx"))
    return methods


def _ablated(name: str, label: str, variant: str, sdf: SdfName) -> list[Method]:
    """A ReFU with all it has, without the blending, and with neither that nor a margin: exactly the paper's layer."""
    whole = Method(name=name, label=label, variant=variant, handling="refu", sdf=sdf)
    return [
        whole,
        replace(whole, name=f"{name}-unblended", label=f"{label}, not blended", is_blended=False),
        replace(whole, name=f"{name}-bare", label=f"{label}, not blended, ε = 0", is_blended=False, margin=0.0),
    ]


def _with_refu(backbone: str, label: str, modes: tuple[str, ...]) -> list[Method]:
    return [
        Method(name=backbone, label=label, backbone=backbone, base=backbone),
        *(
            Method(
                name=f"{backbone}-refu-{mode}",
                label=f"{label} with ReFU, {mode}",
                backbone=backbone,
                variant=mode,
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
        alone = Method(name=name, label=f"MLP, {shapes} shapes", backbone="mlp", variant=f"none-{shapes}", base=name)
        methods += [
            alone,
            replace(
                alone,
                name=f"{name}-refu-approx",
                label=f"MLP with ReFU, approx, {shapes} shapes",
                variant=f"approx-{shapes}",
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
            variant="accurate",
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
        "refu-accurate",
        "refu-hybrid",
    ),
}
"""Which methods each table over test samples is about, in the order of its rows."""
