"""Reads one person's motion from any file that is recognised."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from refu_core.errors import RefuError
from refu_core.frames import N_JOINTS
from refu_core.keypoints import Proportions
from refu_core.recordings import _layouts as table
from refu_core.recordings._bvh import read_bvh
from refu_core.recordings._containers import Content, Key, open_content
from refu_core.recordings._find import chosen, find_motion, first, person_of, with_known_names
from refu_core.recordings._followed import (
    MHR_POINTS,
    SMPL_POINTS,
    are_places,
    follow,
    metres_of,
    places_of_mhr,
    whose_joints,
)
from refu_core.recordings._recording import MAX_FRAMES, Recording, check_fps, not_finite, tell_pace
from refu_core.recordings._rotations import BODY, WHOLE, rotvecs_of
from refu_core.recordings._soma import smpl_of_soma
from refu_core.recordings._tables import numbers_of
from refu_core.recordings._tracks import filled, places_in_time
from refu_core.recordings._upright import AXES, PELVIS, PELVIS_OF_SMPLX, Axes, to_smpl
from refu_core.recordings._values import betas_of, fps_of, gender_of, transl_of, word_of

_SMPLH_JOINTS, _SMPLX_JOINTS = 52, 55
_BODY_JOINTS = 22  # what SMPL, SMPL-H and SMPL-X share; SMPL's two hand joints have no counterpart in the others
_ROOTS = ("root", "orient", "globalrot")
_NO_ROOTS = ("trans", "pos", "loc", "vel")
"""Parts of the names of roots, and parts that show that such a name means something else."""


def read_recording(
    path: str | Path,
    *,
    error: type[RefuError],
    fps: float | None = None,
    axes: Axes = "auto",
    person: str | None = None,
    worn: Proportions | None = None,
) -> Recording:
    """Reads the motion of a file; `docs/guide/inputs.md` lists what is recognised.

    Args:
        path: an .npz, .npy, pickle (also joblib's and torch's) or .bvh. Nothing in a pickle is executed.
        error: the type of error that is raised.
        fps: frames a second, instead of what the file says; must be given if the file says nothing.
        axes: what root orientations and translations are expressed in.
        person: whose motion to read if the file has several people; by default the one with the most frames.
        worn: the body that will be dressed: betas are fitted to it if the file has only places of joints, and roots
            turn about its pelvis. By default a built-in body.

    Raises `error`: the file can't be read, isn't recognised, has no frame rate, or its arrays have wrong shapes or
    meanings.
    """
    path = Path(path)
    if axes not in AXES or not isinstance(fps, (int, float, type(None))):
        raise error(f"{path}: wanted axes of {', '.join(AXES)} and fps as a number, got {axes!r} and {fps!r}")
    person = None if person is None else str(person)
    if path.suffix.lower() == ".bvh":
        if person is not None:
            raise error(f"{path}: no person {person!r}; a BVH file has one, without a name: leave the person out")
        return read_bvh(path, error=error, fps=fps, axes=axes, worn=worn)
    content = open_content(path, error=error)
    try:
        return _recording(content, fps=fps, axes=axes, person=person, worn=worn)
    except ValueError as cause:
        raise error(f"{path}: {cause}") from cause


def _recording(
    content: Content, *, fps: float | None, axes: Axes, person: str | None, worn: Proportions | None
) -> Recording:
    notes: list[str] = []
    content, like = with_known_names(smpl_of_soma(content, notes, PELVIS if worn is None else worn.joints[0]))
    if like:
        notes.append(f"taken by like names: {', '.join(f'{key} as {name}' for key, name in like.items())}")
    found, above = find_motion(content, person, notes)
    layout, node = found.layout, found.node
    own = {name: str(key) for key, name in like.items()}
    arrays = {own.get(name, name): content.array(node[name]) for name in layout.pose}
    shapes = [array.shape for array in arrays.values()]
    if layout.is_time_last:
        arrays = {name: np.moveaxis(array, -1, 0) for name, array in arrays.items()}
    if layout.holds_places:
        arrays = {name: _by_time(array) for name, array in arrays.items()}
    n_persons = _persons(arrays)
    persons = [str(i) for i in range(n_persons)] or [person_of(found.path)]
    is_asked = n_persons > 1 or person is not None
    which = chosen(persons, person, [0] * len(persons), notes) if is_asked else 0
    if n_persons:
        arrays = {name: array[which] for name, array in arrays.items()}
    if layout.holds_places:
        lengths = content.array(node.get(table.LENGTHS, np.zeros(0)))
        is_told = n_persons and lengths.shape == (n_persons,) and lengths.dtype.kind in "iu"
        n_lived = max(1, int(lengths[which])) if is_told else None  # the rest pads a batch
        arrays = {name: _checked(array[:n_lived], f"{name} {shapes[0]}") for name, array in arrays.items()}

    def named(names: Sequence[str]) -> str | None:
        return next((name for name in names if node.get(name) is not None), None)

    def one(names: Sequence[str]) -> NDArray[Any] | None:
        name = named(names)
        if name is None:
            return None
        array = content.array(node[name])
        array = np.moveaxis(array, -1, 0) if layout.is_time_last and array.ndim == 2 else array
        return array[which] if n_persons and len(array) == n_persons and array.ndim > 1 else array

    def rate() -> float:
        return check_fps(fps if fps is not None else fps_of(content, first(above, table.RATES)))

    def numbers(n: int) -> NDArray[Any] | None:
        """The frames' numbers, beside the pose or, if there are as many, around it."""
        for place in above:
            array = numbers_of(content, place)
            if array is not None and n_persons and array.ndim > 1 and len(array) == n_persons:
                array = array[which]
            if array is not None and (place is node or array.size == n):
                return array
        return None

    if layout is table.MHR:
        (array,) = arrays.values()
        notes.append("MHR, another body than SMPL's: followed by its keypoints")
        at = places_in_time(numbers(len(array)), len(array), notes)
        places = places_of_mhr(array, transl_of(one(layout.transl), layout, len(array), notes), at)
        return follow(MHR_POINTS, places, fps=rate(), axes=axes, usual="y-down", worn=worn, notes=notes)
    if layout.holds_places or (len(arrays) == 1 and _are_places(*arrays.values())):
        ((name, array),) = arrays.items()
        notes.append(f"{name} {array.shape} holds places of joints and no rotations: SMPL's skeleton is fitted to them")
        places = array[:, : len(SMPL_POINTS)].astype(np.float64)
        places = metres_of(SMPL_POINTS, places[0], notes) * places
        points = whose_joints(places, worn)
        return follow(points, places, fps=rate(), axes=axes, usual="smpl", worn=worn, notes=notes)
    poses, n_joints = _poses(arrays, layout, node, notes)
    n = len(poses)
    transl = transl_of(one(layout.transl), layout, n, notes)
    scaling = one(table.SCALINGS)
    if scaling is not None:
        if scaling.dtype.kind not in "iuf" or not scaling.size or not 1e-6 <= float(scaling.flat[0]) <= 1e6:
            raise ValueError(f"{table.SCALINGS[0]} must be a number in [1e-6, 1e6], got {scaling.reshape(-1)[:1]}")
        transl = transl / scaling.flat[0]
        notes.append(f"translations are divided by {table.SCALINGS[0]}")
    model = word_of(content, first(above, table.MODELS))
    is_smplx = (
        any("smplx" in table.spelled(key) for key in like)
        or "x" in model
        or model == table.SMPLX_VERSION
        or n_joints == _SMPLX_JOINTS
        or (layout.pose == table.OF_SMPLX and n_joints == _BODY_JOINTS)
    )
    betas = betas_of(one(layout.betas), n, notes, has_age=layout.has_age)
    pelvis = PELVIS if worn is None else worn.of(betas.astype(np.float64))[0]
    is_low = pelvis[1] < (PELVIS + PELVIS_OF_SMPLX)[1] / 2  # the given body may be SMPL-X's, too
    if is_smplx and betas.any() and not is_low:
        notes.append("betas are SMPL-X's: another shape space than SMPL's")
    theirs = PELVIS_OF_SMPLX if is_smplx and transl.any() and not is_low else pelvis
    if named(layout.transl) in table.PELVIS_PLACES:
        theirs, transl = pelvis, transl - pelvis
    if layout.turns_about_origin:
        transl = transl + Rotation.from_rotvec(poses[:, 0]).apply(theirs) - pelvis  # NaN for a root that is
    elif theirs is not pelvis:
        transl = transl + theirs - pelvis
    if theirs is not pelvis:
        notes.append("SMPL-X's mesh has its pelvis 13 cm lower than SMPL's: translations are changed by that")
    poses, transl = filled(poses, transl, numbers(n), notes)
    of_amass = n_joints in (_SMPLH_JOINTS, _SMPLX_JOINTS) and first(above, table.RATES[:2]) is not None
    usual: Axes = "z-up" if of_amass else "smpl"
    poses[:, 0], transl = to_smpl(poses[:, 0], transl, axes, notes, usual=usual, pelvis=pelvis)
    hertz = rate()
    tell_pace(transl, hertz, notes)
    with np.errstate(over="ignore", invalid="ignore"):  # becomes inf or NaN, which the frame refuses
        sent = poses.astype(np.float32)
    bad = not_finite(sent, transl)
    if len(bad):
        where = f"{len(bad)} of {len(poses)}, first in number {bad[0]}"
        notes.append(f"NaN or infinite in {where}: nobody is dressed there")
    word = word_of(content, first(above, table.GENDERS), which)
    coded = dict(enumerate(layout.genders)).get(int(word) if word.isdecimal() else -1, word)
    gender = gender_of(coded, notes)
    return Recording(sent, transl, betas, hertz, gender, tuple(notes))


