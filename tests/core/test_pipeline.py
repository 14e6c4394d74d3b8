"""The garment pipeline from frame to vertices."""

from __future__ import annotations

import copy
import gc
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from refu_core import (
    FrameError,
    GarmentError,
    GarmentPipeline,
    RefuError,
    SmplFrame,
    Wearer,
    WeightsError,
    dress,
    load_body,
    load_garment,
)
from refu_core.errors import MeshError
from refu_core.metrics import CollisionChecker
from refu_core.realtime import SkinShift, within_promise
from refu_core.sdf import ExactSdf, Winding
from refu_core.simulation import posture


def frame(seed: int = 0, *, spread: float = 0.25, transl: tuple[float, float, float] = (0, 0, 0)) -> SmplFrame:
    rng = np.random.default_rng(seed)
    return SmplFrame(
        pose=rng.normal(0, spread, (24, 3)).astype(np.float32),
        betas=rng.normal(0, 0.7, 10).astype(np.float32),
        transl=np.array(transl, np.float64),
    )


@pytest.fixture(scope="module", params=[("skinned", "accurate"), ("tailornet", "hybrid")], ids="-".join)
def pipeline(request: pytest.FixtureRequest) -> GarmentPipeline:
    backbone, sdf = request.param
    return GarmentPipeline.load(["tshirt-male", "short-pant-male"], backbone=backbone, sdf=sdf)


def test_garments_and_bodies_of_double_precision_are_worn() -> None:
    exact = load_garment("short-pant-male", dtype=torch.float64), load_body("neutral", dtype=torch.float64)
    outputs = [
        GarmentPipeline.load([garment], body=body, sdf="none")(frame())["short-pant-male"].local
        for garment, body in (("short-pant-male", "neutral"), exact)
    ]
    np.testing.assert_array_equal(*outputs)


def test_what_comes_out(pipeline: GarmentPipeline) -> None:
    out = pipeline(frame(transl=(1, 2, 3)))
    assert list(out) == ["tshirt-male", "short-pant-male"]
    for name, mesh in out.items():
        assert mesh.vertices.shape == (pipeline.garments[name].n_vertices, 3)
        assert mesh.vertices.dtype == np.float64
        assert np.isfinite(mesh.vertices).all()
        np.testing.assert_allclose(mesh.vertices - [1, 2, 3], mesh.local, atol=1e-12)
        assert out.stats.garments[name].ms > 0
    assert set(out.stats.stage_ms) == {"body", "collider", "backbone", "sdf", "layers", "refu"}


def test_garments_are_pushed_to_the_margin_and_no_farther(pipeline: GarmentPipeline) -> None:
    out = pipeline(frame(1, spread=0.12))
    sdf = ExactSdf(pipeline.body.faces)
    sdf.update(torch.tensor(out.body))
    for name, mesh in out.items():
        before = sdf.query(torch.tensor(mesh.raw)).distance.numpy()
        after = sdf.query(torch.tensor(mesh.local)).distance.numpy()
        moved = np.linalg.norm(mesh.local - mesh.raw, axis=1)
        assert after.min() > 0, name
        clear = (before > 0.02) & (moved == 0)
        assert clear.any(), "what is far from the skin isn't touched"
        stats = out.stats.garments[name]
        if stats.n_layered:  # has left another garment before it left the body
            assert stats.n_inside <= (before < 0).sum()
            continue
        assert stats.n_inside == (before < 0).sum()
        assert moved.max() < 0.004 + 2 * max(0.0, -before.min()) + 0.01, "no vertex is thrown far out"


def crossed_arms() -> SmplFrame:
    """Forearms before the chest, one through the other."""
    pose = np.zeros((24, 3), np.float32)
    pose[16], pose[17] = (0, -0.9, -1.0), (0, 0.9, 1.0)
    pose[18], pose[19] = (0, -1.2, 0), (0, 1.2, 0)
    return SmplFrame(pose=pose, transl=np.array((1.0, 2.0, 3.0)))


