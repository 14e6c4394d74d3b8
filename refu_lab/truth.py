"""Ground truth that a bag carries beside its body parameters: garments as markers on a topic of their own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import msg_adapters as adapters
from refu_core import SmplFrame

TOPIC = "/ground_truth"
"""A MarkerArray a frame, stamped as its body parameters are; a marker's `ns` is the garment's name.

Its points are the garment's vertices (type POINTS), or the corners of its triangles (TRIANGLE_LIST).
"""


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """True garments by name and stamp."""

    garments: Mapping[str, Mapping[int, NDArray[np.float64]]] = field(default_factory=dict)
    """Vertices in SMPL axes with the translation [m], shape (V, 3), by stamp [ns]."""

    @classmethod
    def of_bag(
        cls, path: Path, faces: Mapping[str, NDArray[np.int64]], *, axes: adapters.InputAxes = "smpl"
    ) -> GroundTruth:
        """What the bag at `path` holds of the garments whose faces (F, 3) are given.

        Raises:
            AdapterError: the bag can't be read, or a garment in it has another topology.
        """
        garments: dict[str, dict[int, NDArray[np.float64]]] = {name: {} for name in faces}
        with adapters.BagReader(path) as reader:
            if TOPIC not in {topic.name for topic in reader.topics}:
                return cls()
            for message in reader.messages([TOPIC]):
                for marker in adapters.decode_marker_array(message.data):
                    if marker.ns in faces:
                        vertices = _vertices(marker, faces[marker.ns])
                        if axes == "smpl":
                            vertices = adapters.vertices_smpl_from_ros(vertices)
                        garments[marker.ns][marker.stamp_ns] = np.ascontiguousarray(vertices)
        return cls(garments)

    def of(self, garment: str, frame: SmplFrame) -> NDArray[np.float64] | None:
        """The true garment without the translation [m], shape (V, 3); None where the bag has none at that stamp."""
        vertices = self.garments.get(garment, {}).get(frame.stamp_ns)
        return None if vertices is None else vertices - frame.transl


def _vertices(marker: adapters.Marker, faces: NDArray[np.int64]) -> NDArray[np.float64]:
    if marker.type != adapters.POINTS:
        return adapters.vertices_from_points(marker.points, faces)
    count = int(faces.max()) + 1
    if marker.points.shape != (count, 3):
        msg = f"{TOPIC}: wanted the {count} vertices of {marker.ns}, got points {marker.points.shape}"
        raise adapters.DecodeError(msg)
    return marker.points
