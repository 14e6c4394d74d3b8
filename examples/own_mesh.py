"""Contact on a mesh of your own: a tube of cloth, without skinning weights or networks, is moved off a body.

python examples/own_mesh.py [GARMENT.obj]  # in metres, where the body is: T-pose, y up, the chest at the origin
"""

from __future__ import annotations

import sys

import numpy as np
import torch
import trimesh

from refu_core import RefuError, load_body
from refu_core.contact import Resolver
from refu_core.fitting import read_surface
from refu_core.metrics import CollisionChecker
from refu_core.sdf import ExactSdf


def tube(radius: float, low: float, high: float) -> trimesh.Trimesh:
    """An open tube around the vertical axis, 1 cm fine, its faces counter-clockwise from outside; lengths in metres."""
    around, along = int(2 * np.pi * radius / 0.01), int((high - low) / 0.01)
    angle, height = np.meshgrid(2 * np.pi * np.arange(around) / around, np.linspace(low, high, along + 1))
    vertices = np.stack((radius * np.sin(angle), height, radius * np.cos(angle)), axis=-1).reshape(-1, 3)
    a = np.arange(along * around).reshape(along, around)
    b, c, d = np.roll(a, -1, axis=1), np.roll(a, -1, axis=1) + around, a + around
    faces = np.concatenate([np.stack(corners, axis=-1).reshape(-1, 3) for corners in ((a, b, c), (a, c, d))])
    return trimesh.Trimesh(vertices, faces, process=False)


def main(path: str | None = None) -> tuple[int, int]:
    """Returns how many pairs of triangles of garment and body intersect, before and after."""
    body = load_body("male")
    skin = body(torch.zeros(1, 24, 3)).vertices[0]  # T-pose, SMPL axes
    garment = tube(0.14, -0.35, -0.05) if path is None else read_surface(path)
    vertices = torch.tensor(garment.vertices, dtype=torch.float32)
    faces = torch.tensor(garment.faces)

    sdf = ExactSdf(body.faces)
    sdf.update(skin)
    resolver = Resolver(faces, len(vertices))  # once per garment
    sample = sdf.query(vertices)
    done = resolver(vertices, sdf, sample, margin=0.004)  # every frame

    checker = CollisionChecker(body.faces)
    checker.update(skin)
    before, after = (checker.check(mesh, faces).n_pairs for mesh in (vertices, done.vertices))
    low, high = (1e3 * sample.distance).aminmax()
    print(f"{done.n_inside} of {len(vertices)} vertices were inside; all were {low:.0f} to {high:.0f} mm off the skin")
    print(f"intersecting pairs of triangles: {before} before, {after} after")
    return before, after


if __name__ == "__main__":
    try:
        main(*sys.argv[1:2])
    except RefuError as error:
        sys.exit(f"own_mesh.py: {error}")
