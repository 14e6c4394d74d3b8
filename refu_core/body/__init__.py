"""SMPL-layout body models: linear blend skinning, loaders, and the built-in CC0 bodies."""

from refu_core.body._io import BUILTIN_BODIES, load_body
from refu_core.body._kinematics import JOINT_NAMES, PARENTS, RigidTransforms, forward_kinematics, rotvec_to_rotmat
from refu_core.body._model import BodyOutput, Shape, SmplBody
from refu_core.body._skinning import Skinning, apply_transforms, blend_transforms, unapply_transforms

__all__ = [
    "BUILTIN_BODIES",
    "JOINT_NAMES",
    "PARENTS",
    "BodyOutput",
    "RigidTransforms",
    "Shape",
    "Skinning",
    "SmplBody",
    "apply_transforms",
    "blend_transforms",
    "forward_kinematics",
    "load_body",
    "rotvec_to_rotmat",
    "unapply_transforms",
]