@pytest.mark.parametrize("sdf", ["hybrid", "accurate", "none"])
def test_garments_are_brought_off_the_collider(sdf: str) -> None:
    """With a collider, what limbs have in common is room; without, garments are brought off the posed body as it is."""
    with_one = GarmentPipeline.load(["tshirt-male"], sdf=sdf)
    without = GarmentPipeline.load(["tshirt-male"], sdf=sdf, collider=False)
    assert with_one.outfit.collider is not None
    assert without.outfit.collider is None
    apart, through = with_one(crossed_arms()), without(crossed_arms())
    posed = with_one.body(pose=crossed_arms().pose[None]).vertices[0].numpy()
    np.testing.assert_allclose(apart.skin, posed, atol=2e-6)
    np.testing.assert_array_equal(through.body, through.skin)
    np.testing.assert_array_equal(through.skin, apart.skin)
    assert through.stats.shift == SkinShift(0, 0.0, 0.0)
    assert "collider" in apart.stats.stage_ms
    assert "collider" not in through.stats.stage_ms

    way = np.linalg.norm(apart.body - apart.skin, axis=1)
    shift = apart.stats.shift
    assert 0 < shift.n_moved < len(way) / 2, "limbs that touch give way, and nothing else"
    assert abs(shift.n_moved - (way > 1e-4).sum()) <= 5, "but for rounding"
    assert shift.largest == pytest.approx(way.max(), abs=2e-6)
    assert shift.mean == pytest.approx(way.mean(), abs=2e-6)
    taken_along = with_one.outfit.below["tshirt-male"](torch.from_numpy(apart.body - apart.skin)[None])[0].numpy()
    assert np.linalg.norm(taken_along, axis=1).max() > 0.005
    np.testing.assert_allclose(apart["tshirt-male"].raw, through["tshirt-male"].raw + taken_along, atol=2e-6)
    if sdf != "none":
        inside = Winding(with_one.body.faces)
        inside.update(torch.tensor(apart.body))
        found = inside(torch.tensor(apart["tshirt-male"].local)).count_nonzero()
        assert apart.stats.garments["tshirt-male"].n_unresolved == found, "certified by the collider"
        assert found == 0


@pytest.mark.parametrize("sdf", ["hybrid", "accurate"])
@pytest.mark.parametrize("garment", ["short-pant-male", "trousers-male", "trousers-female"])
def test_who_sits_has_no_skin_between_the_vertices_of_trousers(garment: str, sdf: str) -> None:
    """Where thighs are bent a fold of skin sticks out, narrower than the cloth's triangles."""
    pipeline = GarmentPipeline.load([garment], sdf=sdf)
    checker = CollisionChecker(pipeline.body.faces)
    out = pipeline(SmplFrame(pose=posture("sitting")))
    assert out.stats.within_promise
    checker.update(out.body)
    assert checker.check(out[garment].local, out[garment].faces).is_free


def test_nobody_can_write_in_what_others_get(pipeline: GarmentPipeline) -> None:
    frame = SmplFrame(pose=np.zeros((24, 3)))
    for out in (pipeline(frame), *pipeline([frame, frame])):
        mesh = next(iter(out.values()))
        for array in (mesh.local, mesh.raw, mesh.faces, mesh.vertices, out.body, out.skin):
            with pytest.raises(ValueError, match="read-only"):
                array[0] = 1
        assert mesh.vertices is mesh.vertices
        np.testing.assert_array_equal(mesh.vertices, mesh.local + mesh.transl)


def test_a_style_beyond_the_promise_is_not_promised() -> None:
    frame = SmplFrame(pose=np.zeros((24, 3)))
    assert within_promise(frame, [3, -3, 0, 0])
    assert not within_promise(frame, [0, 0, 0, -3.1])
    pipeline = GarmentPipeline.load(["tshirt-male"], backbone="skinned", style=[5, 0, 0, 0])
    assert not pipeline(frame).stats.within_promise
    assert pipeline(SmplFrame(pose=np.zeros((24, 3)), style=np.zeros(4))).stats.within_promise


def test_a_body_deeper_in_itself_than_flesh_gives_way_is_no_promised_one() -> None:
    """Arms that are lowered, and go on through the trunk: all joints are where people's are."""
    pipeline = GarmentPipeline.load(["tshirt-male"], sdf="accurate")
    n_held = []
    for angle in (*np.linspace(0.0, 1.62, 7), 1.7, 1.9):
        pose = np.zeros((24, 3))
        pose[16, 2], pose[17, 2] = -angle, angle
        frame = SmplFrame(pose=pose)
        assert within_promise(frame)
        out = pipeline(frame)
        stats = out.stats
        way = np.linalg.norm(out.body - out.skin, axis=1)
        assert stats.shift.n_held <= (way > 1e-4).sum()
        assert stats.within_promise is (stats.shift.n_held == 0)
        assert not stats.within_promise or stats.garments["tshirt-male"].n_unresolved == 0
        n_held.append(stats.shift.n_held)
    assert n_held[:7] == [0] * 7, "to hanging arms there is room, and those in a hip have gone aside"
    assert n_held[7] > 0
    assert n_held[8] > 0, "it stays said where an arm has gone aside as far as it may"


