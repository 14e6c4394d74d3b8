#!/usr/bin/env python3
"""Draws test samples of a garment's set: worn by skinning, as the networks predict it, and as it was simulated.

    python scripts/make_carried_picture.py tshirt-female data/tshirt-female --output docs/images/carried.jpg

Each as the pipeline brings it off the body; the simulated one as it is in the set.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from PIL import Image

from refu_core import GarmentPipeline, SmplFrame, load_body, load_garment
from refu_core.simulation import GarmentDataset
from refu_lab.render import Backdrop, Camera, RenderMesh, render

SIZE = (200, 260)
CLOTH = (0.36, 0.52, 0.66)


def main() -> None:
    """Writes the picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("garment")
    parser.add_argument("data", type=Path)
    parser.add_argument("--weights", type=Path, help="folder of weights (those that ship)")
    parser.add_argument(
        "--count", type=int, default=4, help="samples (4), of one style-shape pair or clip each if there are"
    )
    parser.add_argument("--output", type=Path, required=True)
    arguments = parser.parse_args()
    name, template = arguments.garment, load_garment(arguments.garment)
    faces = load_body(template.body).faces.numpy()
    pipelines = [
        GarmentPipeline.load([name], backbone="skinned"),
        GarmentPipeline.load([name], backbone="tailornet", weights=arguments.weights),
    ]
    dataset = GarmentDataset(arguments.data)
    rows = np.flatnonzero(dataset.test)
    rows = rows[np.linspace(0, len(rows) - 1, arguments.count).astype(int)]
    columns = []
    for row in rows:
        sample = dataset.sample(int(row))
        frame = SmplFrame(pose=sample.pose, betas=sample.betas)
        worn = [pipeline(frame) for pipeline in pipelines]
        shown = [out[name].local for out in worn] + [sample.vertices]
        views = []
        for yaw in (20.0, 200.0):
            camera = Camera.framing(sample.vertices, size=SIZE, yaw=yaw, margin=1.3)
            meshes = [
                [RenderMesh(worn[1].body, faces), RenderMesh(one, template.faces.numpy(), colour=CLOTH)]
                for one in shown
            ]
            views.append(
                [render(m, camera=camera, size=SIZE, samples=4, backdrop=Backdrop(show_ground=False)) for m in meshes]
            )
        columns.append(np.concatenate([np.concatenate(view, axis=1) for view in views], axis=0))
        errors = [1e3 * np.linalg.norm(one - sample.vertices, axis=1).mean() for one in shown[:2]]
        print(f"slot {sample.slot}, {sample.clip or 'drawn'}: skinned {errors[0]:.1f} mm, predicted {errors[1]:.1f} mm")
    Image.fromarray(np.concatenate(columns, axis=0)).save(arguments.output, quality=88, optimize=True)


if __name__ == "__main__":
    main()
