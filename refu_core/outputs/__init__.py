"""What robots and planners ask of dressed people, besides meshes; nothing of it is computed unless it is asked for."""

from refu_core.outputs._dressed import Dressed, Fittings
from refu_core.outputs._normals import VertexNormals
from refu_core.outputs._openings import Opening, Openings
from refu_core.outputs._planner import HALF_THICKNESS, MAX_TRIANGLES, PlannerMesh

__all__ = [
    "HALF_THICKNESS",
    "MAX_TRIANGLES",
    "Dressed",
    "Fittings",
    "Opening",
    "Openings",
    "PlannerMesh",
    "VertexNormals",
]
