"""From drawn people to a linear shape space in the T-pose, SMPL's way: a mean, ten unit-variance betas, joints."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from asset_tools.makehuman import BODY_VERTICES, MIRROR, BaseMesh
from refu_core.body import JOINT_NAMES, PARENTS
from refu_core.frames import N_BETAS
from refu_core.mesh import vertex_areas

PEOPLE = 600
"""How many are drawn of each gender."""
PELVIS = np.array([0.0, -0.22, 0.02])
"""Where every T-posed body's pelvis lies [m]."""

_MARKERS = {
    "pelvis": ("l-upper-leg", "r-upper-leg", "pelvis"),
    "spine1": ("spine-3",),
    "spine2": ("spine-2",),
    "spine3": ("spine-1",),
    "neck": ("neck",),
    "head": ("head",),
}
_SIDE_MARKERS = {
    "hip": "upper-leg",
    "knee": "knee",
    "ankle": "ankle",
    "foot": "toe-2-1",
    "collar": "clavicle",
    "shoulder": "shoulder",
    "elbow": "elbow",
    "wrist": "hand",
    "hand": "finger-3-1",
}


@dataclass(frozen=True, eq=False)
class ShapeSpace:
    """v(β) = mean + basis β for every vertex of the base mesh, body and helpers alike."""

    mean: NDArray[np.float64]
    """T-pose [m], shape (n, 3)."""
    basis: NDArray[np.float64]
    """[m] per unit of beta, shape (n, 3, 10)."""
    joints: NDArray[np.float64]
    """Joints of the people it was fitted to [m], shape (count, 24, 3)."""
    betas: NDArray[np.float64]
    """Their scores, shape (count, 10)."""

    @classmethod
    def fit(cls, samples: NDArray[np.float32], joints: NDArray[np.float64], mesh: BaseMesh) -> ShapeSpace:
        """Principal components of the body, every vertex weighted by its area, made exactly symmetric.

        In order of variance, except that beta 1 is the one that says most about girth. Beta 0 grows with height, beta 1
        with girth. The helpers follow by regression.
        """
        count = len(samples)
        body = mesh.triangles("body")
        mean = samples.mean(0, dtype=np.float64)
        centred = (samples - mean.astype(np.float32)).reshape(count, -1)
        area = vertex_areas(mean[:BODY_VERTICES], body)
        weighted = centred[:, : 3 * BODY_VERTICES] * np.repeat(np.sqrt(area / area.sum()), 3).astype(np.float32)
        _, vectors = np.linalg.eigh((weighted @ weighted.T).astype(np.float64))
        betas = vectors[:, ::-1][:, :N_BETAS] * np.sqrt(count)

        height = np.ptp(samples[:, :BODY_VERTICES, 1], axis=1)
        corners = samples[:, body].astype(np.float64)
        volume = np.einsum("sfk,sfk->s", corners[:, :, 0], np.cross(corners[:, :, 1], corners[:, :, 2])) / 6
        girth = volume / height
        # For men and women together, it is the third component that tells stout from slim.
        stoutness = [abs(np.corrcoef(betas[:, k], girth)[0, 1]) for k in (1, 2, 3)]
        second = 1 + int(np.argmax(stoutness))
        betas[:, [1, second]] = betas[:, [second, 1]]
        signs = [betas[:, 0] @ (height - height.mean()), betas[:, 1] @ (girth - girth.mean())]
        # The others have no everyday meaning: the farthest sample counts as positive.
        signs += [betas[np.abs(betas[:, k]).argmax(), k] for k in range(2, N_BETAS)]
        betas = betas * np.sign(signs)
        basis = (betas.T @ centred / count).reshape(N_BETAS, -1, 3).transpose(1, 2, 0)
        # MakeHuman's targets are symmetric to 0.2 mm only.
        mean = (mean + mean[mesh.mirror] * MIRROR) / 2
        basis = (basis + basis[mesh.mirror] * MIRROR[:, None]) / 2
        return cls(mean, basis.astype(np.float64), joints, betas)


