"""What robots and planners want to know of dressed people, as messages: points, openings, meshes."""

from msg_adapters.outputs._meshes import COLLISION_OBJECT as COLLISION_OBJECT
from msg_adapters.outputs._meshes import MESH as MESH
from msg_adapters.outputs._meshes import POLYGON as POLYGON
from msg_adapters.outputs._meshes import SCENE_UPDATE as SCENE_UPDATE
from msg_adapters.outputs._meshes import Entity as Entity
from msg_adapters.outputs._meshes import Rim as Rim
from msg_adapters.outputs._meshes import encode_collision_object as encode_collision_object
from msg_adapters.outputs._meshes import encode_frames as encode_frames
from msg_adapters.outputs._meshes import encode_mesh as encode_mesh
from msg_adapters.outputs._meshes import encode_polygon as encode_polygon
from msg_adapters.outputs._meshes import encode_rims as encode_rims
from msg_adapters.outputs._meshes import encode_scene as encode_scene
from msg_adapters.outputs._points import POINT_CLOUD as POINT_CLOUD
from msg_adapters.outputs._points import POINT_FIELDS as POINT_FIELDS
from msg_adapters.outputs._points import PointCloudEncoder as PointCloudEncoder
from msg_adapters.outputs._points import points_of as points_of
from msg_adapters.outputs._table import GARMENTS as GARMENTS
from msg_adapters.outputs._table import make_outputs as make_outputs
from msg_adapters.outputs._topics import Moment as Moment
