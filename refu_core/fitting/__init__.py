"""Garments of one's own: a mesh is read, cleaned, placed on a body and bound to it."""

from refu_core.fitting._fit import CLEARANCE, HOLDS, LONGEST_EDGE, FittedGarment, GarmentDetails, fit_garment
from refu_core.fitting._mesh_file import MESH_SUFFIXES, SurfaceMesh, read_surface
from refu_core.fitting._place import UNITS, UP_AXES, Placing
from refu_core.fitting._posed import PosedBody, standing_pose
from refu_core.fitting._transfer import Transfer

__all__ = [
    "CLEARANCE",
    "HOLDS",
    "LONGEST_EDGE",
    "MESH_SUFFIXES",
    "UNITS",
    "UP_AXES",
    "FittedGarment",
    "GarmentDetails",
    "Placing",
    "PosedBody",
    "SurfaceMesh",
    "Transfer",
    "fit_garment",
    "read_surface",
    "standing_pose",
]