def test_without_signed_distance_the_raw_backbone_comes_out() -> None:
    out = GarmentPipeline.load(["tshirt-male"], sdf="none")(frame(2))
    np.testing.assert_array_equal(out["tshirt-male"].local, out["tshirt-male"].raw)


def test_a_batch_is_what_single_persons_are(pipeline: GarmentPipeline) -> None:
    frames = [frame(3), frame(4, transl=(5, 0, 0)), frame(5)]
    batch = pipeline(frames)
    assert len(batch) == 3
    for together, one in zip(batch, frames, strict=True):
        alone = pipeline(one)
        for name, mesh in alone.items():
            np.testing.assert_allclose(together[name].raw, mesh.raw, atol=1e-5)
            assert_same(together[name].local, mesh.local)
    assert pipeline([]) == []


def assert_same(a: np.ndarray, b: np.ndarray) -> None:
    """The same garment but for rounding; where it decides whether a vertex is pushed, the push is within the margin."""
    distance = np.linalg.norm(a - b, axis=1)
    assert (distance < 1e-4).mean() > 0.99
    assert distance.max() < 0.004


@pytest.mark.parametrize(
    ("backbone", "sdf", "turn"),
    [
        ("skinned", "accurate", (0.4, -1.9, 0.7)),
        ("tailornet", "hybrid", (0.4, -1.9, 0.7)),
        ("tailornet", "hybrid", (np.pi, 0, 0)),  # a camera's axes
    ],
)
def test_turning_the_person_turns_the_garments(backbone: str, sdf: str, turn: tuple[float, ...]) -> None:
    pipeline = GarmentPipeline.load(["skirt-female"], backbone=backbone, sdf=sdf)
    here = frame(6, spread=0.1)
    rotation = Rotation.from_rotvec(turn)
    pose = np.array(here.pose)
    pose[0] = (rotation * Rotation.from_rotvec(pose[0])).as_rotvec()
    there = SmplFrame(pose=pose, betas=here.betas, up=rotation.apply([0, 2, 0]))
    root = pipeline.body.rest_joints(torch.tensor(here.betas)[None])[0, 0].numpy()
    turned = pipeline(there)
    for name, mesh in pipeline(here).items():
        np.testing.assert_allclose(rotation.apply(mesh.raw - root) + root, turned[name].raw, atol=1e-4)
        assert_same(rotation.apply(mesh.local - root) + root, turned[name].local)


def test_far_from_the_origin_nothing_changes(pipeline: GarmentPipeline) -> None:
    near, far = pipeline(frame(7)), pipeline(frame(7, transl=(1e5, -2e5, 3e5)))
    for name, mesh in near.items():
        np.testing.assert_allclose(far[name].vertices - [1e5, -2e5, 3e5], mesh.vertices, atol=1e-9)


@pytest.mark.parametrize("sdf", ["accurate", "hybrid"])
def test_the_same_frame_gives_the_same_bits(sdf: str) -> None:
    pipeline = GarmentPipeline.load(["short-pant-male"], sdf=sdf, backbone="skinned")
    one = pipeline(frame(8))
    pipeline(frame(9))  # what came between leaves no trace
    two = pipeline(frame(8))
    for name, mesh in one.items():
        assert mesh.local is not two[name].local
        np.testing.assert_array_equal(mesh.local, two[name].local)


