"""sensor_msgs/PointCloud2 of a person's garments: laid out once, each frame writes its numbers into place."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from msg_adapters.cdr import HEADER_BYTES, Buffer, CdrReader, CdrWriter, split_stamp
from msg_adapters.errors import DecodeError, EncodeError

POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
PointField = Literal["normal", "clearance", "sigma", "vertex", "garment", "visible"]
POINT_FIELDS: tuple[PointField, ...] = ("normal", "clearance", "sigma", "vertex", "garment", "visible")
"""What a point may have besides its place."""

_KINDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""NumPy's name of each of PointField's data types."""
_CODES = {kind: code for code, kind in _KINDS.items()}
_MIN_FIELD_BYTES = 16
_NO_OFFSET = np.zeros(3, np.float32)


class PointCloudEncoder:
    """Encodes frames of a fixed set of garments as one `sensor_msgs/PointCloud2` in CDR, little-endian, dense.

    Each point has `x`, `y`, `z` [m] and, as far as `fields` asks for them: `normal_x`, `normal_y`, `normal_z` (as PCL
    names them), `clearance` and `sigma` [m] (all float32), `vertex` (uint16, or uint32 where a garment has more
    vertices), `garment` (uint8: which of the garments, counted from 0) and `visible` (uint8: 1 where it is seen).

    One encoder serves one thread at a time. Raises `EncodeError` for no garment, more than 255, one without vertices,
    and fields that there are not.
    """

    def __init__(
        self, counts: Sequence[int], *, frame_id: str = "map", fields: Sequence[PointField] = POINT_FIELDS
    ) -> None:
        if not 0 < len(counts) < 256 or min(counts) < 1:
            msg = f"wanted 1 to 255 garments, each with vertices, got {list(counts)}"
            raise EncodeError(msg)
        if unknown := set(fields) - set(POINT_FIELDS):
            msg = f"wanted fields of {', '.join(POINT_FIELDS)}, got {', '.join(sorted(unknown))}"
            raise EncodeError(msg)
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
        self._normal = _columns(points, "normal_x") if "normal" in fields else None
        self._numbers = {name: points[name] for name in ("clearance", "sigma", "visible") if name in fields}
        self._slices = [slice(end - count, end) for end, count in zip(np.cumsum(counts), counts, strict=True)]
        for i, part in enumerate(self._slices):
            if "vertex" in fields:
                points["vertex"][part] = np.arange(counts[i])
            if "garment" in fields:
                points["garment"][part] = i
        self._counts = list(counts)

    @property
    def n_bytes(self) -> int:
        """Size of a message."""
        return self._message.size

    def encode(
        self,
        vertices: Sequence[ArrayLike],
        *,
        stamp_ns: int,
        offset: ArrayLike = (0.0, 0.0, 0.0),
        normals: Sequence[ArrayLike] | None = None,
        values: Mapping[str, Sequence[ArrayLike]] | None = None,
    ) -> bytes:
        """One frame; a garment's array each.

        Args:
            vertices: [m] in the axes of the frame, shape (V, 3) each.
            stamp_ns: time of the measurement [ns].
            offset: added to the vertices [m], shape (3,).
            normals: unit normals, shape (V, 3) each; wanted where `fields` has them.
            values: `clearance` and `sigma` [m] and `visible`, as far as `fields` has them, shape (V,) each.

        Raises:
            EncodeError: a shape is wrong, something is missing or not finite, or the stamp doesn't fit a ROS time.
        """
        given: dict[str, Sequence[ArrayLike]] = dict(values or {})
        wanted = set(self._numbers) | ({"normal"} if self._normal is not None else set())
        if (got := set(given) | ({"normal"} if normals is not None else set())) != wanted:
            msg = f"wanted {', '.join(sorted(wanted)) or 'vertices alone'}, got {', '.join(sorted(got)) or 'none'}"
            raise EncodeError(msg)
        struct.pack_into("<iI", self._message.data, HEADER_BYTES + self._stamp_at, *split_stamp(stamp_ns))
        with np.errstate(over="ignore"):
            moved = np.asarray(offset).astype(np.float32)
        self._write("vertices", self._place, vertices, moved)
        if self._normal is not None:
            self._write("normals", self._normal, normals or ())
        for name, column in self._numbers.items():
            self._write(name, column, given[name])
        return self._message.tobytes()

    def _write(
        self, what: str, target: NDArray[Any], arrays: Sequence[ArrayLike], offset: NDArray[np.float32] = _NO_OFFSET
    ) -> None:
        if len(arrays) != len(self._slices):
            msg = f"{what}: wanted those of {len(self._slices)} garments, got {len(arrays)}"
            raise EncodeError(msg)
        for part, count, array in zip(self._slices, self._counts, arrays, strict=True):
            values = np.asarray(array)
            if values.shape != (count, *target.shape[1:]) or values.dtype.kind not in "biuf":
                msg = f"{what}: wanted numbers of shape {(count, *target.shape[1:])}, got {values.dtype} {values.shape}"
                raise EncodeError(msg)
            with np.errstate(invalid="ignore", over="ignore"):
                if values.ndim == 1:
                    target[part] = values
                for k in range(values.shape[1] if values.ndim == 2 else 0):  # by columns: a fifth of what rows take
                    np.add(values[:, k], offset[k], out=target[part, k], casting="same_kind")
                # A sum is finite only if every term is: nothing is allocated.
                is_finite = np.isfinite(values.sum() + offset.sum())
            if not (is_finite or np.isfinite(target[part]).all()):
                bad = int(np.count_nonzero(~np.isfinite(target[part])))
                msg = f"{what}: {bad} of {values.size} are NaN or infinite"
                raise EncodeError(msg)


