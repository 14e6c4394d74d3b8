"""Pure functions between ROS 2 messages, CDR bytes, bags and recorded motion on one side, `SmplFrame` on the other.

Nothing here imports rclpy or torch.
"""

from msg_adapters.axes import InputAxes, vertices_ros_from_smpl, vertices_smpl_from_ros
from msg_adapters.bags import (
    BAG_SUFFIXES,
    BagMessage,
    BagReader,
    BagWriter,
    FrameRecord,
    QosProfile,
    SmplBag,
    TopicInfo,
    iter_smpl_frames,
    open_smpl_bag,
)
from msg_adapters.definitions import MessageDefinition, message_definition
from msg_adapters.diagnostics import DIAGNOSTIC_ARRAY, DiagnosticStatus, encode_diagnostics
from msg_adapters.errors import AdapterError, BagError, DecodeError, EncodeError, MotionFileError
from msg_adapters.inputs import (
    INPUT_TYPES,
    KEYPOINT_TYPES,
    Decoder,
    Encoder,
    InputType,
    Keypoints,
    KeypointType,
    decode_keypoints,
    decoder_for,
    encoder_for,
    frame_id_of,
)
from msg_adapters.joints import SMPL_JOINTS
from msg_adapters.markers import (
    MARKER_ARRAY,
    POINTS,
    Marker,
    MarkerArrayEncoder,
    MarkerMesh,
    decode_marker_array,
    encode_delete,
    encode_delete_all,
    encode_points,
    garment_namespace,
    vertices_from_points,
)
from msg_adapters.motion import Motion, read_motion
from msg_adapters.people import KeypointStream
from msg_adapters.rotations import quaternion_from_rotvec, rotvec_from_quaternion, slerp

__all__ = [
    "BAG_SUFFIXES",
    "DIAGNOSTIC_ARRAY",
    "INPUT_TYPES",
    "KEYPOINT_TYPES",
    "MARKER_ARRAY",
    "POINTS",
    "SMPL_JOINTS",
    "AdapterError",
    "BagError",
    "BagMessage",
    "BagReader",
    "BagWriter",
    "DecodeError",
    "Decoder",
    "DiagnosticStatus",
    "EncodeError",
    "Encoder",
    "FrameRecord",
    "InputAxes",
    "InputType",
    "KeypointStream",
    "KeypointType",
    "Keypoints",
    "Marker",
    "MarkerArrayEncoder",
    "MarkerMesh",
    "MessageDefinition",
    "Motion",
    "MotionFileError",
    "QosProfile",
    "SmplBag",
    "TopicInfo",
    "decode_keypoints",
    "decode_marker_array",
    "decoder_for",
    "encode_delete",
    "encode_delete_all",
    "encode_diagnostics",
    "encode_points",
    "encoder_for",
    "frame_id_of",
    "garment_namespace",
    "iter_smpl_frames",
    "message_definition",
    "open_smpl_bag",
    "quaternion_from_rotvec",
    "read_motion",
    "rotvec_from_quaternion",
    "slerp",
    "vertices_from_points",
    "vertices_ros_from_smpl",
    "vertices_smpl_from_ros",
]
