#!/usr/bin/env python3
"""Draws docs/images/collider.jpg: poses in which the body touches itself, before and after, and dressed.

python scripts/make_collider_picture.py
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from refu_core import GarmentPipeline, SmplFrame
from refu_core.body import joints_of
from refu_core.modes import DEFAULT_GARMENTS
from refu_lab.render import SKIN, Camera, RenderMesh, render
from refu_lab.touching_poses import TOUCHING_POSES, touching_pose

_MOVED = (0.80, 0.24, 0.20)
"""sRGB colour of skin that was moved by `_MOST` or more."""
_MOST = 0.02  # [m]


def collider_sheet(
    *,
    garments: Sequence[str] = DEFAULT_GARMENTS,
    poses: Sequence[str] = tuple(TOUCHING_POSES),
    size: tuple[int, int] = (230, 270),
    yaw: float = 25.0,
    samples: int = 9,
) -> NDArray[np.uint8]:
    """A column a pose: the skin, the collider with what was moved in red, and the garments on it.

    Args:
        garments: worn together.
        poses: names of `TOUCHING_POSES`.
        size: width and height of one picture [pixels].
        yaw: of the camera, from the front towards the subject's left [degrees].
        samples: rays a pixel.

    Returns:
        sRGB, shape (3 height, columns width, 3).

    Raises:
        RefuError: no such pose or garment.
    """
    pipeline = GarmentPipeline.load(garments)
    faces = pipeline.body.faces.numpy()
    lower = joints_of("left_shin", "right_shin")
    is_framed = ~torch.isin(pipeline.body.weights.argmax(1), torch.tensor(lower)).numpy()
    columns = []
    for name in poses:
        out = pipeline(SmplFrame(pose=touching_pose(name)))
        camera = Camera.framing(out.skin[is_framed], size=size, yaw=yaw, pitch=20.0)
        share = np.clip(np.linalg.norm(out.body - out.skin, axis=1) / _MOST, 0, 1)[:, None]
        moved = (1 - share) * np.array(SKIN) + share * np.array(_MOVED)
        worn = [RenderMesh(m.local, m.faces, pipeline.garments[g].card.color) for g, m in out.items()]
        scenes = (
            [RenderMesh(out.skin, faces)],
            [RenderMesh(out.body, faces, moved)],
            [RenderMesh(out.body, faces), *worn],
        )
        columns.append(np.concatenate([render(one, camera=camera, size=size, samples=samples) for one in scenes]))
    return np.concatenate(columns, axis=1)


def main() -> None:
    """Writes the picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, default=Path(__file__).parents[1] / "docs" / "images" / "collider.jpg")
    parser.add_argument("--garments", nargs="+", default=DEFAULT_GARMENTS, help="worn together")
    parser.add_argument("--poses", nargs="+", default=tuple(TOUCHING_POSES), choices=TOUCHING_POSES, metavar="POSE")
    parser.add_argument("--size", type=int, nargs=2, default=(230, 270), help="of one picture [pixels]")
    parser.add_argument("--yaw", type=float, default=25.0, help="of the camera, from the front [degrees]")
    arguments = parser.parse_args()
    sheet = collider_sheet(
        garments=arguments.garments, poses=arguments.poses, size=tuple(arguments.size), yaw=arguments.yaw
    )
    Image.fromarray(sheet).save(arguments.output, quality=88, optimize=True)
    print(arguments.output)


if __name__ == "__main__":
    main()
