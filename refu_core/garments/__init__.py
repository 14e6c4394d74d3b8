"""Garments: their files, how they follow shape and style, how they are posed and unposed."""

from refu_core.frames import N_STYLES
from refu_core.garments._below import SkinBelow
from refu_core.garments._card import GarmentCard, Tailoring, card_to_json
from refu_core.garments._file import load_garment
from refu_core.garments._template import GarmentTemplate, inner_first
from refu_core.garments._transfer import worn_on
from refu_core.modes import BUILTIN_GARMENTS, DEFAULT_GARMENTS

__all__ = [
    "BUILTIN_GARMENTS",
    "DEFAULT_GARMENTS",
    "N_STYLES",
    "GarmentCard",
    "GarmentTemplate",
    "SkinBelow",
    "Tailoring",
    "card_to_json",
    "inner_first",
    "load_garment",
    "worn_on",
]
