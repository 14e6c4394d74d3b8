"""What robots and planners ask of dressed people, besides meshes; nothing of it is computed unless it is asked for."""

from refu_core.outputs._clearance import REACH, Clearance
from refu_core.outputs._dressed import Dressed, Fittings
from refu_core.outputs._limbs import PRESSED, LimbContact, LimbContacts
from refu_core.outputs._normals import VertexNormals
from refu_core.outputs._openings import Opening, Openings
from refu_core.outputs._planner import HALF_THICKNESS, MAX_TRIANGLES, PlannerMesh
from refu_core.outputs._sigma import (
    RADIUS_90,
    UNKNOWN_SIGMA,
    Sigma,
    SigmaMap,
    bend_of,
    fit_sigma,
    load_sigma,
    save_sigma,
)
from refu_core.outputs._visible import DepthImage, PinholeCamera, all_visible, depth_image, visible

__all__ = [
    "HALF_THICKNESS",
    "MAX_TRIANGLES",
    "PRESSED",
    "RADIUS_90",
    "REACH",
    "UNKNOWN_SIGMA",
    "Clearance",
    "DepthImage",
    "Dressed",
    "Fittings",
    "LimbContact",
    "LimbContacts",
    "Opening",
    "Openings",
    "PinholeCamera",
    "PlannerMesh",
    "Sigma",
    "SigmaMap",
    "VertexNormals",
    "all_visible",
    "bend_of",
    "depth_image",
    "fit_sigma",
    "load_sigma",
    "save_sigma",
    "visible",
]