@dataclass(frozen=True, eq=False)
class TPose:
    """Takes people from the base mesh's rest pose to SMPL's T-pose."""

    mesh: BaseMesh

    @cached_property
    def joint_weights(self) -> NDArray[np.float64]:
        """The matrix that gives joints from the vertices of the rest pose, shape (24, n)."""
        rows = []
        for name in JOINT_NAMES:
            side, _, stem = name.partition("_")
            markers = _MARKERS.get(name) or (f"{side[0]}-{_SIDE_MARKERS[stem]}",)
            rows.append(np.mean([self.mesh.marker(marker) for marker in markers], 0))
        return np.array(rows)

    @cached_property
    def _knuckles(self) -> dict[str, NDArray[np.float64]]:
        """Vertex weights of the vector from the little finger's knuckle to the index finger's, by side."""
        return {s: self.mesh.marker(f"{s}-finger-2-1") - self.mesh.marker(f"{s}-finger-5-1") for s in "lr"}

    def __call__(self, vertices: NDArray[np.float32]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """T-posed vertices (n, 3) and joints (24, 3) [m] of one person's `vertices` (n, 3).

        Skinning back to the rest pose gives the input again: v_T = (Σ_j w_j T_j⁻¹)⁻¹ v.
        """
        v = vertices.astype(np.float64)
        joints = self.joint_weights @ v
        rotations = self._rotations(v, joints)
        posed = np.zeros_like(joints)
        inverse = np.zeros((len(joints), 3, 4))
        for j, parent in enumerate(PARENTS):
            rotation = rotations[j]
            posed[j] = joints[j] if parent < 0 else posed[parent] + rotations[parent] @ (joints[j] - joints[parent])
            inverse[j, :, :3] = rotation.T
            inverse[j, :, 3] = joints[j] - rotation.T @ posed[j]
        blended = (self.mesh.weights @ inverse.reshape(len(joints), -1)).reshape(-1, 3, 4)
        unposed = np.linalg.solve(blended[:, :, :3], (v - blended[:, :, 3])[..., None])[..., 0]
        shift = PELVIS - posed[0]
        return unposed + shift, posed + shift

    def _rotations(self, v: NDArray[np.float64], joints: NDArray[np.float64]) -> NDArray[np.float64]:
        """Global rotations of the joints, shape (24, 3, 3), that make the T."""
        at = {name: joints[i] for i, name in enumerate(JOINT_NAMES)}
        rotations = np.tile(np.eye(3), (len(JOINT_NAMES), 1, 1))
        for sign, side in ((1.0, "left"), (-1.0, "right")):

            def bone(start: str, end: str, side: str = side) -> NDArray[np.float64]:
                return at[f"{side}_{end}"] - at[f"{side}_{start}"]

            outward = np.array([sign, 0.0, 0.0])
            shoulder = _aligning(bone("shoulder", "elbow"), outward)
            # Elbows bend forward: the forearm's remaining bend is turned into the horizontal plane.
            bend = shoulder @ bone("elbow", "wrist")
            shoulder = _about_x(np.arctan2(bend[1], bend[2])) @ shoulder
            elbow = _aligning(shoulder @ bone("elbow", "wrist"), outward) @ shoulder
            wrist = _aligning(elbow @ bone("wrist", "hand"), outward) @ elbow
            # Palms down: the knuckles run from back to front. The forearm takes half of that twist.
            knuckles = wrist @ (self._knuckles[side[0]] @ v)
            twist = np.arctan2(knuckles[1], knuckles[2])
            wrist, elbow = _about_x(twist) @ wrist, _about_x(twist / 2) @ elbow
            hip = _aligning(bone("hip", "knee"), np.array([sign * 0.07, -1.0, 0.0]))
            knee = _aligning(hip @ bone("knee", "ankle"), np.array([sign * 0.03, -1.0, -0.05])) @ hip
            # Feet only turn about the vertical: soles stay flat.
            toes = bone("ankle", "foot")
            ankle = _about_y(np.arctan2(sign * 0.17, 1.0) - np.arctan2(toes[0], toes[2]))
            found = {"shoulder": shoulder, "elbow": elbow, "wrist": wrist, "hand": wrist}
            found |= {"hip": hip, "knee": knee, "ankle": ankle, "foot": ankle}
            for name, rotation in found.items():
                rotations[JOINT_NAMES.index(f"{side}_{name}")] = rotation
        return rotations


def build_shape_spaces(mesh: BaseMesh) -> dict[str, ShapeSpace]:
    """Shape spaces of men, of women, and (`neutral`) of all of them."""
    to_tpose = TPose(mesh)
    samples, joints = {}, {}
    for gender in ("male", "female"):
        people = mesh.people(PEOPLE, gender=gender)
        joints[gender] = np.empty((PEOPLE, len(JOINT_NAMES), 3))
        for i in range(PEOPLE):  # in place: a gender's samples are 160 MB
            people[i], joints[gender][i] = to_tpose(people[i])
        samples[gender] = people
    samples["neutral"] = np.concatenate([samples["male"], samples["female"]])
    joints["neutral"] = np.concatenate([joints["male"], joints["female"]])
    return {name: ShapeSpace.fit(samples[name], joints[name], mesh) for name in samples}


def _aligning(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """The smallest rotation that takes the direction a to b."""
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    x, y, z = np.cross(a, b)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + cross + cross @ cross / (1 + a @ b)


def _about_x(angle: float) -> NDArray[np.float64]:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def _about_y(angle: float) -> NDArray[np.float64]:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
