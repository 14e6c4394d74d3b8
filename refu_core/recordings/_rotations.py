"""Rotations as files have them: vectors, matrices, or six numbers; recognised by shape, checked by value."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from refu_core.keypoints import LAYOUTS, keypoint_layout
from refu_core.recordings._upright import Array

WHOLE = (24, 22, 52, 55)
"""Numbers of joints, root included: of SMPL, of its body without hands, of SMPL-H, of SMPL-X."""
BODY = (23, 21, 51, 54)
"""The same without the root."""
_FORMS: dict[int, tuple[tuple[int, ...], ...]] = {3: ((3,),), 9: ((9,), (3, 3)), 6: ((6,),), 4: ((4,),)}
"""How rotation vectors, matrices, 6D rotations and quaternions may be laid out, by their numbers."""
_N_LATENT = 32
"""Numbers of VPoser's latent pose [1]."""
_ADVICE = {
    75: "72 columns of a pose and 3 of a translation: save them apart, as poses and trans",
    82: "72 columns of a pose and 10 of a shape: save them apart, as poses and betas",
    85: "3 columns of a camera, 72 of a pose, 10 of a shape (VIBE): save the latter two apart, as poses and betas",
}
"""What arrays of so many columns may be; the order of the columns differs between programs, so it isn't guessed."""
LONGEST_TURN = 2 * np.pi + 0.1
"""An unwrapped rotation vector may be this long [rad]; the median of sound ones is never longer."""
_FEWEST_HINGES, _STRAY = 10, 1e-6
"""A robot turns at least this many joints [1], and none of them by more than this about a second axis [rad]."""
_ENOUGH, _FEW, _FEWEST = 1000, 100, 3
"""Frames that show how limbs bend, frames that show whether there are bones, and the fewest that do [1]."""
_MOVES, _RIGID = 0.01, 0.01
"""Places move by this much, in any unit, and their bones' lengths change by a smaller share [1]. In rotations of
people, some joint's share is 0.06 at least."""
_HUGE = 1e6
"""Frames with larger numbers show neither [1]; their squares may overflow."""
_MOST_SKEW = 0.05  # largest entry of R Rᵀ - I: 16-bit floats have 0.001, networks that don't project 0.01
_MOST_UNEVEN = 0.3  # mean deviation of raw network output from two orthonormal vectors; anything else has 0.5 at least


def rotvecs_of(
    array: NDArray[Any], name: str, counts: Collection[int], notes: list[str], *, has_root: bool
) -> tuple[Array, int]:
    """Rotation vectors [rad], shape (T, n, 3), and n, one of `counts`.

    Raises `ValueError`: another shape, quaternions, degrees, or matrices that aren't rotations.
    """
    size, n, frames = _form(array, name, counts)
    numbers = np.asarray(array, np.float64).reshape(frames, n, size)
    if size == 4:
        hint = "save rotation vectors: scipy's Rotation.from_quat(q) takes xyzw, then .as_rotvec()"
        raise ValueError(f"{name} {array.shape} looks like quaternions, whose order a file doesn't say; {hint}")
    if size == 3:
        _check_radians(numbers, name)
        if n > 1 and _are_on_bones(numbers):
            what = f"{name} {array.shape} holds places of joints, in another order than SMPL's"
            raise ValueError(
                f"{what}: save them as joints, in SMPL's order, or give them as keypoints (docs/guide/inputs.md)"
            )
        return numbers, n
    if size == 9:
        matrices = numbers.reshape(frames, n, 3, 3)
        notes.append(f"{name} holds rotation matrices")
    else:
        matrices = _of_six(numbers, name, notes, first=0 if has_root else 1)
    return _rotvecs(matrices, name), n


def are_hinges(array: NDArray[Any]) -> bool:
    """Whether rotation vectors (T, n, 3) or (T, 3n), the root first, are a robot's: no joint turns about two axes."""
    is_flat = array.ndim == 2 and array.shape[1] % 3 == 0
    if array.dtype.kind != "f" or not (is_flat or (array.ndim == 3 and array.shape[2] == 3)) or not array.size:
        return False
    n_axes = (np.abs(array.reshape(len(array), -1, 3)[:, 1:]) > _STRAY).any(axis=0).sum(axis=1)
    return bool(n_axes.max(initial=0) == 1 and n_axes.sum() >= _FEWEST_HINGES)


