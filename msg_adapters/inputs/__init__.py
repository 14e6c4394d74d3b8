"""The messages that a body may arrive in: SMPL parameters to `SmplFrame` and back, keypoints to points."""

from msg_adapters.inputs._joint_state import body_of as body_of
from msg_adapters.inputs._keypoints import KEYPOINT_TYPES as KEYPOINT_TYPES
from msg_adapters.inputs._keypoints import Keypoints as Keypoints
from msg_adapters.inputs._keypoints import decode_keypoints as decode_keypoints
from msg_adapters.inputs._registry import INPUT_TYPES as INPUT_TYPES
from msg_adapters.inputs._registry import SMPL_TOPIC as SMPL_TOPIC
from msg_adapters.inputs._registry import Decoder as Decoder
from msg_adapters.inputs._registry import Encoder as Encoder
from msg_adapters.inputs._registry import decoder_for as decoder_for
from msg_adapters.inputs._registry import encoder_for as encoder_for
from msg_adapters.inputs._registry import frame_id_of as frame_id_of
