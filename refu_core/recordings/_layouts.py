"""The one table of how files of motion are laid out: which arrays hold the pose, the place, the shape.

A file is recognised by the names of its arrays. How an array holds rotations is told by its shape (`_rotations`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import PurePath
from typing import Any

from refu_core.recordings._followed import N_KEYPOINTS
from refu_core.recordings._rotations import BODY, WHOLE

SUFFIXES = (".npz", ".npy", ".pkl", ".pickle", ".pk", ".p", ".joblib", ".pt", ".pth", ".smpl", ".bvh")
"""Suffixes of files that hold motion."""


def is_named_as_motion(name: str) -> bool:
    """Whether a file found in a folder may hold motion. AMASS keeps shapes beside its motions, macOS notes (`._…`)."""
    path = PurePath(name)
    is_beside = path.name == "shape.npz" or path.stem.endswith("_stagei") or path.name.startswith(".")
    return path.suffix.lower() in SUFFIXES and not is_beside


ROOT_PLACES = ("root_translation", "root_trans", "root_transl")
PELVIS_PLACES = ("root_trans_offset", "root_trans_world", "root_trans_cam")
"""Names of translations that are where the pelvis is, instead of how far the mesh is moved."""


@dataclass(frozen=True, kw_only=True)
class Layout:
    """One way to lay out a person's motion."""

    writers: str
    """Who writes this layout."""
    pose: tuple[str, ...]
    """Arrays whose joints, one array after another, are the pose; the root comes first if there is one."""
    transl: tuple[str, ...] = ("trans", "transl", "translation", *ROOT_PLACES)
    """Names that the translation may have [m]."""
    betas: tuple[str, ...] = ("betas", "beta", "shape")
    """Names that the shape may have."""
    is_time_last: bool = False
    repeats_root: bool = False
    """Whether the second array also has a place for the root, with zeros in it."""
    is_whole: bool = True
    """Whether these arrays are the whole pose; if not, there may be a root, or rotations, under unknown names."""
    holds_places: bool = False
    """Whether the pose consists of places of joints instead of rotations."""
    counts: tuple[int, ...] = ()
    """Numbers of joints or points, where they aren't SMPL's."""
    has_age: bool = False
    """Whether an eleventh beta is the share of a child (SMPL+A) instead of one more of the shape."""
    genders: tuple[str, ...] = ()
    """What a gender's number means, where genders are numbers."""
    turns_about_origin: bool = False
    """Whether the root turns the body about the origin of its mesh instead of its pelvis."""

    @property
    def arrays(self) -> tuple[str, ...]:
        """Names that its arrays may have."""
        return (*self.pose, *self.transl, *self.betas)

    def is_in(self, node: Mapping[Any, Any]) -> bool:
        """Whether a mapping has all arrays of the pose."""
        return all(node.get(name) is not None for name in self.pose)

    @property
    def joints(self) -> tuple[tuple[int, ...], ...]:
        """How many joints each array may have."""
        if len(self.pose) == 1:
            return (self.counts or (*WHOLE, *BODY),)
        return (1,), (*BODY, *WHOLE) if self.repeats_root else BODY


MHR = Layout(
    writers="SAM 3D Body", pose=("pred_keypoints_3d",), transl=("pred_cam_t",), is_whole=False, counts=(N_KEYPOINTS,)
)
"""Its keypoints, relative to the body, and where the body is in front of the camera [m]."""

