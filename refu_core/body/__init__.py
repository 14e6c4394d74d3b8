"""SMPL-layout body models: linear blend skinning, loaders, and the built-in CC0 bodies."""

from refu_core.body._anatomy import DEFAULT_GAP, ColliderSettings
from refu_core.body._collider import Collider
from refu_core.body._fit import POOR_FIT, BodyFit, Difference, ShapeMap, load_fit
from refu_core.body._io import BUILTIN_BODIES, load_body
from refu_core.body._kinematics import (
    RigidTransforms,
    forward_kinematics,
    rotvec_to_rotmat,
)
from refu_core.body._model import BodyOutput, Shape, SmplBody
from refu_core.body._parts import ARMS, LEGS, MIRRORED_JOINTS, SEGMENTS, joints_of, part_of_faces, weight_of_parts
from refu_core.body._register import Registration
from refu_core.body._rest_pose import require_rest_pose
from refu_core.body._skinning import JointWeights, Skinning, apply_transforms, blend_transforms, unapply_transforms
from refu_core.body._surface import Surface
from refu_core.skeleton import JOINT_NAMES, PARENTS

__all__ = [
    "ARMS",
    "BUILTIN_BODIES",
    "DEFAULT_GAP",
    "JOINT_NAMES",
    "LEGS",
    "MIRRORED_JOINTS",
    "PARENTS",
    "POOR_FIT",
    "SEGMENTS",
    "BodyFit",
    "BodyOutput",
    "Collider",
    "ColliderSettings",
    "Difference",
    "JointWeights",
    "Registration",
    "RigidTransforms",
    "Shape",
    "ShapeMap",
    "Skinning",
    "SmplBody",
    "Surface",
    "apply_transforms",
    "blend_transforms",
    "forward_kinematics",
    "joints_of",
    "load_body",
    "load_fit",
    "part_of_faces",
    "require_rest_pose",
    "rotvec_to_rotmat",
    "unapply_transforms",
    "weight_of_parts",
]
