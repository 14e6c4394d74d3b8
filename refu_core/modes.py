"""What a user may ask for: garments and modes by name, and the margin."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import TypeVar

from refu_core.errors import RefuError

GARMENT_FILE = "garment_{}.npz"
"""The name of a garment's file in a folder of garments."""
PAPER_GARMENTS: tuple[str, ...] = ("shirt-male", "tshirt-male", "short-pant-male", "skirt-female")
"""The garments of the paper's tables; trained weights for these ship."""
_FILES = (Path(__file__).parent / "assets").glob(GARMENT_FILE.format("*"))
BUILTIN_GARMENTS = (*PAPER_GARMENTS, *sorted({p.stem.removeprefix("garment_") for p in _FILES} - set(PAPER_GARMENTS)))
"""Garments that ship."""
BUILTIN_BODIES: tuple[str, ...] = ("male", "female", "neutral")
"""Bodies that ship."""
DEFAULT_GARMENTS: tuple[str, ...] = ("tshirt-male", "short-pant-male")
"""What a person wears if nothing else is said."""

DEFAULT_MARGIN = 0.004
"""ε: vertices nearer to the skin than this are pushed away, to half of it at least [m]. A garment's edges cut the
corners between its vertices: with vertices exactly on the skin (ε = 0, the paper's fixed scale) edges run through it; a
few mm clear nearly all."""
MAX_MARGIN = 0.05
"""The largest ε that makes sense [m]: a garment farther off the skin isn't worn."""

Name = TypeVar("Name", bound="Choice")


class Choice(str, Enum):
    """A string out of a few choices; it prints as the plain string."""

    __str__ = str.__str__

    @classmethod
    def of(cls: type[Name], text: str, what: str, *, error: type[RefuError] = RefuError) -> Name:
        """The choice that `text` names. Raises `error` if there is no such choice."""
        try:
            return cls(text)
        except ValueError:
            raise error(f"no {what} {text!r}: wanted {', '.join(cls)}") from None


class SdfMode(Choice):
    """How collisions are found, and what the weights were trained with (paper, Sec. 4.1)."""

    HYBRID = "hybrid"
    """With the approximate signed distance; the weights were trained with the accurate one in the loss."""
    APPROX = "approx"
    """With the approximate one, in training and at run time."""
    ACCURATE = "accurate"
    """With the exact one, in training and at run time."""
    NONE = "none"
    """Not at all: the raw backbone."""


class BackboneName(Choice):
    """What predicts a garment."""

    AUTO = "auto"
    """The best that there is for a garment: `dynamic` or `tailornet`, or `skinned` if no weights ship for it."""
    SKINNED = "skinned"
    """No network: the template follows the skin."""
    TAILORNET = "tailornet"
    DYNAMIC = "dynamic"
    """`tailornet`, plus the effect of how a person has moved in the last half second."""
    MLP = "mlp"
    GCNN = "gcnn"


class BetasSource(Choice):
    """Which body the arriving betas belong to."""

    MESSAGE = "message"
    """To the body that was named; if none was, that is unknown, and a warning says so."""
    BUILTIN = "builtin"
    """To the built-in body's own shape space."""
    FIXED = "fixed"
    """To no body: they are ignored, and the betas that were set are used."""


ONE_STYLE = "a style arrives, which garments of one style don't hear of: {}"
"""The warning, given once, with the garments' names."""
FOREIGN_BETAS = (
    "betas arrive, and nothing says what they are of: they are taken for the built-in body's own, and SMPL's mean "
    "other shapes; name the SMPL file that they are of (body or betas_from), or set betas_source to builtin or fixed"
)
"""The warning, given once, if betas other than zeros arrive in messages or files for a built-in body."""
