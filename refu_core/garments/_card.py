"""What is known of a garment besides its mesh, and how its file stores that: as JSON text under the key `card`."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, fields
from typing import Any

from refu_core._files import parse_json
from refu_core.frames import N_JOINTS, N_STYLES

_MAX_LAYER = 99


@dataclass(frozen=True)
class Tailoring:
    """One tailoring parameter: how far the cut moves at the place where it moves most [m]."""

    name: str
    mean: float
    """Added to the template as it was cut: the middle of the range."""
    std: float
    """Standard deviation of the parameter; γ of ±2 reaches two of them."""


@dataclass(frozen=True)
class GarmentCard:
    """What is known of a garment besides its mesh. Raises `ValueError` for values that no garment has."""

    layer: int
    """A garment is worn over those with a lower number; within a layer, the one named later is the outer one."""
    color: tuple[float, float, float]
    """sRGB, 0 to 1."""
    joints: tuple[int, ...]
    """Joints that affect the garment (Patel et al. 2020); the others would only be a source of overfitting."""
    held_at_waist: bool
    """Whether a waistband holds it; otherwise it hangs from the shoulders."""
    tailoring: tuple[Tailoring, ...]
    """The parameters that its styles are made of, four or none."""
    provenance: str
    """What it was made from, by what, and under which licence."""

    def __post_init__(self) -> None:
        numbers = [number for one in self.tailoring for number in (one.mean, one.std)]
        checks = {
            "layer": (_is_whole(self.layer, _MAX_LAYER), f"a whole number up to {_MAX_LAYER}"),
            "color": (
                len(self.color) == 3 and all(_is_number(c) and 0 <= c <= 1 for c in self.color),
                "three numbers from 0 to 1",
            ),
            "joints": (
                0 < len(set(self.joints)) == len(self.joints) and all(_is_whole(j, N_JOINTS - 1) for j in self.joints),
                f"different numbers of joints, 0 to {N_JOINTS - 1}",
            ),
            "held_at_waist": (isinstance(self.held_at_waist, bool), "true or false"),
            "tailoring": (
                len(self.tailoring) in (0, N_STYLES) and all(map(_is_number, numbers)),
                f"{N_STYLES} parameters or none, each a name, a mean and a standard deviation",
            ),
            "provenance": (isinstance(self.provenance, str), "a text"),
        }
        for name, (is_right, wanted) in checks.items():
            if not is_right:
                raise ValueError(f"{name}: wanted {wanted}, got {str(getattr(self, name))[:80]}")


def card_to_json(card: GarmentCard) -> str:
    """The card as JSON, as a garment's file stores it."""
    return json.dumps(asdict(card))


def json_to_card(text: bytes | str) -> GarmentCard:
    """The inverse of `card_to_json`. Raises `ValueError` if it isn't a card, `RecursionError` if nested too deeply."""
    values = parse_json(text.encode() if isinstance(text, str) else text)
    wanted = [field.name for field in fields(GarmentCard)]
    if not isinstance(values, dict) or sorted(values) != sorted(wanted):
        got = ", ".join(map(str, values))[:200] if isinstance(values, dict) else str(values)[:80]
        raise ValueError(f"wanted a card of {', '.join(wanted)}, got {got}")
    try:
        tailoring = tuple(Tailoring(**one) for one in values["tailoring"])
        rows = {name: tuple(values[name]) for name in ("color", "joints")}
        return GarmentCard(**{**values, **rows, "tailoring": tailoring})
    except TypeError as error:
        raise ValueError(f"a card of other types: {error}") from error


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _is_whole(value: Any, most: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= most