def is_one_frame(shape: tuple[int, ...], counts: Collection[int]) -> bool:
    """Whether an array of this shape is one frame of one of these numbers of joints, in any form."""
    while len(shape) > 1 and shape[0] == 1:
        shape = shape[1:]
    forms = {form for n in counts for size in (3, 6, 9) for form in _laid_out(n, size)}
    return shape in forms or (1, *shape) in forms


def _laid_out(n: int, size: int) -> list[tuple[int, ...]]:
    """The shapes of one frame of n rotations of so many numbers each."""
    return [(n * size,), *((n, *form) for form in _FORMS[size])]


def _form(array: NDArray[Any], name: str, counts: Collection[int]) -> tuple[int, int, int]:
    """Numbers per joint, number of joints, number of frames."""
    if array.dtype.kind != "f":
        raise ValueError(f"{name} must be numbers with a fraction, got {array.dtype} {array.shape}")
    shape = array.shape
    inner = shape[1:]
    if len(shape) > 2 and inner[0] == 1 and 1 not in counts:  # an axis of one person
        inner = inner[1:]
    found: list[tuple[int, int, int]] = []
    for n in counts:
        for size, forms in _FORMS.items():
            ways = [*_laid_out(n, size), *(forms if n == 1 else ())]
            if inner in ways:
                found.append((size, n, shape[0]))
            elif shape in ways:
                found.append((size, n, 1))
    if not found or not array.size:
        per, advice = " | ".join(str(n) for n in counts), _advice(shape)
        wanted = f"rotations of n = {per} joints"
        if not advice:
            wanted = "(T, n, 3) or (T, n*3) rotation vectors [rad], (T, n, 3, 3) or (T, n*9) matrices, "
            wanted += f"or (T, n, 6) or (T, n*6), with T > 0 and n = {per} joints"
        raise ValueError(f"{name} must be {wanted}, got {shape}{advice}")
    # (24, 3) is one frame of SMPL: for 24 frames of a root, the caller would have asked for the count 1.
    return next((form for form in found if form[0] != 4), found[0])


def _advice(shape: tuple[int, ...]) -> str:
    """What to do about an array that looks like something else than rotations; empty if it doesn't."""
    if shape[-1:] == (_N_LATENT,) and len(shape) <= 2:
        return ", which looks like VPoser's latent pose: save what VPoser decodes it to"
    if len(shape) > 2 and shape[-1] == 3 and shape[-2] in {len(keypoint_layout(name)) for name in LAYOUTS}:
        return ", which looks like keypoints: publish them, or use KeypointTracker (docs/guide/inputs.md, Keypoints)"
    advice = _ADVICE.get(shape[-1] if shape else 0)
    return f", which looks like {advice}" if advice and len(shape) == 2 else ""


def _check_radians(vectors: Array, name: str) -> None:
    with np.errstate(over="ignore", invalid="ignore"):
        longest = np.linalg.norm(vectors, axis=-1).max(axis=1)
    longest = longest[np.isfinite(longest)]
    if longest.size and float(np.median(longest)) > LONGEST_TURN:
        what = f"{name} has rotation vectors as long as {np.median(longest):.0f} in most frames"
        raise ValueError(f"{what}, wanted radians, 6.3 at most; where they are degrees, save np.radians of them")


