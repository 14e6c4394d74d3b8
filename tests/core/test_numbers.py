"""Whatever takes numbers takes the same: real ones, in any type and layout, and nothing that a mask covers."""

from __future__ import annotations

import functools
import math
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import msg_adapters as adapters
from msg_adapters import BagError, EncodeError
from refu_core import GarmentPipeline, RefuError, SmplFrame, load_body
from refu_core.keypoints import KeypointTracker, Proportions, Skeleton, keypoint_layout
from refu_core.metrics import CollisionChecker, FoldBands
from refu_core.observation import Observer
from refu_core.outputs import Openings, PinholeCamera, PlannerMesh, Sigma, visible
from refu_core.realtime import PipelineOutput

WORN = "short-pant-male"
FRAME = SmplFrame(np.zeros((24, 3)), stamp_ns=1)


@functools.cache
def dressed() -> tuple[GarmentPipeline, PipelineOutput]:
    pipeline = GarmentPipeline.load([WORN])
    return pipeline, pipeline(FRAME)


@functools.cache
def observer() -> Observer:
    return Observer(dressed()[0])


@functools.cache
def skeleton() -> Skeleton:
    return Skeleton(keypoint_layout("smpl24"), Proportions.builtin("male"))


def _garment() -> np.ndarray:
    return dressed()[1][WORN].vertices


def _joints() -> np.ndarray:
    return load_body("male")(pose=np.zeros((1, 24, 3), np.float32)).joints[0].numpy()


def _openings() -> Openings:
    return Openings(dressed()[0].garments[WORN])


def _check(points: Any) -> int:
    pipeline, out = dressed()
    checker = CollisionChecker(pipeline.body.faces)
    checker.update(out.body)
    return len(checker.check(points, out[WORN].faces).pairs)


def _camera() -> PinholeCamera:
    return PinholeCamera.looking_at([0, 0.9, 0], [0.5, 1.4, 2])


def _markers(points: Any) -> bytes:
    mesh = adapters.MarkerMesh(WORN, dressed()[1][WORN].faces, len(_garment()), adapters.markers.CLOTH)
    return adapters.MarkerArrayEncoder([mesh], frame_id="map").encode([points], stamp_ns=0, transl=np.zeros(3))


TAKERS: dict[str, tuple[Callable[[], np.ndarray], Callable[[Any], Any]]] = {
    "a frame": (lambda: np.zeros((24, 3), np.float32), lambda pose: SmplFrame(pose).pose),
    "a body": (lambda: np.zeros((1, 24, 3), np.float32), lambda pose: load_body("male")(pose=pose).vertices.numpy()),
    "openings": (_garment, lambda points: next(iter(_openings().frames(points))).centre),
    "a planner": (_garment, lambda points: PlannerMesh(dressed()[0].garments[WORN]).solid(points)),
    "a camera": (_garment, lambda points: visible(points, dressed()[1][WORN].faces, _camera(), [])),
    "collisions": (_garment, _check),
    "an observer": (_garment, lambda points: (observer().reset(), observer()(FRAME, points))[1][WORN].vertices),
    "a tracker": (_joints, lambda points: KeypointTracker(skeleton()).update(points, stamp_ns=1).pose),  # type: ignore[union-attr]
    "sigma": (
        lambda: 1e-3 * np.tile(np.eye(3), (24, 1, 1)),
        lambda value: Sigma(dressed()[0])(FRAME, dressed()[1], pose_covariance=value)[WORN],
    ),
    "markers": (_garment, _markers),
    "bands of folds": (_garment, lambda points: FoldBands(dressed()[0].garments[WORN].mesh).split(points)),
}
each_taker = pytest.mark.parametrize(("given", "take"), TAKERS.values(), ids=TAKERS)


@each_taker
@pytest.mark.parametrize(
    "made",
    [
        lambda values: values + 0j,
        lambda values: values.astype(str),
        lambda values: values > 0,
        lambda values: values.astype("timedelta64[s]"),
        lambda values: np.array([values.tolist(), "x"], object),
    ],
    ids=["complex", "text", "booleans", "times", "mixed"],
)
def test_what_is_no_real_number_is_refused(
    given: Callable[[], np.ndarray], take: Callable[[Any], Any], made: Callable[[np.ndarray], Any]
) -> None:
    """NumPy makes numbers of them: imaginary parts were dropped with a warning, and a mask of a cloud was a cloud."""
    value = made(given())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(RefuError) as error:
            take(value)
    assert len(str(error.value)) <= 300