def _by_time(array: NDArray[Any]) -> NDArray[Any]:
    """Places of joints as (T, n, 3), or of several persons as (N, T, n, 3)."""
    if array.ndim == 4:  # the time was last: now it is first, and persons are second
        array = array.swapaxes(0, 1)
    if array.ndim == 2 and array.shape[1] % 3 == 0:
        array = array.reshape(len(array), -1, 3)
    return array


def _checked(array: NDArray[Any], name: str) -> NDArray[Any]:
    if not _are_places(array):
        raise ValueError(f"{name}: no places of SMPL's joints, (T, n, 3) with n = 22 or 24, between which are bones")
    return array


def _are_places(array: NDArray[Any]) -> bool:
    is_alike = array.ndim == 3 and array.shape[1] in WHOLE and array.shape[2] == 3 and array.dtype.kind == "f"
    return is_alike and len(array) > 0 and are_places(array.astype(np.float64))


def _persons(arrays: Mapping[str, NDArray[Any]]) -> int:
    """How many persons are along the first axis (SLAHMR), 0 where there is no such axis."""
    ways = [3 * n for n in (*WHOLE, *BODY)]
    batched = [array for array in arrays.values() if array.ndim == 3 and array.shape[2] in ways and array.shape[1] > 1]
    batched += [array for array in arrays.values() if array.ndim == 4 and array.shape[3] == 3 and array.shape[2] > 3]
    return len(batched[0]) if batched else 0


