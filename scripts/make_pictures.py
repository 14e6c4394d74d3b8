#!/usr/bin/env python3
"""Draws the documentation's pictures into docs/images.

python scripts/make_pictures.py replay                       # some minutes on one core
python scripts/make_pictures.py collider | postures | legs | ros | wardrobe
python scripts/make_pictures.py dataset data/tshirt-male     # dataset-<garment>.png: random samples
python scripts/make_pictures.py carried data/dress-female    # test samples: skinned, predicted, simulated
"""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np
import torch
from PIL import Image
from tqdm import tqdm

import msg_adapters as adapters
from refu_core import GarmentPipeline, SmplFrame, load_body, load_garment
from refu_core.body import joints_of
from refu_core.modes import DEFAULT_GARMENTS
from refu_core.recordings import interpolated
from refu_core.simulation import POSTURES, SELF_TOUCHING, GarmentDataset, posture
from refu_lab.contact_sheet import contact_sheet
from refu_lab.garment import dressed, picture
from refu_lab.render import SKIN, Backdrop, RenderMesh, Viewpoint, render

if TYPE_CHECKING:
    from numpy.typing import NDArray

ROOT = Path(__file__).parents[1]
IMAGES = ROOT / "docs" / "images"


def save_jpeg(image: NDArray[np.uint8], name: str) -> None:
    Image.fromarray(image).save(IMAGES / f"{name}.jpg", quality=88, optimize=True)


# ---- the motion of the shipped bags, as a loop -----------------------------------------------------------------------

LENGTH, STEP = 100, 2
"""How many frames of a bag are in the loop, three strides of the walk; of these every second one is drawn, 15 Hz."""
BLEND = 16
"""How many of a loop's last frames blend into those before its first."""
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
    """What one person does, where, and in which garments."""

    bag: str
    first: int
    """Frame of the bag that the loop begins with."""
    garments: tuple[str, ...]
    place: tuple[float, float]
    """Position of the pelvis, to the left and forward [m]."""
    yaw: float
    """Turn about the vertical [degrees]."""


PEOPLE = (
    Person("walk", 100, ("tshirt-male", "short-pant-male"), (-1.0, 0.1), 20.0),
    Person("reach_squat", 190, ("shirt-male", "short-pant-male"), (0.02, -0.25), -4.0),
    Person("walk", 116, ("tshirt-female", "skirt-female"), (1.0, 0.1), -18.0),
)


def recorded(bag: str) -> list[SmplFrame]:
    return [record.frame for record in adapters.iter_smpl_frames(ROOT / "bags" / bag) if record.frame is not None]


def looped(bag: str, first: int) -> list[SmplFrame]:
    """Frames of a loop, whose end leads into its beginning, on one spot."""
    frames = recorded(bag)
    found = []
    for k in range(LENGTH):
        late, early = frames[first + k], frames[max(first + k - LENGTH, 0)]
        share = max(k - (LENGTH - BLEND) + 1, 0) / (BLEND + 1)
        share = share * share * (3 - 2 * share)
        ends = (np.stack(pair) for pair in ((late.pose, early.pose), (late.transl, early.transl)))
        poses, transl = interpolated(*ends, np.arange(2), np.array([share]))
        found.append(replace(late, pose=poses[0], transl=transl[0] if bag != "walk" else np.zeros(3)))
    return found


def in_place(person: Person, pipeline: GarmentPipeline, frame: SmplFrame) -> list[RenderMesh]:
    """A dressed person where they belong in the picture."""
    output = pipeline(frame)
    angle = np.radians(person.yaw)
    floor = output.body[:, 1].min()  # one sole is on the floor in every frame of both bags; another body has other legs
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    shift, place = [output.transl[0], -floor, output.transl[2]], [person.place[0], 0.0, person.place[1]]
    meshes = dressed(pipeline, output)
    return [replace(mesh, vertices=(np.asarray(mesh.vertices) + shift) @ turn.T + place) for mesh in meshes]


