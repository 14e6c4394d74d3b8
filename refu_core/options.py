"""Settings that say what they are for: fields of a dataclass, which nodes take as parameters and commands as options.

Modules that load torch are imported only where needed, so that a mistyped setting is reported before that.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from refu_core.errors import RefuError
from refu_core.frames import N_BETAS, N_STYLES, SmplFrame
from refu_core.modes import (
    BUILTIN_BODIES,
    DEFAULT_GARMENTS,
    DEFAULT_MARGIN,
    MAX_MARGIN,
    BackboneName,
    BetasSource,
    SdfMode,
)

if TYPE_CHECKING:
    from refu_core.garments import GarmentTemplate
    from refu_core.realtime import GarmentPipeline


class SettingsError(RefuError, ValueError):
    """A setting that has no meaning, or settings that can't go together."""


@dataclass(frozen=True)
class Spec:
    """All there is to know about a setting."""

    default: Any
    description: str
    within: tuple[float, float] | None = None
    choices: tuple[str, ...] = ()
    live: bool = True
    """Whether it may change while a node runs."""
    metavar: str = ""
    """Stands for the value in a command's help; FILE and DIR for paths, A,B for names or paths."""
    parse: Callable[[str], Any] | None = None
    """Parses the text that a command was given, where the default doesn't tell the type."""

    @property
    def is_path(self) -> bool:
        """Whether the value, or a list's items, may be paths: `~` is a home in them."""
        return self.metavar in ("FILE", "DIR", "A,B")

    @property
    def kind(self) -> type:
        """The type of the value, or of a list's items."""
        return type(self.default[0] if isinstance(self.default, tuple) and self.default else self.default)


def setting(default: Any, description: str, **limits: Any) -> Any:
    """A field that is a setting; `limits` are those of `Spec`."""
    return field(default=default, metadata={"spec": Spec(default, description, **limits)})


fixed = partial(setting, live=False)
"""A field that is a setting, and can't change while a node runs."""


def specs_of(kind: Any) -> dict[str, Spec]:
    """The settings of a dataclass by name."""
    return {item.name: item.metadata["spec"] for item in fields(kind) if "spec" in item.metadata}


def check(settings: Any) -> None:
    """Raises `SettingsError` for a value out of its range, or not among its choices; None is allowed there."""
    for name, spec in specs_of(type(settings)).items():
        value = getattr(settings, name)
        if spec.choices and value not in (*spec.choices, None):
            raise SettingsError(f"{name}: wanted {' or '.join(spec.choices)}, got {value!r}")
        if spec.within is None:
            continue
        low, high = spec.within
        for number in value if isinstance(value, tuple) else (value,):
            if not low <= number <= high:  # NaN fails this, too
                raise SettingsError(f"{name}: wanted {low:g} to {high:g}, got {number:g}")


def arguments(settings: Any, *names: str) -> list[str]:
    """The named settings as a command's arguments, without flags at their default and settings left empty."""
    found = []
    for name in names:
        value, flag = getattr(settings, name), name.replace("_", "-")
        if isinstance(value, bool):
            found += [] if value == specs_of(type(settings))[name].default else [f"--{'' if value else 'no-'}{flag}"]
        elif value not in (None, "", ()):
            found.append(f"--{flag}={','.join(map(str, value)) if isinstance(value, tuple) else value}")
    return found


