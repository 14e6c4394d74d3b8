"""3D frames to turn with the mouse, embedded in a page: no library, no network, no other file.

Faces are stored once for all frames. Positions are rounded to a fine grid, 0.15 mm wide for a person. Numbers are
stored as differences from the previous one, positions after collision handling as differences from those before it.
Low bytes are kept apart from high ones, which deflate compresses better: a body in two garments, three frames before
and after, is 0.65 MB of text.
"""

from __future__ import annotations

import base64
import html
import json
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from refu_core import RefuError
from refu_lab.render import COLLIDING, RenderMesh, sky_light

STYLE = Path(__file__).with_suffix(".css").read_text(encoding="utf-8")
_GRID = (1 << 14) - 1
"""Grid steps along the longest side of a frame's bounding box."""
_MOST = (1 << 16) - 1
"""Most vertices of a mesh: an index has 16 bits, and the last number ends a strip of triangles in WebGL."""
_SCRIPT = Path(__file__).with_suffix(".js")


@dataclass(frozen=True, eq=False)
class Frame:
    name: str
    title: str
    before: Sequence[RenderMesh]
    """Each mesh before collision handling, y up; the first is the body. What is `COLLIDING` is drawn red."""
    after: Sequence[RenderMesh]
    before_caption: str
    after_caption: str
    yaw: float
    """The camera's first yaw, from z towards x [degrees]."""


def turntable(colours: Mapping[str, tuple[float, float, float]], frames: Sequence[Frame]) -> str:
    """HTML of the element, its data and its script; the page itself has to include `STYLE`.

    `colours` are the meshes' names and sRGB colours, in their order. Raises `RefuError` for a mesh with more vertices
    than a page can show.
    """
    counts = [np.shape(mesh.vertices)[:1] + np.shape(mesh.faces)[:1] for mesh in frames[0].after]
    for name, (n_vertices, _) in zip(colours, counts, strict=True):
        if n_vertices > _MOST:
            raise RefuError(f"{name}: {n_vertices} vertices, a page shows at most {_MOST}")
    blocks = [_signed(np.diff(np.asarray(mesh.faces).reshape(-1), prepend=0)) for mesh in frames[0].after]
    told: list[dict[str, Any]] = []
    for frame in frames:
        every = np.concatenate([np.asarray(mesh.vertices) for mesh in (*frame.before, *frame.after)])
        low, extent = every.min(0), float(np.ptp(every, axis=0).max())
        step = max(extent, 1e-6) / _GRID
        centre = (low + every.max(0)) / 2
        sides = [_quantised(meshes, low, step) for meshes in (frame.before, frame.after)]
        for before, after in zip(*sides, strict=True):
            blocks += [_signed(np.diff(before.places, axis=1, prepend=0)), _signed(after.places - before.places)]
            blocks += [before.light.tobytes(), (after.light - before.light).tobytes()]  # modulo 256, as in the script
            blocks += [np.packbits(side.red, bitorder="little").tobytes() for side in (before, after)]
        told.append(
            {
                "name": frame.name,
                "title": frame.title,
                "before": frame.before_caption,
                "after": frame.after_caption,
                "low": low.tolist(),
                "step": step,
                "centre": centre.tolist(),
                "radius": float(np.linalg.norm(every - centre, axis=1).max()),
                "yaw": float(np.radians(frame.yaw)),
            }
        )
    data = zlib.compress(b"".join(blocks), 9)
    scene = {"frames": told, "colours": [*colours.values()], "counts": counts}
    text = json.dumps(scene).replace("<", "\\u003c")  # so that no name can close the script element
    return f"""<div id="turntable"><canvas tabindex="0" role="img"
aria-label="{html.escape(frames[0].title)}, to be turned with the mouse"></canvas><div></div><p class="note"></p></div>
<script type="application/json" id="turntable-scene">{text}</script>
<script type="application/octet-stream" id="turntable-data">{base64.b64encode(data).decode()}</script>
<script>{_SCRIPT.read_text(encoding="utf-8")}</script>"""


class _Quantised(NamedTuple):
    places: NDArray[np.int64]
    """On the grid, shape (3, V)."""
    light: NDArray[np.uint8]
    """Share of the sky that is seen, 0 to 255, shape (V,)."""
    red: NDArray[np.bool_]
    """Shape (V,)."""


def _quantised(meshes: Sequence[RenderMesh], low: NDArray[np.float32], step: float) -> list[_Quantised]:
    found = []
    for mesh, sky in zip(meshes, sky_light(meshes), strict=True):
        places = np.rint((np.asarray(mesh.vertices).T - low[:, None]) / step).astype(np.int64)
        red = np.broadcast_to((np.asarray(mesh.colour) == COLLIDING).all(-1), sky.shape)
        found.append(_Quantised(places, np.rint(255 * np.clip(sky, 0, 1)).astype(np.uint8), red))
    return found


def _signed(numbers: NDArray[np.int64]) -> bytes:
    """Numbers modulo 65,536, signs in the lowest bit so that small ones stay small: low bytes, then high bytes."""
    near = numbers.astype(np.int16).reshape(-1)
    folded = ((near << 1) ^ (near >> 15)).view(np.uint16)
    return (folded & 0xFF).astype(np.uint8).tobytes() + (folded >> 8).astype(np.uint8).tobytes()
