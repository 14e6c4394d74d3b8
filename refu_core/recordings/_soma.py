"""SOMA: a body that isn't SMPL's, but whose files turn its joints about the axes of a T-pose, as SMPL's do.

So each of SMPL's joints takes the turns of SOMA's joint in the same place. Where SMPL has one joint for two of SOMA's,
their turns are composed. Nothing of SOMA's own package or model is needed.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from refu_core.frames import N_JOINTS
from refu_core.recordings._containers import Content
from refu_core.recordings._layouts import RATES, SOMA_NAMES
from refu_core.recordings._rotations import rotvecs_of
from refu_core.recordings._values import word_of

_CHAINS = "Hips LeftLeg RightLeg Spine1 LeftShin RightShin Spine2 LeftFoot RightFoot Chest LeftToeBase RightToeBase "
_CHAINS += "Neck1+Neck2 LeftShoulder RightShoulder Head LeftArm RightArm LeftForeArm RightForeArm LeftHand RightHand"
_METRES = {"meters": 1.0, "centimeters": 0.01, "millimeters": 0.001}
_SMPL = ("smpl", "smplh", "smplx")


def smpl_of_soma(content: Content, notes: list[str], pelvis: NDArray[np.float64]) -> Content:
    """A SOMA file as one of SMPL, whose pelvis at rest is at `pelvis` (3,) [m]; any other file stays as it is.

    Raises `ValueError` for a SOMA file without the body's joints, or whose turns aren't about the axes of the T-pose.
    """
    root = content.root
    if not isinstance(root, dict) or any(root.get(name) is None for name in ("poses", SOMA_NAMES)):
        return content
    names = [str(name) for name in np.asarray(content.array(root[SOMA_NAMES])).reshape(-1)]
    chains = [chain.split("+") for chain in _CHAINS.split()]
    missing = [name for chain in chains for name in chain if name not in names]
    if missing:
        msg = f"{SOMA_NAMES}: wanted those of SOMA's body, without {', '.join(missing[:4])} among {len(names)}"
        raise ValueError(msg)
    if word_of(content, root.get("absolute_pose")) in ("true", "1"):
        raise ValueError("SOMA's poses are absolute: save them relative to the T-pose (with joint_orient)")
    turns, _ = rotvecs_of(content.array(root["poses"]), "poses", (len(names),), notes, has_root=True)
    poses = np.zeros((len(turns), N_JOINTS, 3))
    for joint, chain in enumerate(chains):
        poses[:, joint] = _together([turns[:, names.index(name)] for name in chain])
    notes.append(f"SOMA's {len(names)} joints, another body than SMPL's: {len(chains)} of SMPL's turn as they do")
    found: dict[str | int, Any] = {"poses": poses, **{name: root[name] for name in RATES if name in root}}
    unit = word_of(content, root.get("unit")) or "meters"
    if unit not in _METRES:
        raise ValueError(f"unit: wanted {', '.join(_METRES)}, got {unit[:20]!r}")
    if root.get("transl") is not None:  # SOMA's is the place of the hips; SMPL's is added to the pelvis at rest
        transl = content.array(root["transl"])
        is_place = transl.dtype.kind in "iuf" and transl.shape[-1:] == (3,)
        found["transl"] = _METRES[unit] * transl - pelvis if is_place else transl
    kind = word_of(content, root.get("identity_model_type"))
    if kind in _SMPL and root.get("identity_coeffs") is not None:
        found["betas"] = content.array(root["identity_coeffs"])
        found["surface_model_type"] = kind
    elif kind:
        notes.append(f"SOMA's identity of the kind {kind[:20]!r} isn't read")
    return Content(found)


def _together(turns: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    """One joint's rotation vectors [rad], (T, 3), composed of those of several, from the root outwards."""
    if len(turns) == 1:
        return turns[0]
    sound = np.isfinite(turns).all(axis=(0, 2))
    whole = np.full(turns[0].shape, np.nan)
    first, second = (Rotation.from_rotvec(turn[sound]) for turn in turns)
    whole[sound] = (first * second).as_rotvec()
    return whole