LAYOUTS: tuple[Layout, ...] = (
    Layout(writers="WHAM, in the world", pose=("pose_world",), transl=("trans_world",)),
    Layout(writers="BEDLAM, in the world", pose=("poses_world",), transl=("trans_world",)),
    Layout(
        writers="EasyMocap",
        pose=("Rh", "poses"),
        transl=("Th",),
        betas=("shapes",),
        repeats_root=True,
        turns_about_origin=True,
    ),
    Layout(writers="AMASS, 3DPW, and most others", pose=("poses",)),
    Layout(writers="AMASS's SMPL-X, SLAHMR", pose=("root_orient", "pose_body")),
    Layout(writers="smplx, GVHMR, 4DHumans, HMR 2", pose=("global_orient", "body_pose")),
    Layout(writers="EMDB", pose=("poses_root", "poses_body")),
    Layout(writers="AIST++", pose=("smpl_poses",), transl=("smpl_trans",)),
    Layout(
        writers="ROMP, BEV, TRACE", pose=("smpl_thetas",), transl=("cam_trans",), betas=("smpl_betas",), has_age=True
    ),
    Layout(writers="HybrIK", pose=("pred_thetas",), transl=("transl",), betas=("pred_betas",)),
    Layout(writers="TRAM", pose=("pred_rotmat",), transl=("pred_trans",), betas=("pred_shape",)),
    Layout(
        writers="GLAMR, in the world",
        pose=("smpl_orient_world", "smpl_pose"),
        transl=("root_trans_world",),
        betas=("smpl_beta",),
    ),
    Layout(
        writers="PHC and other humanoid controllers",
        pose=("pose_aa",),
        transl=("trans_orig", "trans", "root_trans_offset"),
    ),
    Layout(
        writers="Meshcapade",
        pose=("bodyPose",),
        transl=("bodyTranslation",),
        betas=("shapeParameters",),
        genders=("neutral", "male", "female"),
        is_whole=False,
    ),
    Layout(writers="MDM", pose=("thetas",), transl=("root_translation",), is_time_last=True),
    Layout(writers="WHAM, VIBE, CLIFF, in the camera", pose=("pose",), transl=("trans", "global_t", "transl")),
    Layout(writers="BEDLAM, in the camera", pose=("poses_cam",), transl=("trans_cam",)),
    Layout(
        writers="GLAMR, in the camera",
        pose=("smpl_orient_cam", "smpl_pose"),
        transl=("root_trans_cam",),
        betas=("smpl_beta",),
    ),
    Layout(writers="a body without its root", pose=("pose_body",), is_whole=False),
    Layout(writers="a body without its root", pose=("body_pose",), is_whole=False),
    Layout(writers="joints alone", pose=("joints",), is_whole=False, holds_places=True),
    Layout(writers="joints alone", pose=("joint_positions",), is_whole=False, holds_places=True),
    Layout(writers="whom a robot follows", pose=("smpl_joints",), is_whole=False, holds_places=True),
    Layout(writers="MDM's samples", pose=("motion",), is_whole=False, is_time_last=True, holds_places=True),
    MHR,
)
"""In order of preference, for files that hold several."""

OF_SMPLX = ("global_orient", "body_pose")
"""Arrays that are SMPL-X's if they hold 22 joints; AMASS's arrays of 22 joints may also be SMPL-H's."""
RATES = ("mocap_framerate", "mocap_frame_rate", "fps", "framerate", "frame_rate", "frameRate", "FPS")
GENDERS = ("gender", "genders")
FRAME_NUMBERS = ("frame_ids", "frame_id", "frame_idx", "frame", "frames")
"""Numbers of the frames, where a tracker may have lost some. Other files have pictures or a count under these names."""
IMAGES = ("imgname", "img_name", "image_name", "img_path", "image_path")
"""Names of the images that the rows of a table were seen in: a folder for each sequence, a number at the end."""
LENGTHS = "lengths"
"""How many frames each sample of a batch has; the rest is padding."""
SCALINGS = ("smpl_scaling",)
"""AIST++'s translations are those of a body that is larger by this factor."""
MODELS = ("surface_model_type", "smplVersion")
SMPLX_VERSION = "2"
"""SMPL-X's number in Meshcapade's files."""

SOMA_NAMES = "joint_names"
_SOMA = (SOMA_NAMES, "absolute_pose", "unit", "identity_model_type", "identity_coeffs")
TRACK_IDS = ("track_id", "person_id", "tid", "id")
PERSONS = (*TRACK_IDS, "track_ids", "person_ids", "sub", "subject")
"""Whose each row of a table is."""
COLUMNS = (*FRAME_NUMBERS, *IMAGES, *PERSONS, *GENDERS)
"""Names under which a number or a word for each row may stand, and in other files anything else."""

