"""Checks that a body model stands as this project expects: in metres, upright, facing forward, in the T-pose."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from refu_core.body._model import BodyArrays, SmplBody
from refu_core.body._parts import part_of_faces
from refu_core.body._segments import SOFTNESS
from refu_core.errors import BodyError, MeshError
from refu_core.mesh import Connectivity
from refu_core.skeleton import JOINT_NAMES

_TALL = (0.3, 2.2)
"""Least and greatest distance from ankles to neck [m]: children and giants."""
_UNITS = {"millimetres": 1000.0, "centimetres": 100.0, "inches": 39.37, "feet": 3.281, "decimetres": 10.0}
_ALONG = 0.8
"""A body stands, or faces, along an axis where the cosine of its angle to it is at least this."""
_ARMS = 0.5
"""The same for arms that are stretched out to the sides."""
_LIMBS = ((1, 4), (2, 5), (4, 7), (5, 8), (16, 18), (17, 19), (18, 20), (19, 21))
"""Hips, knees, shoulders and elbows, each with the joint where its limb ends."""
_AT_LIMB = 0.08
"""How far the mean of the skin that a limb moves may be from the limb's middle [of the body's height]. In the built-in
bodies it is 0.02 at most; the skin of the next limb is 0.17 away."""
_FARTHEST = 1 / 3
"""How far a unit of shape, or of a pose feature, may move a vertex [of the body's height]: in no model is it as much as
a tenth."""
_OFF, _LONG = 1 / 3, 1 / 8
"""How far skin may be from the nearest joint, and how long an edge may be [of the distance from ankles to neck]. In the
built-in bodies they are 0.17 and 0.03; beyond these limits a vertex is out of place."""
_AXES = ("x", "y", "z")
_WANTED = "wanted metres, y up, facing +z, the subject's left at +x, in the T-pose"


def require_rest_pose(body: SmplBody, *, closed: bool = True) -> None:
    """Checks that the mean shape stands as expected, with its faces turned outward, and is closed if `closed`.

    Raises `BodyError` if it has other units or axes, is mirrored, not in the T-pose, open or turned inside out, or if
    its joints are elsewhere.
    """
    joints = body.arrays.joint_regressor @ body.arrays.v_template
    fault = _fault(body.arrays.v_template, joints) or _misled(body.arrays, joints)
    fault = fault or _lacking(body) or _loose(body.arrays, joints)
    if not fault:
        try:
            mesh = Connectivity.of(body.faces.cpu().numpy(), body.n_vertices)
        except MeshError as error:
            fault = str(error)
    if not fault:
        corners = body.arrays.v_template[mesh.faces]
        volume = np.einsum("fc,fc->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
        if volume <= 0:
            fault = "its faces are turned inward; reverse the order of each face's vertices"
        elif closed:
            try:
                mesh.require_closed()
            except MeshError as error:
                fault = f"{error}; or give it as betas_from, which needs its shapes alone"
    if fault:
        raise BodyError(f"body {body.name}: {fault}")


def _loose(arrays: BodyArrays, joints: NDArray[np.float64]) -> str:
    """What is wrong if a vertex is where no skin can be; empty if none is."""
    v = arrays.v_template
    tall = float(np.linalg.norm(_upward(joints)))
    off = np.asarray(cKDTree(joints).query(v)[0])
    if off.max() > _OFF * tall:
        return f"vertex {off.argmax()} of v_template is {off.max():.2f} m from every joint: put it where it belongs"
    edges = np.concatenate((arrays.faces[:, :2], arrays.faces[:, 1:], arrays.faces[:, ::2]))
    length = np.linalg.norm(v[edges[:, 0]] - v[edges[:, 1]], axis=1)
    if length.max() > _LONG * tall:
        a, b = edges[length.argmax()]
        return f"the edge between its vertices {a} and {b} is {length.max():.2f} m long: one of them is out of place"
    return ""


def _upward(joints: NDArray[np.float64]) -> NDArray[np.float64]:
    """The way from the middle of the ankles to the neck [m], shape (3,)."""
    ankles = joints[[JOINT_NAMES.index("left_ankle"), JOINT_NAMES.index("right_ankle")]]
    found: NDArray[np.float64] = joints[JOINT_NAMES.index("neck")] - ankles.mean(0)
    return found


def _misled(arrays: BodyArrays, joints: NDArray[np.float64]) -> str:
    """What is wrong if a limb's joint moves skin that isn't at the limb; empty if none does."""
    tall = float(np.ptp(arrays.v_template[:, 1]))
    for joint, end in _LIMBS:
        follows = arrays.weights[:, joint] > 0.5
        if not follows.any():
            return f"no vertex follows its {JOINT_NAMES[joint]} for the most part: weights are of other joints"
        off = float(np.linalg.norm(arrays.v_template[follows].mean(0) - (joints[joint] + joints[end]) / 2))
        if off > _AT_LIMB * tall:
            return f"what follows its {JOINT_NAMES[joint]} is {off:.2f} m from there: weights are of other joints"
    return ""


def _lacking(body: SmplBody) -> str:
    """What is wrong if vertices or segments lack faces, or directions aren't in metres; empty if nothing is."""
    arrays = body.arrays
    tall = float(np.ptp(arrays.v_template[:, 1]))
    if n_unused := len(arrays.v_template) - len(np.unique(arrays.faces)):
        return f"{n_unused} of {len(arrays.v_template)} vertices belong to no face: leave them out"
    parts = [joints for joints, _ in SOFTNESS]
    there = part_of_faces(body.weights.cpu(), body.faces.cpu(), parts)
    for k, joints in enumerate(parts):
        if k not in there:
            return f"no face follows its {JOINT_NAMES[joints[0]]} for the most part: the mesh lacks it, or is coarse"
    for name in ("shapedirs", "posedirs"):
        found = getattr(arrays, name)
        if found is not None and (far := float(np.abs(found).max())) > _FARTHEST * tall:
            return f"{name} moves a vertex by {far:.3g} m a unit: it must be in metres, as v_template is"
    return ""


def _fault(vertices: NDArray[np.float64], joints: NDArray[np.float64]) -> str:
    """What is wrong with the places of vertices (V, 3) and joints (24, 3); empty if nothing is."""
    at = dict(zip(JOINT_NAMES, joints, strict=True))
    up = _upward(joints)
    tall = float(np.linalg.norm(up))
    if not _TALL[0] <= tall <= _TALL[1]:
        unit = min(_UNITS, key=lambda name: abs(np.log(max(tall, 1e-9) / _UNITS[name] / 1.4)))
        guess = f": {unit}? Divide v_template, shapedirs and posedirs by {_UNITS[unit]:g}" if tall > 1 else ""
        return f"it is {tall:.4g} from the ankles to the neck, wanted metres (about 1.4){guess}"
    low, high = vertices.min(0) - 0.1 * tall, vertices.max(0) + 0.1 * tall
    outside = [name for name, joint in at.items() if (joint < low).any() or (joint > high).any()]
    if outside:
        return f"{len(outside)} joints are outside of its mesh, {outside[0]} for one: J_regressor is of other vertices"
    left = at["left_shoulder"] - at["right_shoulder"]
    forward = at["left_foot"] + at["right_foot"] - at["left_ankle"] - at["right_ankle"]
    ways = {name: _axis(way) for name, way in (("up", up), ("left", left), ("front", forward))}
    if tuple(ways.values()) != ("+y", "+x", "+z"):
        told = ", ".join(f"{name} is {way}" for name, way in ways.items())
        if np.cross(up, forward) @ left < 0:
            return f"it is mirrored ({told}): {_WANTED}; negate one coordinate, or exchange left and right"
        return f"it stands otherwise ({told}): {_WANTED}; turn v_template, shapedirs and posedirs"
    for side, out in (("left", 1), ("right", -1)):
        arm = at[f"{side}_wrist"] - at[f"{side}_shoulder"]
        if out * arm[0] < _ARMS * float(np.linalg.norm(arm)):
            return f"its {side} arm isn't stretched out to the side at rest: {_WANTED}"
    return ""


def _axis(way: NDArray[np.float64]) -> str:
    """The axis that a direction is along, such as `+y`; `askew` if it is along none."""
    unit = way / max(float(np.linalg.norm(way)), 1e-12)
    k = int(np.abs(unit).argmax())
    return f"{'+' if unit[k] > 0 else '-'}{_AXES[k]}" if abs(unit[k]) >= _ALONG else "askew"
