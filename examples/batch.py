"""Several persons in one call: networks run once for all of them.

python examples/batch.py
"""

from __future__ import annotations

import numpy as np

from refu_core import GarmentPipeline, SmplFrame


def main(n_persons: int = 4) -> list[dict[str, int]]:
    """Returns how many vertices of each garment are inside the body at the end, by person."""
    pipeline = GarmentPipeline.load(["tshirt-male", "short-pant-male"])
    rng = np.random.default_rng(0)
    frames = []
    for person in range(n_persons):
        pose = 0.15 * rng.standard_normal((24, 3))  # rotation vectors, SMPL joint order [rad]
        pose[0] = 0  # the root: upright, facing z
        pose[16, 2], pose[17, 2] = -0.8, 0.8  # arms lowered
        frames.append(SmplFrame(pose=pose, betas=rng.standard_normal(10), transl=[1.5 * person, 1.16, 0.0]))
    left = []
    for person, output in enumerate(pipeline(frames)):
        for name, mesh in output.items():
            stats = output.stats.garments[name]
            centre = mesh.vertices.mean(axis=0).round(2)
            print(
                f"person {person}, {name} around {centre}: {stats.n_inside} inside before, {stats.n_unresolved} after"
            )
        left.append({name: stats.n_unresolved for name, stats in output.stats.garments.items()})
    return left


if __name__ == "__main__":
    main()
