"""sensor_msgs/PointCloud2 of a person's garments: laid out once, each frame writes its numbers into place."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from msg_adapters.axes import WORLD_FRAME
from msg_adapters.cdr import HEADER_BYTES, CdrWriter, split_stamp
from msg_adapters.errors import DecodeError, EncodeError
from msg_adapters.markers import numbers
from refu_core._numbers import NOT_NUMBERS, as_numbers

POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
POINT_FIELDS = ("normal", "clearance", "sigma", "vertex", "garment", "visible")
"""What a point may have besides its position."""

_KINDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""NumPy's name of each of PointField's data types."""
_CODES = {kind: code for code, kind in _KINDS.items()}
_NO_OFFSET = np.zeros(3, np.float32)


class PointCloudEncoder:
    """Encodes frames of a fixed set of garments as one `sensor_msgs/PointCloud2` in CDR, little-endian, dense.

    Each point has `x`, `y`, `z` [m] and, as far as `fields` asks for them: `normal_x`, `normal_y`, `normal_z` (as PCL
    names them), `clearance` and `sigma` [m] (all float32), `vertex` (uint16, or uint32 where a garment has more
    vertices), `garment` (uint8: which of the garments, counted from 0) and `visible` (uint8: 1 where it is seen).

    `counts` are the garments' numbers of vertices. One encoder serves one thread at a time.
    """

    def __init__(
        self, counts: Sequence[int], *, frame_id: str = WORLD_FRAME, fields: Sequence[str] = POINT_FIELDS
    ) -> None:
        dtype = _layout(fields, most_vertices=max(counts))
        writer = CdrWriter()
        total, n_bytes = sum(counts), sum(counts) * dtype.itemsize
        self._stamp_at = writer.fields("TsIII", 0, frame_id, 1, total, len(dtype.names or ()))
        for name in dtype.names or ():
            kind, offset = dtype.fields[name][:2]  # type: ignore[index]
            writer.fields("sIBI", name, offset, _CODES[kind.str[1:]], 1)
        writer.fields("?III", False, dtype.itemsize, n_bytes, n_bytes)
        start = len(writer)
        self._message = np.zeros(HEADER_BYTES + start + n_bytes + 1, np.uint8)
        head = np.frombuffer(writer.to_bytes(), np.uint8)
        self._message[: len(head)] = head
        self._message[-1] = 1  # is_dense
        points = self._message[HEADER_BYTES + start : -1].view(dtype)
        self._place = _columns(points, "x")
        self._columns = {name: points[name] for name in ("clearance", "sigma", "visible") if name in fields}
        if "normal" in fields:
            self._columns["normal"] = _columns(points, "normal_x")
        self._slices = [slice(end - count, end) for end, count in zip(np.cumsum(counts), counts, strict=True)]
        for i, part in enumerate(self._slices):
            if "vertex" in fields:
                points["vertex"][part] = np.arange(counts[i])
            if "garment" in fields:
                points["garment"][part] = i

    def encode(
        self,
        vertices: Sequence[ArrayLike],
        *,
        stamp_ns: int,
        offset: ArrayLike = (0.0, 0.0, 0.0),
        values: Mapping[str, Sequence[ArrayLike]],
    ) -> bytes:
        """Encode one frame; each sequence has one array per garment.

        Args:
            vertices: [m] in the axes of the frame, shape (V, 3) each.
            stamp_ns: time of the measurement [ns].
            offset: added to the vertices [m], shape (3,).
            values: those that `fields` has of `normal`, shape (V, 3) each, `clearance` and `sigma` [m] and `visible`,
                shape (V,) each.

        Raises `EncodeError` where a shape is wrong, something isn't finite, or the stamp doesn't fit a ROS time.
        """
        struct.pack_into("<iI", self._message.data, HEADER_BYTES + self._stamp_at, *split_stamp(stamp_ns))
        with np.errstate(over="ignore"):
            moved = numbers("offset", offset).astype(np.float32)
        self._write("vertices", self._place, vertices, moved)
        for name, column in self._columns.items():
            self._write(name, column, values[name])
        return self._message.tobytes()

    def _write(
        self, what: str, target: NDArray[Any], arrays: Sequence[ArrayLike], offset: NDArray[np.float32] = _NO_OFFSET
    ) -> None:
        for part, array in zip(self._slices, arrays, strict=True):
            try:
                values = as_numbers(array, also="b")
            except NOT_NUMBERS as error:
                raise EncodeError(f"{what}: wanted numbers, got {type(array).__name__}: {error}") from error
            if values.shape != target[part].shape:
                raise EncodeError(f"{what}: wanted numbers of shape {target[part].shape}, got {values.shape}")
            with np.errstate(invalid="ignore", over="ignore"):
                if values.ndim == 1:
                    target[part] = values
                for k in range(values.shape[1] if values.ndim == 2 else 0):  # by columns: a fifth of the time of rows
                    np.add(values[:, k], offset[k], out=target[part, k], casting="same_kind")
                # A sum is finite only if every term is: nothing is allocated. In float32 a double may be infinite.
                is_finite = values.dtype != np.float64 and np.isfinite(values.sum() + offset.sum())
            if not (is_finite or np.isfinite(target[part]).all()):
                bad = int(np.count_nonzero(~np.isfinite(target[part])))
                raise EncodeError(f"{what}: {bad} of {values.size} are NaN or infinite")