@pytest.mark.parametrize(("given", "take"), [one for name, one in TAKERS.items() if name != "a tracker"])
def test_what_a_mask_covers_is_not_taken_for_measured(
    given: Callable[[], np.ndarray], take: Callable[[Any], Any]
) -> None:
    """Depth cameras' points come as masked arrays; what lay beneath the mask was believed."""
    values = given()
    mask = np.zeros(values.shape, bool)
    mask.reshape(-1)[:3] = True
    with pytest.raises(RefuError):
        take(np.ma.MaskedArray(values, mask))
    same = np.ma.MaskedArray(values, np.zeros_like(mask))
    np.testing.assert_array_equal(take(same), take(values))


def test_keypoints_that_a_mask_covers_are_unseen() -> None:
    joints = _joints()
    wrong, unseen = joints.copy(), joints.copy()
    wrong[20], unseen[20] = 0.3, np.nan  # a wrist
    mask = np.zeros(joints.shape, bool)
    mask[20] = True
    every = (np.ma.MaskedArray(wrong, mask), unseen, wrong)
    taken, wanted, believed = (KeypointTracker(skeleton()).update(points, stamp_ns=1) for points in every)
    assert taken is not None
    assert wanted is not None
    assert believed is not None
    np.testing.assert_array_equal(taken.pose, wanted.pose)
    assert np.abs(taken.pose - believed.pose).max() > 0.01
    is_seen = np.arange(len(joints)) != 20
    told = KeypointTracker(skeleton()).update(wrong, stamp_ns=1, confidence=is_seen)
    assert told is not None
    np.testing.assert_array_equal(told.pose, wanted.pose)
    with pytest.raises(RefuError, match="requires grad"):
        KeypointTracker(skeleton()).update(torch.tensor(joints, requires_grad=True), stamp_ns=1)


@pytest.mark.parametrize("betas", [np.full(10, np.nan), np.zeros(16), "tall"])
def test_a_tracker_refuses_betas_that_are_none(betas: Any) -> None:
    with pytest.raises(RefuError, match="betas"):
        KeypointTracker(skeleton(), betas=betas)


@pytest.mark.parametrize(
    "value", [np.array([True, False]), np.array(["1", "2"]), np.ma.MaskedArray([1.0, 2.0], [0, 1])]
)
def test_points_of_a_message_are_numbers(value: Any) -> None:
    with pytest.raises(EncodeError):
        adapters.markers.finite_points("points", np.ma.stack([value] * 3, axis=1))


@pytest.mark.parametrize("kind", [np.int64, np.uint64, np.int32, float])
def test_times_may_be_of_any_whole_type(kind: type, tmp_path: Path) -> None:
    """A bag whose times came from NumPy lost its metadata when it was closed."""
    data = adapters.encoder_for("multiarray")(FRAME)
    for name, of in (("own", int), ("other", kind)):
        with adapters.BagWriter(tmp_path / name) as writer:
            writer.add_topic("/smpl_params", adapters.INPUT_TYPES["multiarray"])
            for k in range(3):
                writer.write("/smpl_params", data, log_time_ns=of(1000 + k))
    own, other = (
        [record.log_time_ns for record in adapters.iter_smpl_frames(tmp_path / name)] for name in ("own", "other")
    )
    assert own == other


@pytest.mark.parametrize("value", [0.5, math.nan, "now", None])
def test_times_that_are_none_are_refused(value: Any, tmp_path: Path) -> None:
    """Seconds became 0 ns in a message."""
    with pytest.raises(EncodeError, match="whole number of nanoseconds, got"):
        adapters.cdr.split_stamp(value)
    with adapters.BagWriter(tmp_path / "bag") as writer:
        writer.add_topic("/smpl_params", adapters.INPUT_TYPES["multiarray"])
        with pytest.raises(BagError, match="times are nanoseconds in"):
            writer.write("/smpl_params", b"", log_time_ns=value)


def test_a_clock_of_unsigned_numbers_may_go_back() -> None:
    """A hundredth of a second back was 584 years ahead, and the track began anew."""
    tracks = [KeypointTracker(skeleton()) for _ in range(2)]
    for stamp in (10**9, 10**9 + 33 * 10**6, 10**9 + 23 * 10**6, 10**9 + 66 * 10**6):
        joints = _joints() + 1e-10 * (stamp - 10**9)
        own, other = (
            track.update(joints, stamp_ns=kind(stamp)) for track, kind in zip(tracks, (int, np.uint64), strict=True)
        )
        assert own is not None
        assert other is not None
        np.testing.assert_array_equal(own.pose, other.pose)
        np.testing.assert_array_equal(own.transl, other.transl)
