"""Input of the contenders: stretches of recorded motion at 30 Hz, as message bytes and as posed meshes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

import msg_adapters as adapters
from refu_core import GarmentPipeline, RefuError, SmplFrame
from refu_core.body import SmplBody
from refu_core.garments import GarmentTemplate
from refu_lab.benchmark._sdfs import SdfFrame

RATE = 30.0
"""Frame rate of the measured motion [Hz]."""
_MOTION_BAGS = ("walk", "reach_squat")
Stretch = Sequence[SmplFrame]


@dataclass(frozen=True, eq=False)
class EncodedFrame:
    """One frame in every form that a contender may need."""

    frame: SmplFrame
    raw: bytes
    """The input message (`std_msgs/Float32MultiArray`)."""
    sdf: SdfFrame
    """The body, and the garment before collisions are handled."""
    is_jump: bool
    """Whether it doesn't continue the frame before it."""


Window = Sequence[EncodedFrame]


def read_stretches(motions: Path | None, bags: Path, *, count: int, length: int) -> list[Stretch]:
    """`count` stretches of `length` frames at 30 Hz, evenly spread over all the motion there is.

    Raises:
        RefuError: there is no motion of that length, or a file can't be read.
    """
    starts = [(clip, start) for clip in _clips(motions, bags) for start in range(0, len(clip) - length + 1, length)]
    if not starts:
        where, wanted = (bags, "the repository's bags") if motions is None else (motions, "AMASS-style .npz files")
        msg = f"{where}: no motion of {length} frames at 30 Hz in it, wanted {wanted}; name a folder with --motions"
        raise RefuError(msg)
    picked = [starts[(2 * i + 1) * len(starts) // (2 * count)] for i in range(count)]
    return [clip[start : start + length] for clip, start in picked]


def _clips(motions: Path | None, bags: Path) -> Iterator[Stretch]:
    if motions is not None:
        for path in sorted(motions.glob("*.npz")):
            yield list(adapters.read_motion(path).resampled(RATE).frames())
        return
    for name in _MOTION_BAGS:
        if (bags / name).is_dir():
            with adapters.open_smpl_bag(bags / name) as bag:
                yield [record.frame for record in bag if record.frame is not None]


def moments(stretches: Sequence[Stretch], pipeline: GarmentPipeline) -> list[Window]:
    """The stretches as windows, with the only garment of `pipeline` in each frame before collision handling."""
    ((name, garment),) = pipeline.garments.items()
    encode = adapters.encoder_for("multiarray")
    windows: list[Window] = []
    for stretch in stretches:
        raw = [torch.tensor(pipeline(frame)[name].raw) for frame in stretch]
        worn = [sdf_frame(pipeline.body, garment, frame, posed) for frame, posed in zip(stretch, raw, strict=True)]
        windows.append(
            [EncodedFrame(f, encode(f), w, is_jump=i == 0) for i, (f, w) in enumerate(zip(stretch, worn, strict=True))]
        )
    return windows


@torch.no_grad()
def sdf_frame(body: SmplBody, garment: GarmentTemplate, frame: SmplFrame, posed: Tensor) -> SdfFrame:
    """A body, and a garment on it with vertices `posed` [m], shape (V, 3)."""
    pose, betas = torch.tensor(frame.pose)[None], torch.tensor(frame.betas)[None]
    output = body(pose, betas)
    unposed = garment.unpose(posed[None], output.transforms)
    on_mean_shape = unposed - (betas @ garment.shapedirs.T).view_as(unposed)
    return SdfFrame(output.vertices[0].numpy(), posed.numpy(), on_mean_shape[0], pose[0], betas[0])