def _layout(fields: Sequence[str], *, most_vertices: int) -> np.dtype[Any]:
    """Numbers of four bytes first, so that all lie at multiples of their size."""
    columns = [(name, "<f4") for name in "xyz"]
    if "normal" in fields:
        columns += [(f"normal_{axis}", "<f4") for axis in "xyz"]
    columns += [(name, "<f4") for name in ("clearance", "sigma") if name in fields]
    if "vertex" in fields:
        columns.append(("vertex", "<u2" if most_vertices <= 1 << 16 else "<u4"))
    columns += [(name, "u1") for name in ("garment", "visible") if name in fields]
    names, kinds = [name for name, _ in columns], [kind for _, kind in columns]
    sizes = [np.dtype(kind).itemsize for kind in kinds]
    ends = np.cumsum(sizes)
    return _structure(names, kinds, (ends - sizes).tolist(), -(-int(ends[-1]) // 4) * 4)


def _structure(names: Sequence[str], kinds: Sequence[Any], offsets: Sequence[int], itemsize: int) -> np.dtype[Any]:
    spec: Any = {"names": list(names), "formats": list(kinds), "offsets": list(offsets), "itemsize": itemsize}
    dtype: np.dtype[Any] = np.dtype(spec)
    return dtype


def _columns(points: NDArray[Any], first: str) -> NDArray[np.float32]:
    """Three float32 columns that lie side by side, as one view of shape (N, 3)."""
    at = points.dtype.fields[first][1]  # type: ignore[index]
    columns: NDArray[np.float32] = np.ndarray((len(points), 3), "<f4", points.data, at, (points.dtype.itemsize, 4))
    return columns


def decode_point_cloud(data: Buffer) -> tuple[NDArray[Any], int, str]:
    """The points of a `sensor_msgs/PointCloud2` in CDR, with its stamp [ns] and its frame.

    Points are a structured array with the message's fields by name, row by row: a read-only view of `data`, unless rows
    are padded. Raises `DecodeError`.
    """
    reader = CdrReader(data)
    stamp_ns, frame_id, height, width = reader.fields("TsII")
    fields: Any = [reader.fields("sIBI") for _ in range(reader.length(item_bytes=_MIN_FIELD_BYTES))]
    is_big, *steps = reader.fields("?II")
    raw = reader.skip(reader.length(item_bytes=1))
    reader.fields("?")
    reader.finish()
    return _points(raw, fields, (height, width), steps, is_big=is_big), stamp_ns, frame_id


def points_of(message: Any) -> NDArray[Any]:
    """The points of a `sensor_msgs/PointCloud2` object of rclpy, as a structured array over its memory.

    Of an organised cloud they come row by row; where its rows are padded, they are copied. Raises `DecodeError` for
    fields or rows that aren't in the data.
    """
    fields = [(one.name, one.offset, one.datatype, one.count) for one in message.fields]
    steps = message.point_step, message.row_step
    return _points(message.data, fields, (message.height, message.width), steps, is_big=bool(message.is_bigendian))


def _points(
    raw: Any, fields: Sequence[tuple[str, int, int, int]], shape: tuple[int, int], steps: Sequence[int], *, is_big: bool
) -> NDArray[Any]:
    (height, width), (step, row_step) = shape, steps
    try:
        if height > 1 and row_step < width * step:
            msg = f"a row has {row_step}"
            raise ValueError(msg)
        kinds = [(_KINDS[code], (count,)) if count > 1 else _KINDS[code] for _, _, code, count in fields]
        dtype = _structure([name for name, *_ in fields], kinds, [offset for _, offset, *_ in fields], step)
        order = dtype.newbyteorder(">" if is_big else "<")
        rows: NDArray[Any] = np.ndarray(shape, order, raw, strides=(row_step, step))
        return rows.reshape(-1)
    except (KeyError, ValueError, TypeError, OverflowError, MemoryError) as error:
        names = ", ".join(name for name, *_ in fields)
        msg = f"{width} x {height} points of {step} bytes with the fields {names} aren't in {len(raw)} bytes: {error}"
        raise DecodeError(msg) from None