def _layout(fields: Sequence[str], *, most_vertices: int) -> np.dtype[Any]:
    """A point's dtype: numbers of four bytes come first, so that all lie at multiples of their size."""
    optional = {f"normal_{axis}": "<f4" for axis in "xyz"} if "normal" in fields else {}
    kinds = {"clearance": "<f4", "sigma": "<f4", "vertex": "<u2" if most_vertices <= 1 << 16 else "<u4"}
    kinds |= {"garment": "u1", "visible": "u1"}
    columns = {**dict.fromkeys("xyz", "<f4"), **optional, **{name: kinds[name] for name in kinds if name in fields}}
    return np.dtype([*columns.items()], align=True)


def _columns(points: NDArray[Any], first: str) -> NDArray[np.float32]:
    """Three float32 columns that lie side by side, as one view of shape (N, 3)."""
    at = points.dtype.fields[first][1]  # type: ignore[index]
    columns: NDArray[np.float32] = np.ndarray((len(points), 3), "<f4", points.data, at, (points.dtype.itemsize, 4))
    return columns


def points_of(message: Any) -> NDArray[Any]:
    """The points of a `sensor_msgs/PointCloud2` object of rclpy, as a structured array over its memory.

    Those of an organised cloud come row by row; if its rows are padded, they are copied. Raises `DecodeError` if fields
    or rows aren't in the data.
    """
    fields = message.fields
    (height, width), (step, row_step) = (message.height, message.width), (message.point_step, message.row_step)
    try:
        if height > 1 and row_step < width * step:
            raise ValueError(f"a row has {row_step}")
        kinds = [(_KINDS[one.datatype], (one.count,)) if one.count > 1 else _KINDS[one.datatype] for one in fields]
        places = {"names": [one.name for one in fields], "offsets": [one.offset for one in fields]}
        layout: Any = {**places, "formats": kinds, "itemsize": step}
        order = np.dtype(layout).newbyteorder(">" if message.is_bigendian else "<")
        rows: NDArray[Any] = np.ndarray((height, width), order, message.data, strides=(row_step, step))
        return rows.reshape(-1)
    except (KeyError, ValueError, TypeError, OverflowError, MemoryError) as error:
        names, n_bytes = ", ".join(one.name for one in fields), len(message.data)
        msg = f"{width} x {height} points of {step} bytes with the fields {names} aren't in {n_bytes} bytes: {error}"
        raise DecodeError(msg) from None
