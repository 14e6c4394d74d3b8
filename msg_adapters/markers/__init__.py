"""visualization_msgs/MarkerArray with one TRIANGLE_LIST or POINTS per garment, between arrays and CDR bytes."""

from msg_adapters.markers._decoder import Marker as Marker
from msg_adapters.markers._decoder import decode_marker_array as decode_marker_array
from msg_adapters.markers._decoder import vertices_from_points as vertices_from_points
from msg_adapters.markers._encoder import ADD as ADD
from msg_adapters.markers._encoder import DELETE as DELETE
from msg_adapters.markers._encoder import DELETE_ALL as DELETE_ALL
from msg_adapters.markers._encoder import LINE_STRIP as LINE_STRIP
from msg_adapters.markers._encoder import MARKER_ARRAY as MARKER_ARRAY
from msg_adapters.markers._encoder import POINTS as POINTS
from msg_adapters.markers._encoder import SKIN as SKIN
from msg_adapters.markers._encoder import TRIANGLE_LIST as TRIANGLE_LIST
from msg_adapters.markers._encoder import MarkerArrayEncoder as MarkerArrayEncoder
from msg_adapters.markers._encoder import MarkerMesh as MarkerMesh
from msg_adapters.markers._encoder import encode_delete as encode_delete
from msg_adapters.markers._encoder import encode_lists as encode_lists
from msg_adapters.markers._encoder import finite_points as finite_points
from msg_adapters.markers._encoder import garment_namespace as garment_namespace
from msg_adapters.markers._encoder import triangles as triangles
