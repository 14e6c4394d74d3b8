"""Definitions of the messages this project reads and writes, as ROS 2 Jazzy has them.

A bag carries the text of every message type with those it is built from, so that a reader without ROS can decode it,
and the type's hash (RIHS01), by which ROS knows that two ends mean the same.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache

from msg_adapters.errors import BagError

_FIELDS = {
    "builtin_interfaces/Duration": "int32 sec\nuint32 nanosec",
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "diagnostic_msgs/DiagnosticArray": "std_msgs/Header header\ndiagnostic_msgs/DiagnosticStatus[] status",
    "diagnostic_msgs/DiagnosticStatus": """\
byte OK=0
byte WARN=1
byte ERROR=2
byte STALE=3
byte level
string name
string message
string hardware_id
diagnostic_msgs/KeyValue[] values""",
    "diagnostic_msgs/KeyValue": "string key\nstring value",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation",
    "geometry_msgs/PoseArray": "std_msgs/Header header\ngeometry_msgs/Pose[] poses",
    "geometry_msgs/Quaternion": "float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z",
    "sensor_msgs/CompressedImage": "std_msgs/Header header\nstring format\nuint8[] data",
    "sensor_msgs/JointState": """\
std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort""",
    "smpl_msgs/Smpl": """\
std_msgs/Header header
float64[69] body_pose
float64[3] transl
float64[3] global_orient
float64[10] betas
float64[72] keypoints""",
    "std_msgs/ColorRGBA": "float32 r\nfloat32 g\nfloat32 b\nfloat32 a",
    "std_msgs/Float32MultiArray": "std_msgs/MultiArrayLayout layout\nfloat32[] data",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "std_msgs/MultiArrayDimension": "string label\nuint32 size\nuint32 stride",
    "std_msgs/MultiArrayLayout": "std_msgs/MultiArrayDimension[] dim\nuint32 data_offset",
    "visualization_msgs/Marker": """\
int32 ARROW=0
int32 CUBE=1
int32 SPHERE=2
int32 CYLINDER=3
int32 LINE_STRIP=4
int32 LINE_LIST=5
int32 CUBE_LIST=6
int32 SPHERE_LIST=7
int32 POINTS=8
int32 TEXT_VIEW_FACING=9
int32 MESH_RESOURCE=10
int32 TRIANGLE_LIST=11
int32 ARROW_STRIP=12
int32 ADD=0
int32 MODIFY=0
int32 DELETE=2
int32 DELETEALL=3
std_msgs/Header header
string ns
int32 id
int32 type
int32 action
geometry_msgs/Pose pose
geometry_msgs/Vector3 scale
std_msgs/ColorRGBA color
builtin_interfaces/Duration lifetime
bool frame_locked
geometry_msgs/Point[] points
std_msgs/ColorRGBA[] colors
string texture_resource
sensor_msgs/CompressedImage texture
visualization_msgs/UVCoordinate[] uv_coordinates
string text
string mesh_resource
visualization_msgs/MeshFile mesh_file
bool mesh_use_embedded_materials""",
    "visualization_msgs/MarkerArray": "visualization_msgs/Marker[] markers",
    "visualization_msgs/MeshFile": "string filename\nuint8[] data",
    "visualization_msgs/UVCoordinate": "float32 u\nfloat32 v",
}
"""Fields of each message type; constants are part of a definition."""

_HASHES = {
    "diagnostic_msgs/msg/DiagnosticArray": "RIHS01_5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
    "geometry_msgs/msg/PoseArray": "RIHS01_af0cc36d190e104d546d168d6b39df04fa4b4ccecf59cb4c9ed328d3d5004aa0",
    "sensor_msgs/msg/JointState": "RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e",
    "smpl_msgs/msg/Smpl": "RIHS01_f7972b5305264eb5c6fa6ad0eb5e986b6492677eb80c2186c30ab4470be62ce8",
    "std_msgs/msg/Float32MultiArray": "RIHS01_0599f6f85b4bfca379873a0b4375a0aca022156bd2d7021275d116ed1fa8bfe0",
    "visualization_msgs/msg/MarkerArray": "RIHS01_86cb8800b6fb05b5eff1abd7a56f62a5641d3ae9a1c29e78e67e704f1d067dcf",
}
"""Types that may be a topic's, with their RIHS01 hashes."""

_SEPARATOR = "=" * 80
_NESTED = re.compile(r"^(\w+/\w+)(?:\[\d*\])? \w+", re.MULTILINE)


@dataclass(frozen=True)
class MessageDefinition:
    """A message type's text with all it depends on (`ros2msg`), and its hash."""

    text: str
    type_hash: str


def full_type_name(name: str) -> str:
    """`package/msg/Type` of `package/Type` or `package/msg/Type`."""
    package, _, rest = name.partition("/")
    return name if rest.startswith("msg/") or not rest else f"{package}/msg/{rest}"


def _dependencies(name: str, found: dict[str, None]) -> None:
    for nested in _NESTED.findall(_FIELDS[name]):
        if nested not in found:
            found[nested] = None
            _dependencies(nested, found)


@cache
def message_definition(message_type: str) -> MessageDefinition:
    """The definition of a type this project writes.

    Raises `BagError` for any other; topics of those take the definition of the bag they were read from.
    """
    full_name = full_type_name(message_type)
    if full_name not in _HASHES:
        msg = (
            f"no definition of {message_type} is built in (there are {', '.join(_HASHES)}); give its text as definition"
        )
        raise BagError(msg)
    name = full_name.replace("/msg/", "/")
    nested: dict[str, None] = {}
    _dependencies(name, nested)
    parts = [_FIELDS[name], *(f"MSG: {dependency}\n{_FIELDS[dependency]}" for dependency in nested)]
    return MessageDefinition(text=f"\n{_SEPARATOR}\n".join(parts) + "\n", type_hash=_HASHES[full_name])