def draw_replay() -> None:
    """Three people, as a loop."""
    pipelines = [GarmentPipeline.load(person.garments) for person in PEOPLE]
    motions = [looped(person.bag, person.first) for person in PEOPLE]
    camera = Viewpoint.looking_at((0.02, 0.9, 0.0), distance=6.2, yaw=4.0, pitch=6.0, vertical_fov=19.0)
    pictures = []
    for index in tqdm(range(0, LENGTH, STEP), unit="picture"):
        people = zip(PEOPLE, pipelines, motions, strict=True)
        meshes = [mesh for person, pipeline, motion in people for mesh in in_place(person, pipeline, motion[index])]
        pictures.append(Image.fromarray(render(meshes, camera=camera, size=(800, 450), backdrop=BACKDROP)))
    moving = {"save_all": True, "append_images": pictures[1:], "duration": round(1000 * STEP / 30), "loop": 0}
    pictures[0].save(IMAGES / "replay.webp", quality=82, method=6, **moving)


# ---- the others ------------------------------------------------------------------------------------------------------

_MOVED = (0.80, 0.24, 0.20)
"""sRGB colour of skin that was moved by `_MOST` or more."""
_MOST = 0.02  # [m]


def collider_sheet(
    garments: Sequence[str] = DEFAULT_GARMENTS,
    poses: Sequence[str] = SELF_TOUCHING,
    size: tuple[int, int] = (230, 270),
    samples: int = 9,
) -> NDArray[np.uint8]:
    """One column per pose: the skin, the collider with what was moved in red, and the garments on it.

    Returns sRGB, shape (3 height, columns width, 3), of pictures of `size` (width, height).
    """
    pipeline = GarmentPipeline.load(garments)
    faces = pipeline.body.faces.numpy()
    lower = joints_of("left_shin", "right_shin")
    is_framed = ~torch.isin(pipeline.body.weights.argmax(1), torch.tensor(lower)).numpy()
    columns = []
    for name in poses:
        out = pipeline(SmplFrame(pose=posture(name)))
        camera = Viewpoint.framing(out.skin[is_framed], size=size, yaw=25.0, pitch=20.0)
        share = np.clip(np.linalg.norm(out.body - out.skin, axis=1) / _MOST, 0, 1)[:, None]
        moved = (1 - share) * np.array(SKIN) + share * np.array(_MOVED)
        scenes = ([RenderMesh(out.skin, faces)], [RenderMesh(out.body, faces, moved)], dressed(pipeline, out))
        columns.append(np.concatenate([render(one, camera=camera, size=size, samples=samples) for one in scenes]))
    return np.concatenate(columns, axis=1)


def draw_collider() -> None:
    """Poses in which the body touches itself, before and after, and dressed."""
    save_jpeg(collider_sheet(), "collider")


def draw_postures() -> None:
    """Everyday postures, dressed; rows of thirteen, the last one filled up in white."""
    names, size, n = tuple(POSTURES), (150, 180), 13
    rows = [collider_sheet(poses=names[i : i + n], size=size, samples=4)[-180:] for i in range(0, len(names), n)]
    rows[-1] = np.pad(rows[-1], ((0, 0), (0, n * 150 - rows[-1].shape[1]), (0, 0)), constant_values=255)
    save_jpeg(np.concatenate(rows), "postures")


def draw_legs() -> None:
    """A skirt, without (above) and with the networks that it has for legs apart or drawn up, and for runners."""
    worn, size, columns = ("tshirt-female", "skirt-female"), (230, 230), []
    with TemporaryDirectory() as folder:
        for name in worn:
            shipped = ROOT / "refu_core" / "weights" / name
            shutil.copytree(shipped, Path(folder) / name, ignore=shutil.ignore_patterns("legs.*", "heels.*"))
        pipelines = [GarmentPipeline.load(worn, weights=folder), GarmentPipeline.load(worn)]
        ahead, behind = 25.0, 155.0
        seen = dict.fromkeys(("squat", "cross-legged", "straddle", "deep lunge", "side lunge", "high kick"), ahead)
        for what, yaw in (seen | dict.fromkeys(("running", "sprinting"), behind)).items():
            outputs = [pipeline(SmplFrame(pose=posture(what))) for pipeline in pipelines]
            camera = Viewpoint.framing(outputs[1][worn[1]].local, size=size, yaw=yaw, pitch=8.0, margin=1.5)
            scenes = [dressed(*pair) for pair in zip(pipelines, outputs, strict=True)]
            columns.append(np.concatenate([render(one, camera=camera, size=size, samples=9) for one in scenes]))
    save_jpeg(np.concatenate(columns, axis=1), "legs")