def test_an_unchanged_pose_keeps_its_garments_wherever_it_is(pipeline: GarmentPipeline) -> None:
    first, other = pipeline([frame(20), frame(21)])
    moved, still, new = pipeline([frame(21, transl=(1, 2, 3)), frame(20), frame(22)])
    assert moved.stats.skipped == still.stats.skipped == {"unchanged": 1}
    assert "unchanged" not in new.stats.skipped
    assert set(moved.stats.stage_ms) == set(new.stats.stage_ms)
    for name in first:
        assert still[name].local is first[name].local
        assert moved[name].local is other[name].local
        np.testing.assert_array_equal(moved[name].vertices, other[name].local + np.array([1.0, 2, 3]))
    assert "unchanged" in pipeline(frame(22)).stats.skipped
    assert "unchanged" not in pipeline(frame(21)).stats.skipped, "only the last frame is kept"
    styled = SmplFrame(pose=frame(21).pose, betas=frame(21).betas, style=np.zeros(4, np.float32))
    assert "unchanged" not in pipeline(styled).stats.skipped


def test_two_persons_of_one_pose_in_one_frame(pipeline: GarmentPipeline) -> None:
    here, there = pipeline([frame(23), frame(23, transl=(0, 0, 4))])
    for name in here:
        np.testing.assert_array_equal(there[name].local, here[name].local)
        np.testing.assert_array_equal(there[name].transl - here[name].transl, [0, 0, 4])


