"""Garments: their files, how they follow shape and style, how they are posed and unposed."""

from refu_core.frames import N_STYLES
from refu_core.garments._below import SkinBelow
from refu_core.garments._card import GarmentCard, Tailoring, card_to_json
from refu_core.garments._file import garment_name, load_garment, save_garment
from refu_core.garments._registry import garment_files, garments_folder
from refu_core.garments._template import GarmentTemplate, UvMap, inner_first
from refu_core.garments._transfer import worn_on
from refu_core.modes import BUILTIN_GARMENTS, DEFAULT_GARMENTS, PAPER_GARMENTS

__all__ = [
    "BUILTIN_GARMENTS",
    "DEFAULT_GARMENTS",
    "N_STYLES",
    "PAPER_GARMENTS",
    "GarmentCard",
    "GarmentTemplate",
    "SkinBelow",
    "Tailoring",
    "UvMap",
    "card_to_json",
    "garment_files",
    "garment_name",
    "garments_folder",
    "inner_first",
    "load_garment",
    "save_garment",
    "worn_on",
]
