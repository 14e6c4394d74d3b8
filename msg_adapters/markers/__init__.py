"""visualization_msgs/MarkerArray with one TRIANGLE_LIST or POINTS a garment, between arrays and CDR bytes."""

from msg_adapters.markers._decoder import Marker, decode_marker_array, vertices_from_points
from msg_adapters.markers._encoder import (
    MARKER_ARRAY,
    POINTS,
    MarkerArrayEncoder,
    encode_delete,
    encode_delete_all,
    encode_points,
    encode_strips,
)
from msg_adapters.markers._mesh import MarkerMesh, garment_namespace

__all__ = [
    "MARKER_ARRAY",
    "POINTS",
    "Marker",
    "MarkerArrayEncoder",
    "MarkerMesh",
    "decode_marker_array",
    "encode_delete",
    "encode_delete_all",
    "encode_points",
    "encode_strips",
    "garment_namespace",
    "vertices_from_points",
]
