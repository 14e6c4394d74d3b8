"""What a body may arrive in: messages of SMPL parameters to `SmplFrame` and back, messages of keypoints to points."""

from msg_adapters.inputs._keypoints import KEYPOINT_TYPES, Keypoints, KeypointType, decode_keypoints
from msg_adapters.inputs._registry import (
    INPUT_TYPES,
    Decoder,
    Encoder,
    InputType,
    decoder_for,
    encoder_for,
    frame_id_of,
)

__all__ = [
    "INPUT_TYPES",
    "KEYPOINT_TYPES",
    "Decoder",
    "Encoder",
    "InputType",
    "KeypointType",
    "Keypoints",
    "decode_keypoints",
    "decoder_for",
    "encoder_for",
    "frame_id_of",
]
