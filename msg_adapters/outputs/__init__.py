"""What robots and planners read of dressed people, as messages: points, openings, meshes."""

from msg_adapters.outputs._meshes import COLLISION_OBJECT, MESH, Operation, encode_collision_object, encode_mesh
from msg_adapters.outputs._points import (
    POINT_CLOUD,
    POINT_FIELDS,
    PointCloudEncoder,
    PointField,
    decode_point_cloud,
    points_of,
)
from msg_adapters.outputs._rims import POLYGON, Rim, encode_frames, encode_polygon, encode_rims
from msg_adapters.outputs._scene import SCENE_UPDATE, Entity, encode_scene
from msg_adapters.outputs._table import GARMENTS, make_outputs
from msg_adapters.outputs._topics import Moment, Output, Wishes

__all__ = [
    "COLLISION_OBJECT",
    "GARMENTS",
    "MESH",
    "POINT_CLOUD",
    "POINT_FIELDS",
    "POLYGON",
    "SCENE_UPDATE",
    "Entity",
    "Moment",
    "Operation",
    "Output",
    "PointCloudEncoder",
    "PointField",
    "Rim",
    "Wishes",
    "decode_point_cloud",
    "encode_collision_object",
    "encode_frames",
    "encode_mesh",
    "encode_polygon",
    "encode_rims",
    "encode_scene",
    "make_outputs",
    "points_of",
]
