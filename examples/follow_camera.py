"""Garments that follow a depth camera: here it sees shorts that are wider than the network predicts.

python examples/follow_camera.py
"""

from __future__ import annotations

import numpy as np

from refu_core import GarmentPipeline, SmplFrame
from refu_core.observation import Observer
from refu_core.outputs import PinholeCamera, depth_image


def main() -> None:
    """Prints how far the garment is from the true shorts, without the camera's points and with them."""
    pipeline = GarmentPipeline.load(["short-pant-male"])
    (name,) = pipeline.garments
    observer = Observer(pipeline)  # one for each person: it remembers
    pose = np.zeros((24, 3))
    rng = np.random.default_rng(0)

    for k in range(4):
        pose[1, 0], pose[2, 0] = -0.1 * k, 0.1 * k  # walks
        frame = SmplFrame(pose=pose, transl=[0.0, 1.0, 0.0], stamp_ns=k * 33_000_000)
        plain = pipeline(frame)

        # Stands in for a camera's driver: a depth picture of the same shorts, 15 mm wider in front.
        true = plain[name].vertices
        true = true + 0.015 * (true[:, 2:] > true[:, 2].mean()) * np.array([0.0, 0.0, 1.0])
        camera = PinholeCamera.looking_at(true.mean(0), [0.4, 1.3, 2.0], width=320, height=240)
        skin = (plain.skin + plain.transl, pipeline.body.faces)
        depth = depth_image([(true, plain[name].faces), skin], camera)
        row, column = np.nonzero(np.isfinite(depth))
        z = depth[row, column] + rng.normal(0, 0.003, len(row))
        x = (column + 0.5 - camera.centre[0]) / camera.focal[0] * z
        y = (row + 0.5 - camera.centre[1]) / camera.focal[1] * z
        points = (np.stack((x, y, z), 1) - camera.translation) @ camera.rotation  # of the whole person

        out = observer(frame, points, eye=camera.eye)
        front = true[:, 2] > true[:, 2].mean() + 0.05
        before, after = (1e3 * np.abs((one[name].vertices - true)[front, 2]).mean() for one in (plain, out))
        inside = out.stats.garments[name].n_unresolved
        print(f"frame {k}: {observer.matched[name]} places, {before:.1f} mm → {after:.1f} mm, {inside} inside the body")


if __name__ == "__main__":
    main()