@dataclass(frozen=True, kw_only=True)
class PipelineOptions:
    """What is worn by whom, and how it is computed: if one of these changes, another pipeline is needed."""

    garments: tuple[str, ...] = setting(DEFAULT_GARMENTS, "Garments that every person wears.", metavar="A,B")
    body: str = setting(
        "", "Body to dress: an SMPL file, or a built-in name; empty for the garments' own.", metavar="FILE"
    )
    betas_from: str = setting(
        "", "An SMPL file whose betas arrive: the built-in mesh follows them; empty for none.", metavar="FILE"
    )
    backbone: str = setting(
        "auto", "What predicts the garment before collisions are handled.", choices=tuple(BackboneName)
    )
    weights: str = setting(
        "",
        "Folder of your own weights (refu train), one subfolder per garment; empty for those that ship.",
        metavar="DIR",
    )
    sdf: str = setting("hybrid", "How collisions are found.", choices=tuple(SdfMode))
    collider: bool = setting(True, "Resolve collisions against the collider; if not, against the raw posed body.")
    device: str = setting("cpu", "Torch device: cpu or cuda.")

    def __str__(self) -> str:
        weights = f", weights {self.weights}" if self.weights else ""
        raw = "" if self.collider else ", no collider"
        wearer = f" on {self.body or self.betas_from}" if self.body or self.betas_from else ""
        return f"{', '.join(self.garments)}{wearer} ({self.backbone}, {self.sdf}, {self.device}{weights}{raw})"

    @property
    def pipeline(self) -> PipelineOptions:
        """These settings alone, without those that a subclass adds."""
        return PipelineOptions(**{name: getattr(self, name) for name in PIPELINE_OPTIONS})

    @property
    def of_one_style(self) -> list[str]:
        """The garments that have only one style, and ignore γ."""
        return [name for name in self.garments if _template(name).styledirs is None]

    def check_garments(self) -> None:
        """Raises `SettingsError` for garments that don't exist, or that can't be worn together."""
        if not self.garments or len(set(self.garments)) < len(self.garments):
            raise SettingsError(f"garments: wanted distinct names, at least one, got {list(self.garments)}")
        try:
            bodies = {name: _template(name).body for name in self.garments}
        except RefuError as error:
            raise SettingsError(f"garments: {error}") from error
        if not (self.body or self.betas_from) and len(set(bodies.values())) > 1:
            cut_for = ", ".join(f"{name} ({body})" for name, body in bodies.items())
            raise SettingsError(f"garments: one person wears garments of one body, got {cut_for}")

    def check_files(self) -> None:
        """Raises `RefuError` for a device, a body or weights that don't exist, as far as can be seen at once."""
        from refu_core._device import checked_device
        from refu_core.weights import weights_folder

        checked_device(self.device)
        for body in (self.body, self.betas_from):
            if body not in ("", *BUILTIN_BODIES) and not Path(body).is_file():
                raise SettingsError(f"no body {body!r}: wanted {', '.join(BUILTIN_BODIES)}, or an .npz or .pkl file")
        if self.weights and not Path(self.weights).is_dir():
            raise SettingsError(f"no weights {self.weights!r}: wanted a folder")
        is_auto = self.backbone == BackboneName.AUTO
        for name in self.garments if self.backbone != BackboneName.SKINNED else ():
            folder = weights_folder(_template(name).name, self.weights or None)
            if is_auto and not self.weights and not folder.exists():
                continue  # it is worn by skinning
            is_dynamic = self.backbone == BackboneName.DYNAMIC
            kind = BackboneName.TAILORNET if is_auto or is_dynamic else self.backbone
            for stem in (f"{kind}-{self.sdf}", *(["dynamics"] if is_dynamic else [])):
                path = folder / f"{stem}.safetensors"
                if not path.is_file():
                    what = f"no weights of {stem.replace('-', ' ')} for {name}: {path} is missing"
                    raise SettingsError(f"{what}; train them (refu train)")

    def load(self, **more: Any) -> GarmentPipeline:
        """The pipeline; `more` are other arguments of `GarmentPipeline.load`. Raises `RefuError` as that does."""
        from refu_core.realtime import GarmentPipeline

        asked: dict[str, Any] = {name: getattr(self, name) for name in PIPELINE_OPTIONS}
        return GarmentPipeline.load(**{name: value for name, value in asked.items() if value != ""}, **more)


PIPELINE_OPTIONS = tuple(specs_of(PipelineOptions))


@dataclass(frozen=True, kw_only=True)
class DressOptions(PipelineOptions):
    """`PipelineOptions`, and how the garments are worn."""

    margin: float = setting(
        DEFAULT_MARGIN,
        "Cloth nearer to the skin than this is pushed away from it [m].",
        within=(0.0, MAX_MARGIN),
        metavar="M",
    )
    style: tuple[float, ...] = setting(
        (0.0,) * N_STYLES,
        "Garment style γ in standard deviations; zeros are the mean style.",
        within=(-10.0, 10.0),
        metavar="G0,…",
    )
    betas: tuple[float, ...] = setting(
        (0.0,) * N_BETAS,
        "Everybody's shape in standard deviations, if betas_source is fixed; --betas of a command implies that.",
        within=(-20.0, 20.0),
        metavar="B0,…",
    )
    betas_source: str = setting(
        "message",
        "Whose betas arrive: message (those of body or betas_from), builtin, or fixed (ignored; betas are used).",
        choices=tuple(BetasSource),
    )

    @property
    def betas_are_told(self) -> bool:
        """Whether it is known which body the arriving betas belong to."""
        return bool(self.body or self.betas_from) or self.betas_source != BetasSource.MESSAGE

    @property
    def known_betas(self) -> tuple[float, ...] | None:
        """Everybody's shape, whatever arrives; None where the arriving betas count."""
        return self.betas if self.betas_source == BetasSource.FIXED else None

    def applied(self, frame: SmplFrame) -> SmplFrame:
        """The frame with the shape and style that were set; a style of its own stays."""
        if self.known_betas is not None:
            frame = replace(frame, betas=np.array(self.known_betas, np.float32))
        if frame.style is None and any(self.style):
            frame = replace(frame, style=np.array(self.style, np.float32))
        return frame


@cache
def _template(name: str) -> GarmentTemplate:
    from refu_core.garments import load_garment

    return load_garment(name)
