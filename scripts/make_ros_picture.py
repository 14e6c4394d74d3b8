"""Draws docs/images/ros.png: three persons of `smpl_publisher`, dressed, as a viewer shows them.

python scripts/make_ros_picture.py
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from msg_adapters import iter_smpl_frames
from refu_core import GarmentPipeline, SmplFrame
from refu_core.modes import DEFAULT_GARMENTS
from refu_lab.render import Camera, RenderMesh, render

ROOT = Path(__file__).parents[1]
SIZE = (900, 480)
FRAMES = (18, 70, 122)
SPACING_M = 1.0


def main() -> None:
    """Writes the picture."""
    pipeline = GarmentPipeline.load(DEFAULT_GARMENTS)
    recorded = [record.frame for record in iter_smpl_frames(ROOT / "bags" / "walk")]
    meshes = []
    for i, index in enumerate(FRAMES):
        frame = recorded[index]
        assert frame is not None, "the shipped bags have no bad frame"
        place = np.array([(i - 1) * SPACING_M, frame.transl[1], 0.0])
        output = pipeline(SmplFrame(frame.pose, betas=frame.betas, transl=place))
        meshes.append(RenderMesh(output.body + place, pipeline.body.faces.numpy()))
        meshes += [
            RenderMesh(mesh.vertices, mesh.faces, pipeline.garments[name].card.color) for name, mesh in output.items()
        ]
    camera = Camera.framing(np.concatenate([mesh.vertices for mesh in meshes]), size=SIZE, yaw=28.0, pitch=10.0)
    path = ROOT / "docs" / "images" / "ros.png"
    Image.fromarray(render(meshes, camera=camera, size=SIZE, samples=16)).save(path, optimize=True)


if __name__ == "__main__":
    main()