POSE_KEYS = frozenset(name for layout in LAYOUTS if layout.is_whole for name in layout.pose)
"""Names of the arrays of whole poses."""
ARRAYS = tuple(dict.fromkeys(name for layout in LAYOUTS for name in layout.arrays))
"""Names of all arrays of poses, translations and shapes."""
ALL_KEYS = frozenset((*ARRAYS, *RATES, *COLUMNS, LENGTHS, *SCALINGS, *MODELS, *_SOMA))
"""Names of everything that is read; all else in a file, such as meshes and pictures, is left unread."""


def spelled(key: object) -> str:
    """A name without its separators and capitals, so that `globalOrient` equals `global_orient`."""
    return str(key).replace("_", "").replace("-", "").lower()


_SPELLED = {spelled(name): name for name in sorted(ALL_KEYS)}
KNOWN_WORDS = tuple(_SPELLED)
COLUMN_WORDS = tuple(map(spelled, COLUMNS))
_POSES = tuple(spelled(layout.pose[0]) for layout in LAYOUTS)


def names_like(keys: Iterable[str | int]) -> Iterator[tuple[Layout, dict[str | int, str]]]:
    """Known names for those `keys` that are spelled differently or have a prefix, in every way that gives a pose.

    Trackers write `smpl_body_pose`, `globalOrient` and `Body-Pose`.
    """
    by_spelling = {spelled(key): key for key in keys}
    if not any(word.endswith(_POSES) for word in by_spelling):
        return
    for layout in LAYOUTS:
        first, *others = map(spelled, layout.pose)
        for word in by_spelling:
            before = word.removesuffix(first)
            if not word.endswith(first) or not all(before + other in by_spelling for other in others):
                continue
            known = {
                key: _SPELLED.get(word.removeprefix(before), _SPELLED.get(word)) for word, key in by_spelling.items()
            }
            known |= {by_spelling[before + spelled(name)]: name for name in layout.pose}
            renamed = {
                key: name for key, name in known.items() if name not in (None, key) and not _is_known(key, name, layout)
            }
            yield layout, renamed


def _is_known(key: str | int, name: str, layout: Layout) -> bool:
    """Whether a key is already one of the ways in which a name is spelled, as `frameRate` is."""
    return key in ALL_KEYS and spelled(key) == spelled(name) and name not in layout.pose


HUMANML_ADVICE = "fit SMPL to its joints, or give them as keypoints (docs/guide/inputs.md)"
UNREAD = {
    ("mhr_model_params", "body_pose_params", "lbs_model_params", "identity_coeffs"): "MHR (SAM 3D Body) parameters "
    "aren't read: save pred_keypoints_3d with them, which is read, or convert them with MHR's own tool",
    ("motion_feats", "new_joint_vecs"): f"HumanML3D features aren't read: {HUMANML_ADVICE}",
    ("dof", "dof_pos", "joint_vel", "qpos", "loop_mode", "skeleton_tree"): "the joints of robots and simulated figures "
    "aren't read: give the person's motion that they were retargeted from",
    ("J_regressor",): "a body model's parameters aren't read: it is who wears the garments, and no motion: give it as "
    "--body (in Python: body=)",
}
"""What to say of what is recognised but can't be read, by the names that give it away."""

WANTED = "a motion: .npz, .npy, .pkl, .pt of an estimator or archive, or .bvh (docs/guide/inputs.md lists them)"

JSON_ADVICE = "; save the arrays of EasyMocap's .json as .npz, as that page shows"


def accepted() -> str:
    """The names that a file may have its pose under, for a message."""
    return ", ".join(dict.fromkeys(" with ".join(one.pose) for one in LAYOUTS if "without" not in one.writers))
