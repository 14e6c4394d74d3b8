"""Draws docs/images/replay.webp: the motion of the shipped bags, dressed, as a loop.

python scripts/make_readme_picture.py                   # all frames: some minutes on one core
python scripts/make_readme_picture.py --frame 25 --output frame.png
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image
from tqdm import tqdm

import msg_adapters as adapters
from refu_core import GarmentPipeline
from refu_lab.render import Backdrop, Camera, RenderMesh, render

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from refu_core import SmplFrame

ROOT = Path(__file__).parents[1]
SIZE = (800, 450)
LENGTH, STEP = 100, 2
"""Frames of a bag in the loop, three strides of the walk, and those of them that are drawn: every second one, 15 Hz."""
BLEND = 16
"""The last frames of a loop, which become those before its first."""
BACKDROP = Backdrop(
    background=(0.935, 0.942, 0.955),
    ground=(0.885, 0.893, 0.91),
    sun=1.3,
    sky=0.78,
    to_sun=(-0.72, 1.0, 0.75),
    ground_height=0.0,
)


@dataclass(frozen=True)
class Person:
    """Who does what, where, in what."""

    bag: str
    first: int
    """Frame of the bag that the loop begins with."""
    garments: tuple[str, ...]
    place: tuple[float, float]
    """Of the pelvis, to the left and forward [m]."""
    yaw: float
    """About the vertical [degrees]."""


PEOPLE = (
    Person("walk", 100, ("tshirt-male", "short-pant-male"), (-1.0, 0.1), 20.0),
    Person("reach_squat", 190, ("shirt-male", "short-pant-male"), (0.02, -0.25), -4.0),
    Person("walk", 116, ("tshirt-female", "skirt-female"), (1.0, 0.1), -18.0),
)


def looped(bag: str, first: int) -> list[SmplFrame]:
    """Frames that go on where they began, on one spot."""
    frames = [record.frame for record in adapters.iter_smpl_frames(ROOT / "bags" / bag) if record.frame is not None]
    found = []
    for k in range(LENGTH):
        late, early = frames[first + k], frames[max(first + k - LENGTH, 0)]
        share = max(k - (LENGTH - BLEND) + 1, 0) / (BLEND + 1)
        share = share * share * (3 - 2 * share)
        ends = [adapters.quaternion_from_rotvec(one.pose) for one in (late, early)]
        pose = adapters.rotvec_from_quaternion(adapters.slerp(ends[0], ends[1], np.full(24, share)))
        transl = (1 - share) * late.transl + share * early.transl if bag != "walk" else np.zeros(3)
        found.append(replace(late, pose=pose.astype(np.float32), transl=transl))
    return found


def meshes_of(person: Person, pipeline: GarmentPipeline, frame: SmplFrame) -> list[RenderMesh]:
    """A dressed person in place."""
    output = pipeline(frame)
    angle = np.radians(person.yaw)
    floor = output.body[:, 1].min()  # one sole is on the floor in every frame of both bags; another body has other legs
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])

    def placed(vertices: NDArray[np.float32]) -> NDArray[np.float64]:
        shift = [output.transl[0], -floor, output.transl[2]]
        at: NDArray[np.float64] = (vertices + shift) @ turn.T + [person.place[0], 0.0, person.place[1]]
        return at

    body = RenderMesh(placed(output.body), pipeline.body.faces.numpy())
    return [body] + [
        RenderMesh(placed(mesh.local), mesh.faces, pipeline.garments[name].card.color) for name, mesh in output.items()
    ]


def main() -> None:
    """Writes the picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, default=ROOT / "docs" / "images" / "replay.webp")
    parser.add_argument("--frame", type=int, help="draw this one alone")
    arguments = parser.parse_args()
    pipelines = [GarmentPipeline.load(person.garments) for person in PEOPLE]
    motions = [looped(person.bag, person.first) for person in PEOPLE]
    camera = Camera.looking_at((0.02, 0.9, 0.0), distance=6.2, yaw=4.0, pitch=6.0, vertical_fov=19.0)
    chosen = range(0, LENGTH, STEP) if arguments.frame is None else [arguments.frame]
    pictures = []
    for index in tqdm(chosen, unit="picture"):
        meshes = [
            mesh
            for person, pipeline, motion in zip(PEOPLE, pipelines, motions, strict=True)
            for mesh in meshes_of(person, pipeline, motion[index])
        ]
        pictures.append(Image.fromarray(render(meshes, camera=camera, size=SIZE, samples=9, backdrop=BACKDROP)))
    first, *rest = pictures
    moving = {"save_all": True, "append_images": rest, "duration": round(1000 * STEP / 30), "loop": 0} if rest else {}
    options = {"quality": 82, "method": 6} if arguments.output.suffix == ".webp" else {}
    first.save(arguments.output, **moving, **options)
    print(f"{arguments.output}: {len(pictures)} frames, {arguments.output.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