def _poses(
    arrays: Mapping[str, NDArray[Any]], layout: table.Layout, node: Mapping[Key, Any], notes: list[str]
) -> tuple[NDArray[np.float64], int]:
    """Rotation vectors of SMPL's 24 joints, from any layout, and how many joints that has, the root included."""
    names, given = list(arrays), list(arrays.values())
    if len(given) == 2:
        root, _ = rotvecs_of(given[0], names[0], (1,), notes, has_root=True)
        body, n = rotvecs_of(given[1], names[1], layout.joints[1], notes, has_root=False)
        if n in WHOLE:
            if body[:, 0].any():
                msg = f"{names[1]} has a root of its own beside {names[0]}; wanted zeros there, or no {names[0]}"
                raise ValueError(msg)
            body, n = body[:, 1:], n - 1
        if len(root) != len(body):
            raise ValueError(f"{names[0]} has {len(root)} frames, {names[1]} {len(body)}; wanted as many")
    else:
        whole, n = rotvecs_of(given[0], names[0], (*WHOLE, *BODY), notes, has_root=True)
        if n in BODY:
            words = {key: table.spelled(key) for key in node}
            others = [
                key
                for key, word in words.items()
                if any(part in word for part in _ROOTS) and not any(part in word for part in _NO_ROOTS)
            ]
            if others:
                msg = f"{names[0]} has no root, and {others[0]} may be it: save it as root_orient with pose_body"
                raise ValueError(msg)
            notes.append(f"{names[0]} has no root: the person stands upright and looks along z")
            root, body = np.zeros((len(whole), 1, 3)), whole
        else:
            root, body, n = whole[:, :1], whole[:, 1:], n - 1
    kept = n if n == N_JOINTS - 1 else _BODY_JOINTS - 1
    if len(body) > MAX_FRAMES:
        raise ValueError(f"{len(body)} frames, at most {MAX_FRAMES} are read; cut the clip")
    poses = np.zeros((len(body), N_JOINTS, 3))
    poses[:, :1], poses[:, 1 : 1 + kept] = root, body[:, :kept]
    return poses, 1 + n
