"""The four message types a body may arrive in: CDR bytes or message objects to `SmplFrame`, and back to CDR bytes."""

from msg_adapters.inputs._registry import (
    INPUT_TYPES,
    Decoder,
    Encoder,
    InputType,
    decoder_for,
    encoder_for,
    frame_id_of,
)

__all__ = ["INPUT_TYPES", "Decoder", "Encoder", "InputType", "decoder_for", "encoder_for", "frame_id_of"]
