"""Garment templates: the four built-in garments, how they follow shape and style, how they are posed and unposed."""

from refu_core.garments._template import (
    BUILTIN_GARMENTS,
    LAYERS,
    N_STYLES,
    GarmentTemplate,
    inner_first,
    load_garment,
    unique_edges,
)

__all__ = ["BUILTIN_GARMENTS", "LAYERS", "N_STYLES", "GarmentTemplate", "inner_first", "load_garment", "unique_edges"]