def _are_on_bones(vectors: Array) -> bool:
    """Whether vectors (T, n, 3) are places: each moves, but stays as far from another one, as the ends of bones do."""
    some = vectors[:: len(vectors) // _FEW + 1]
    some = some[(np.abs(some) < _HUGE).all(axis=(1, 2))]
    if len(some) < _FEWEST or not (some.std(axis=0).max(axis=1) > _MOVES).all():
        return False
    ways = np.linalg.norm(some[:, :, None] - some[:, None], axis=-1)
    length, change = ways.mean(axis=0), ways.std(axis=0)
    return bool(((length > _MOVES) & (change < _RIGID * length)).any(axis=1).all())


def _rotvecs(matrices: Array, name: str) -> Array:
    """Rotation vectors of matrices (T, n, 3, 3); a frame in which one isn't finite, or is all zero, becomes NaN."""
    result = np.full((*matrices.shape[:2], 3), np.nan)
    there = np.isfinite(matrices).all(axis=(1, 2, 3)) & (np.abs(matrices).max(axis=(2, 3)) > 0).all(axis=1)
    sound = matrices[there]
    with np.errstate(over="ignore", invalid="ignore"):
        skew = np.abs(sound @ sound.swapaxes(-1, -2) - np.eye(3)).max(axis=(2, 3), initial=0.0)
    bad = np.argwhere(~(skew <= _MOST_SKEW))
    if not len(bad):
        bad = np.argwhere(np.linalg.det(sound) < 0)
    if len(bad):
        frame, joint = bad[0]
        one = sound[frame, joint]
        what = "mirrors" if skew[frame, joint] <= _MOST_SKEW else "isn't a rotation"
        where = f"the matrix of joint {joint} in frame {np.flatnonzero(there)[frame]}"
        off = f"determinant {np.linalg.det(one):.2g}, R Rᵀ is {skew[frame, joint]:.2g} off the identity"
        raise ValueError(f"{name}: {where} {what} ({off}); wanted rotations")
    if len(sound):
        flat = Rotation.from_matrix(sound.reshape(-1, 3, 3)).as_rotvec()
        result[there] = flat.reshape(*sound.shape[:2], 3)
    return result


def _of_six(six: Array, name: str, notes: list[str], *, first: int) -> Array:
    """Matrices (T, n, 3, 3) from two of their rows or columns, shape (T, n, 6); `first` is SMPL's number of joint 0.

    Three orders are in use. Interleaved columns are recognised by their numbers. Rows and columns give inverse
    rotations; they are told apart because knees and elbows bend one way only.
    """
    pairs = {"interleaved columns": (six[..., 0::2], six[..., 1::2]), "halves": (six[..., :3], six[..., 3:])}
    with np.errstate(over="ignore", invalid="ignore"):
        uneven = {way: _unevenness(*pair) for way, pair in pairs.items()}
    way = min(uneven, key=lambda key: uneven[key])
    if not uneven[way] <= _MOST_UNEVEN:
        raise ValueError(f"{name} {six.shape}: six numbers a joint that aren't two rows or columns of a rotation")
    columns = _completed(*pairs[way])
    if way == "interleaved columns":
        notes.append(f"{name} holds 6D rotations, taken as interleaved columns")
        return columns
    rows = columns.swapaxes(-1, -2)
    as_rows, as_columns = _flexion(rows, first), _flexion(columns, first)
    is_rows = as_rows >= as_columns
    said = "knees and elbows bend so" if abs(as_rows - as_columns) > 0.1 else "as PyTorch3D has them: no limb bends"
    notes.append(f"{name} holds 6D rotations, taken as the first two {'rows' if is_rows else 'columns'} ({said})")
    return rows if is_rows else columns


def _unevenness(a: Array, b: Array) -> float:
    lengths = np.abs(np.linalg.norm(a, axis=-1) - 1) + np.abs(np.linalg.norm(b, axis=-1) - 1)
    off = lengths + np.abs((a * b).sum(axis=-1))
    return float(off[np.isfinite(off)].mean()) if np.isfinite(off).any() else np.inf


def _completed(a: Array, b: Array) -> Array:
    """Matrices whose first two columns are nearest to a and b, shapes (..., 3), by Gram-Schmidt."""
    x = unit(a)
    y = unit(b - (x * b).sum(axis=-1, keepdims=True) * x)
    return np.stack([x, y, np.cross(x, y)], axis=-1)


def unit(vectors: Array) -> Array:
    """Vectors (..., 3) with a length of 1; zero stays zero."""
    found: Array = vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)
    return found


def flexion_of(vectors: NDArray[Any], *, first: int) -> float:
    """How far knees and elbows bend the way they can [rad], in rotation vectors (T, 3n); `first` as in `_of_six`."""
    some = vectors[:: len(vectors) // _ENOUGH + 1].astype(np.float64)
    some = some[(np.abs(some) < _HUGE).all(axis=1)]
    matrices = Rotation.from_rotvec(some.reshape(-1, 3)).as_matrix()
    return _flexion(matrices.reshape(len(some), vectors.shape[1] // 3, 3, 3), first)


def _flexion(matrices: Array, first: int) -> float:
    """How far knees and elbows bend the way they can [rad], averaged over frames and summed over joints."""
    n, total = matrices.shape[1], 0.0
    for joint, axis, sign in ((4, 0, 1), (5, 0, 1), (18, 1, -1), (19, 1, 1)):
        if 0 <= joint - first < n:
            one = matrices[:, joint - first]
            one = one[np.isfinite(one).all(axis=(1, 2))]
            if len(one):
                turn = 0.5 * (one - one.swapaxes(-1, -2))  # the sine times the axis
                total += sign * float((turn[:, 2, 1], turn[:, 0, 2])[axis].mean())
    return total