def draw_ros() -> None:
    """Three persons of `smpl_publisher`, as a viewer shows them."""
    pipeline, walk, size = GarmentPipeline.load(DEFAULT_GARMENTS), recorded("walk"), (900, 480)
    meshes = []
    for left, index in ((-1.0, 18), (0.0, 70), (1.0, 122)):
        frame = walk[index]
        place = np.array([left, frame.transl[1], 0.0])
        output = pipeline(SmplFrame(frame.pose, betas=frame.betas))
        meshes += [replace(mesh, vertices=mesh.vertices + place) for mesh in dressed(pipeline, output)]
    camera = Viewpoint.framing(np.concatenate([mesh.vertices for mesh in meshes]), size=size, yaw=28.0, pitch=10.0)
    Image.fromarray(render(meshes, camera=camera, size=size, samples=16)).save(IMAGES / "ros.png", optimize=True)


OUTFITS = (
    (("tshirt-male", "trousers-male"), ("longsleeve-female", "trousers-female")),
    (("dress-female",), ("tshirt-neutral", "trousers-neutral")),
    (("tshirt-female", "skirt-female"), ("shirt-neutral", "trousers-neutral")),
)
"""Garments worn together; rows of two outfits."""


def draw_wardrobe() -> None:
    """Garments that ship, worn."""
    rows = [np.concatenate([picture(one, size=(170, 280), samples=9) for one in row], axis=1) for row in OUTFITS]
    save_jpeg(np.concatenate(rows), "wardrobe")


def draw_dataset(folder: Path) -> None:
    """Random samples of a set, in 256 colours: less than half the bytes, without a visible difference."""
    dataset = GarmentDataset(folder)
    path = IMAGES / f"dataset-{'-over-'.join(reversed(dataset.parts))}.png"
    sheet = Image.fromarray(contact_sheet(dataset, seed=1))
    sheet.quantize(256, dither=Image.Dither.NONE).save(path, optimize=True)


def draw_carried(folder: Path) -> None:
    """Test samples of a garment's set: worn by skinning, as the networks predict it, and as it was simulated."""
    dataset, size = GarmentDataset(folder), (200, 260)
    (name,) = dataset.parts
    template = load_garment(name)
    faces = load_body(template.body).faces.numpy()
    pipelines = [GarmentPipeline.load([name], backbone=backbone) for backbone in ("skinned", "tailornet")]
    rows = np.flatnonzero(dataset.test)
    sheet = []
    for row in rows[np.linspace(0, len(rows) - 1, 4).astype(int)]:
        sample = dataset.sample(int(row))
        worn = [pipeline(SmplFrame(pose=sample.pose, betas=sample.betas)) for pipeline in pipelines]
        shown = [*(out[name].local for out in worn), sample.vertices]
        views = []
        for yaw in (20.0, 200.0):
            camera = Viewpoint.framing(sample.vertices, size=size, yaw=yaw, margin=1.3)
            for one in shown:
                cloth = RenderMesh(one, template.faces.numpy(), colour=(0.36, 0.52, 0.66))
                meshes, backdrop = [RenderMesh(worn[1].body, faces), cloth], Backdrop(show_ground=False)
                views.append(render(meshes, camera=camera, size=size, samples=4, backdrop=backdrop))
        sheet.append(np.concatenate(views, axis=1))
        errors = [1e3 * np.linalg.norm(one - sample.vertices, axis=1).mean() for one in shown[:2]]
        print(f"slot {sample.slot}, {sample.clip or 'drawn'}: skinned {errors[0]:.1f} mm, predicted {errors[1]:.1f} mm")
    save_jpeg(np.concatenate(sheet), "carried")


OF_SHIPPED = {
    "replay": draw_replay,
    "collider": draw_collider,
    "postures": draw_postures,
    "legs": draw_legs,
    "ros": draw_ros,
    "wardrobe": draw_wardrobe,
}
OF_SET = {"dataset": draw_dataset, "carried": draw_carried}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("picture", choices=(*OF_SHIPPED, *OF_SET))
    parser.add_argument("data", type=Path, nargs="?", help="the data set that it shows")
    arguments = parser.parse_args()
    if arguments.picture in OF_SHIPPED:
        OF_SHIPPED[arguments.picture]()
    elif arguments.data is None:
        parser.error(f"{arguments.picture}: wanted a data set of refu simulate")
    else:
        OF_SET[arguments.picture](arguments.data)


if __name__ == "__main__":
    main()