@pytest.mark.parametrize(("sdf", "skips"), [("accurate", ["band", "rest"]), ("hybrid", ["rest"])])
def test_what_is_skipped_changes_nothing(sdf: str, skips: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Within 0.1 mm: the same distances, but for rounding, and the resolution goes on from there."""
    names = ["tshirt-male", "short-pant-male"]
    fast = GarmentPipeline.load(names, sdf=sdf, backbone="skinned")
    monkeypatch.setattr("refu_core.realtime._contact.exact_sdf", lambda body: ExactSdf(body.faces))
    slow = GarmentPipeline.load(names, sdf=sdf, backbone="skinned")
    for k in range(6):
        posed = SmplFrame(pose=frame(30 + k, spread=0.15).pose, betas=frame(30 + k // 3).betas)
        slow._wearers.clear()
        one, other = fast(posed), slow(posed)
        for skip in skips:
            assert (one.stats.skipped.get(skip, 0) > 0) == (skip == "band" or k % 3 > 0)
            assert not other.stats.skipped.get(skip)
        for name, mesh in one.items():
            np.testing.assert_array_equal(mesh.raw, other[name].raw)
            np.testing.assert_allclose(mesh.local, other[name].local, atol=1e-4)


def test_garments_of_one_style_keep_it() -> None:
    plain = GarmentPipeline.load(["tshirt-female"], sdf="none")
    given = frame(3)
    styled = plain(replace(given, style=np.ones(4)))["tshirt-female"].vertices
    np.testing.assert_array_equal(styled, plain(given)["tshirt-female"].vertices)


@pytest.mark.parametrize(
    ("garments", "options", "error", "wanted"),
    [
        ([], {}, GarmentError, "name at least one"),
        (["kilt"], {}, GarmentError, "no garment 'kilt'"),
        (["tshirt-male", "skirt-female"], {}, GarmentError, r"tshirt-male \(male\), skirt-female \(female\)"),
        (["tshirt-male"], {"sdf": "exact"}, RefuError, "no sdf mode 'exact': wanted hybrid, approx, accurate, none"),
        (["tshirt-male"], {"backbone": "resnet"}, WeightsError, "no backbone 'resnet'"),
        (["tshirt-male"], {"margin": -1}, RefuError, "margin must be between"),
        (["tshirt-male"], {"margin": float("nan")}, RefuError, "margin must be between"),
        (["tshirt-male"], {"device": "quantum"}, RefuError, "no device 'quantum'"),
        (["tshirt-male"], {"style": [1, 2]}, GarmentError, r"style must have the shape \(4,\), got \(2,\)"),
        (["tshirt-male"], {"style": [1e9] * 4}, GarmentError, "style has magnitudes up to 1e.09, wanted 100 at most"),
        (["tshirt-male"], {"style": torch.zeros(4, requires_grad=True)}, GarmentError, "style must be .* got Tensor"),
        (["tshirt-male"], {"contact": None}, RefuError, "wanted ContactSettings, got NoneType"),
        (["tshirt-male"], {"weights": 5}, WeightsError, "wanted a folder of weights, got int"),
        (np.array(["tshirt-male", "kilt"]), {}, GarmentError, "no garment .*'kilt'"),
    ],
)
def test_bad_options_are_named(garments: list[str], options: dict[str, object], error: type, wanted: str) -> None:
    with pytest.raises(error, match=wanted):
        GarmentPipeline.load(garments, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("values", "wanted"),
    [
        ({"pose": np.zeros((23, 3))}, r"pose must have the shape \(24, 3\)"),
        ({"pose": np.zeros(66)}, r"got \(66,\): the 22 joints of a body without hands: append 6 zeros"),
        ({"pose": np.zeros((55, 3))}, r"got \(55, 3\): SMPL-X: take the first 66, and append 6 zeros"),
        ({"pose": np.zeros((24, 3, 3))}, r"as matrices\? scipy's Rotation.from_matrix\(R\).as_rotvec\(\)"),
        ({"pose": np.full(72, np.nan)}, "pose has 72 values that are NaN or infinite"),
        ({"pose": "standing"}, "pose must be"),
        ({"pose": [10**400] * 72}, "pose must be .* numbers, got list: int too large"),
        ({"pose": np.zeros(72), "betas": np.zeros(9)}, r"betas must have the shape \(10,\)"),
        ({"pose": np.zeros(72), "transl": [0, np.inf, 0]}, "transl has 1 value that is NaN or infinite"),
        ({"pose": np.zeros(72), "up": np.zeros(3)}, "up must be a direction"),
        ({"pose": np.full(72, 1e300)}, "beyond the range of float32"),
        ({"pose": np.zeros(72, complex)}, "pose must be .* numbers, got ndarray: values of the type complex128"),
        ({"pose": np.zeros(72, bool)}, "values of the type bool"),
        ({"pose": ["1"] * 72}, "values of the type <U1"),
        ({"pose": np.zeros(72, "M8[ns]")}, "values of the type datetime64"),
        ({"pose": np.ma.masked_less(np.arange(72.0), 3)}, "pose has 3 values that are NaN"),
    ],
)
def test_bad_frames_are_named(values: dict[str, object], wanted: str) -> None:
    with pytest.raises(FrameError, match=wanted):
        SmplFrame(**values)  # type: ignore[arg-type]


def test_a_body_that_its_shape_turns_inside_out_is_refused_whatever_came_before(pipeline: GarmentPipeline) -> None:
    pipeline(frame())
    inside_out = SmplFrame(pose=np.zeros((24, 3)), betas=np.full(10, -50.0))
    with pytest.raises(MeshError, match="negative volume"):
        pipeline(inside_out)
    assert np.isfinite(pipeline(frame())["tshirt-male"].vertices).all()


def test_frames_own_their_data() -> None:
    pose = np.zeros((24, 3), np.float32)
    made = SmplFrame(pose=pose)
    pose[:] = 1
    assert not made.pose.any()
    with pytest.raises(ValueError, match="read-only"):
        made.pose[0] = 1


def test_the_readme_example_runs(capsys: pytest.CaptureFixture[str]) -> None:
    readme = (Path(__file__).parents[2] / "README.md").read_text(encoding="utf-8")
    code = readme.split("```python\n")[1].split("```")[0]
    exec(compile(code, "README.md", "exec"), {})
    garment, body = capsys.readouterr().out.splitlines()
    assert garment.startswith(f"({load_garment('tshirt-male').n_vertices}, 3)")
    assert body == f"torch.Size([1, {load_body('male').n_vertices}, 3])"


@pytest.mark.parametrize("sdf", ["approx", "accurate"])
def test_a_pipeline_that_nobody_needs_leaves_no_memory_behind(sdf: str) -> None:
    """Python looks for rings seldom, and counts objects, not bytes: nothing large may be in one."""
    name = "tshirt-male"
    GarmentPipeline.load([name], backbone="skinned", sdf=sdf)(SmplFrame(np.zeros((24, 3))))  # what is loaded once
    gc.collect()
    gc.set_debug(gc.DEBUG_SAVEALL)
    try:
        GarmentPipeline.load([name], backbone="skinned", sdf=sdf)(SmplFrame(np.zeros((24, 3))))
        gc.collect()
        left = sum(ring.nbytes for ring in gc.garbage if isinstance(ring, (np.ndarray, torch.Tensor)))
    finally:
        gc.set_debug(0)
        gc.garbage.clear()
    assert left < 1000


def test_what_a_newcomer_types_answers_in_a_line(pipeline: GarmentPipeline) -> None:
    output = pipeline(SmplFrame(pose=np.zeros((24, 3))))
    with pytest.raises(KeyError, match="no garment 'tshirt': this person wears"):
        output["tshirt"]
    assert "tshirt" not in output
    shown = (pipeline, output, next(iter(output.values())), output.stats, pipeline.outfit, *pipeline.garments.values())
    for one in (*shown, SmplFrame(pose=np.zeros((24, 3)), transl=np.full(3, 1 / 3))):
        assert len(repr(one).splitlines()) == 1
        assert len(repr(one)) < 200


def test_copies_of_a_frame_are_as_safe_as_it_is() -> None:
    frame = SmplFrame(pose=np.ones(72, np.float16), betas=range(10), transl=np.zeros(3, np.longdouble))
    for other in (pickle.loads(pickle.dumps(frame)), copy.copy(frame), copy.deepcopy(frame), replace(frame)):
        np.testing.assert_array_equal(other.pose, frame.pose)
        for array in (other.pose, other.betas, other.transl):
            with pytest.raises(ValueError, match="read-only"):
                array[:] = np.nan


def test_what_was_returned_travels_between_processes(pipeline: GarmentPipeline) -> None:
    output = pipeline(SmplFrame(pose=np.zeros(72), transl=[0, 1, 0]))
    for other in (pickle.loads(pickle.dumps(output)), copy.deepcopy(output)):
        np.testing.assert_array_equal(other.body, output.body)
        np.testing.assert_array_equal(other.skin, output.skin)
        for name, mesh in output.items():
            np.testing.assert_array_equal(other[name].vertices, mesh.vertices)
            np.testing.assert_array_equal(other[name].raw, mesh.raw)
        assert other.stats == output.stats
    with pytest.raises(ValueError, match="read-only"):  # all frames share them
        next(iter(output.values())).faces[0] = 0


@pytest.mark.parametrize(
    ("pose", "betas", "style", "wanted"),
    [
        (torch.zeros(24, 3), torch.zeros(1, 10), None, r"pose must be torch.float32 of the shape \(1, 24, 3\)"),
        (torch.zeros(3, 24, 3), torch.zeros(2, 10), None, r"pose .* \(2, 24, 3\), got .* \(3, 24, 3\)"),
        (torch.zeros(1, 24, 3).double(), torch.zeros(1, 10), None, "got torch.float64"),
        (torch.zeros(1, 24, 3), torch.zeros(10), None, r"betas must be torch.float32 of the shape \(B, 10\)"),
        (torch.zeros(1, 24, 3), torch.zeros(1, 300), None, r"betas .* got .* \(1, 300\)"),
        (torch.zeros(3, 24, 3), torch.zeros(3, 10), torch.zeros(2, 4), r"style .* \(1 or 3, 4\), got .* \(2, 4\)"),
        (torch.zeros(1, 24, 3), torch.zeros(1, 10), np.zeros((1, 4)), "style as a torch.Tensor"),
    ],
)
def test_tensors_of_other_shapes_are_named(
    pipeline: GarmentPipeline, pose: Tensor, betas: Tensor, style: Tensor, wanted: str
) -> None:
    with pytest.raises(FrameError, match=wanted):
        dress(pose, Wearer.of(pipeline.outfit, betas, style))
    with pytest.raises(FrameError, match="wanted a Wearer"):
        dress(pose, None)  # type: ignore[arg-type]


def test_one_style_is_that_of_everybody(pipeline: GarmentPipeline) -> None:
    two = Wearer.of(pipeline.outfit, torch.zeros(2, 10), torch.zeros(1, 4))
    assert {len(tensor) for tensor in Wearer.together([two, two]).tensors().values()} == {4}


def test_a_processor_has_no_number_and_no_other_name() -> None:
    assert GarmentPipeline.load("tshirt-male", device="cpu:0").body.device == torch.device("cpu")
    with pytest.raises(RefuError, match="no device 'gpu': wanted cpu or cuda"):
        load_body("male", device="gpu")


def test_a_number_of_threads_is_one_that_can_be_had() -> None:
    assert GarmentPipeline.load("tshirt-male", threads=np.int64(2)).threads == 2  # type: ignore[arg-type]
    for wrong in (0, 10**6):
        with pytest.raises(RefuError, match=f"wanted 1 to 256 threads, got {wrong}"):
            GarmentPipeline.load("tshirt-male", threads=wrong)
