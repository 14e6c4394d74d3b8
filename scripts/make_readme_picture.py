"""Draws docs/images/replay.png: frames of the shipped bags, dressed.

python scripts/make_readme_picture.py
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

import msg_adapters as adapters
from refu_core import GarmentPipeline
from refu_core.modes import DEFAULT_GARMENTS
from refu_lab.render import Camera, RenderMesh, render

ROOT = Path(__file__).parents[1]
SIZE = (330, 500)
PICTURES = (  # bag, frame, yaw of the camera relative to the person [degrees]
    ("walk", 18, 35.0),
    ("reach_squat", 62, 35.0),
    ("reach_squat", 120, 20.0),
    ("reach_squat", 243, 50.0),
)


def main() -> None:
    """Writes the picture."""
    pipeline = GarmentPipeline.load(DEFAULT_GARMENTS)
    body_faces = pipeline.body.faces.numpy()
    columns = []
    for bag, index, yaw in PICTURES:
        frame = [record.frame for record in adapters.iter_smpl_frames(ROOT / "bags" / bag)][index]
        assert frame is not None, "the shipped bags have no bad frame"
        output = pipeline(frame)
        forward = Rotation.from_rotvec(frame.pose[0]).apply([0.0, 0.0, 1.0])
        camera = Camera.framing(output.body, size=SIZE, yaw=float(np.degrees(np.arctan2(*forward[[0, 2]]))) + yaw)
        meshes = [RenderMesh(output.body, body_faces)]
        meshes += [
            RenderMesh(mesh.local, mesh.faces, pipeline.garments[name].card.color) for name, mesh in output.items()
        ]
        columns.append(render(meshes, camera=camera, size=SIZE, samples=16))
    path = ROOT / "docs" / "images" / "replay.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.concatenate(columns, axis=1)).save(path, optimize=True)


if __name__ == "__main__":
    main()
