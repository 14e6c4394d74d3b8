"""A dressed person as a GLB file, for Blender, a browser or a game engine.

python examples/export_glb.py [FILE.glb]
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import trimesh

from refu_core import GarmentPipeline, SmplFrame

COLOURS = {"body": (0.85, 0.68, 0.58), "tshirt-male": (0.25, 0.62, 0.57), "short-pant-male": (0.30, 0.34, 0.47)}


def coloured(vertices: np.ndarray, faces: np.ndarray, colour: tuple[float, float, float]) -> trimesh.Trimesh:
    """A mesh of one sRGB colour; vertices (V, 3) [m]."""
    material = trimesh.visual.material.PBRMaterial(
        baseColorFactor=(*colour, 1.0), roughnessFactor=0.9, doubleSided=True
    )
    visual = trimesh.visual.TextureVisuals(material=material)
    return trimesh.Trimesh(vertices, faces, visual=visual, process=False)


def main(path: str = "person.glb") -> Path:
    """Writes the file; returns its path."""
    pipeline = GarmentPipeline.load(["tshirt-male", "short-pant-male"])
    pose = np.zeros((24, 3))
    pose[16, 2], pose[17, 2] = -1.0, 1.0  # arms lowered [rad]
    output = pipeline(SmplFrame(pose=pose))
    scene = trimesh.Scene()  # SMPL's axes are glTF's: y up, z forward, metres
    scene.add_geometry(coloured(output.body, pipeline.body.faces.numpy(), COLOURS["body"]), geom_name="body")
    for name, mesh in output.items():
        scene.add_geometry(coloured(mesh.vertices, mesh.faces, COLOURS[name]), geom_name=name)
    scene.export(path)
    print(f"wrote {path}: {', '.join(scene.geometry)}; {Path(path).stat().st_size / 1e6:.1f} MB")
    return Path(path)


if __name__ == "__main__":
    main(*sys.argv[1:2])
