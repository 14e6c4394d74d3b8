"""The tables of the reproduction, made from emulated networks on made-up samples, against loops written anew."""

from __future__ import annotations

import functools
import json
import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

import fcl
import igl
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from torch import Tensor

from msg_adapters import Motion
from refu_core import GarmentPipeline, PoseHistory
from refu_core.backbones import Skinned, WithoutWearerCode
from refu_core.body import Collider, load_body
from refu_core.errors import RefuError, WeightsError
from refu_core.garments import PAPER_GARMENTS, GarmentTemplate, SkinBelow, load_garment
from refu_core.modes import DEFAULT_GARMENTS
from refu_core.realtime import Wearable
from refu_core.refu import SCALE_PRESETS, Refu
from refu_lab.cli import _parser
from refu_lab.commands.evaluate import EvaluateOptions
from refu_lab.reproduction import _build, _evaluate, _methods, _motion, _plots, _runs, _sdf, _tables
from refu_lab.tables import RESULT_TABLES

GARMENT = "short-pant-male"
TEST_COUNTS = {"shirt-male": 3197, "tshirt-male": 2688, "short-pant-male": 2691, "skirt-female": 3525}
"""The paper's test samples a garment (Table 1)."""
N_SAMPLES = 3


# ---- the paper's figures ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("metric", ["mpve_mm", "vfcp_percent", "cfmp_percent"])
def test_the_papers_means_follow_from_its_garments(metric: str) -> None:
    """Guards the transcription: the paper's "All Garments" are means weighted by its test counts."""
    methods = {key[2] for key in _tables.PAPER if key[0] == "comparison"}
    assert len(methods) == 10
    for method in methods:
        total = 0.0
        for garment, count in TEST_COUNTS.items():
            total += _tables.PAPER["comparison", garment, method, metric] * count / sum(TEST_COUNTS.values())
        assert _tables.PAPER["comparison", "all", method, metric] == pytest.approx(total, abs=0.02), method


def test_the_papers_trend_is_computed_anew() -> None:
    assert _tables.paper_figure("comparison", "all", "refu-hybrid", "vfcp_percent_trend") == pytest.approx(-60)
    assert _tables.paper_figure("comparison", "all", "refu-hybrid", "cfmp_percent_trend") == pytest.approx(
        39.97, abs=0.01
    )
    assert _tables.paper_figure("comparison", "all", "node-hybrid", "cfmp_percent_trend") is None
    assert _tables.paper_figure("gcnn", "skirt-female", "gcnn", "mpve_mm") == 14.05  # garment not named by the paper
    assert _tables.paper_figure("laplacian", "tshirt-male", "refu-hybrid", "laplacian_mm") is None


def test_every_figure_of_the_paper_stands_beside_a_method_of_ours() -> None:
    built = {name: set(spec.methods) for name, spec in _build.SAMPLE_TABLES.items()}
    assert set().union(*built.values(), _build.TIMED_METHODS) <= set(_methods.METHODS)
    built["time"] = set(_build._COMPONENTS)
    built["sdf"] = {"neural"}
    for table, _, method, metric in _tables.PAPER:
        assert method in built[table], (table, method)
        assert metric in _tables.METRICS
    assert set(_build.SAMPLE_TABLES) | {"time", "sdf", "postures", "motion"} == set(RESULT_TABLES)


def test_commands_that_pages_name_can_be_given() -> None:
    weights = (Path("mine"), Path("yours, too"))
    command = _evaluate._command(EvaluateOptions(data=(Path("a/set"),), weights=weights, collider=False), "parts")
    given = _parser().parse_args(shlex.split(command)[1:])
    assert (given.table, given.collider, tuple(given.weights)) == ("parts", False, weights)
    for method in _methods.METHODS.values():
        if command := method.train_command(GARMENT):
            assert f"{_parser().parse_args(command.split()[1:]).output}/".startswith(f"weights/{GARMENT}/")


# ---- emulated networks -----------------------------------------------------------------------------------------------


class Noisy(WithoutWearerCode):
    """A backbone that is wrong by a smooth wave that depends on the pose, into the body in places."""

    def __init__(self, garment: GarmentTemplate, amplitude: float) -> None:
        self.garment, self.amplitude = garment, amplitude

    def __call__(
        self,
        betas: Tensor,  # noqa: ARG002
        pose: Tensor,
        style: Tensor | None,  # noqa: ARG002
        *,
        wearer_code: Tensor | None = None,  # noqa: ARG002
    ) -> torch.Tensor:
        x = self.garment.v_template
        wave = torch.sin(25 * x.sum(-1) + 3 * pose.sum())
        return self.amplitude * wave[None, :, None] * torch.tensor([1.0, 0.0, 1.0])


class Emulated(_methods.Library):
    """Weights of the T-shirt's place that were never trained; some are missing."""

    def __init__(self, *, without: tuple[str, ...] = ()) -> None:
        super().__init__()
        self.without = without

    def load(self, method: _methods.Method, garment: str) -> Wearable:
        if method.name in self.without:
            msg = "not trained"
            raise WeightsError(msg)
        torch.manual_seed(0)
        amplitude = 0.006 if method.mode == "none" else 0.005
        scale = None if method.folder == "fixed" else SCALE_PRESETS["realtime"]
        least = 1.0 if method.sdf == "accurate" else 0.0
        template = load_garment(garment)
        refu = Refu(template.n_vertices, least=least, scale=scale).eval().requires_grad_(False)
        return Wearable(template, Noisy(template, amplitude), refu if method.handling == "refu" else None, 0.0)


@pytest.fixture(scope="module")
def samples() -> _runs.SampleSet:
    """Bodies that sit and lean, in garments that are the skinned template, moved a little."""
    garment, body = load_garment(GARMENT), load_body("male")
    rng = np.random.default_rng(3)
    made = []
    for k in range(N_SAMPLES):
        pose = np.zeros((24, 3), np.float32)
        pose[1, 0], pose[2, 0], pose[1, 2] = -0.3 * k, 0.2 * k, 0.15
        betas, style = rng.normal(size=10).astype(np.float32), (0.3 * rng.normal(size=4)).astype(np.float32)
        posed = body(pose[None], betas[None])
        rest = garment.rest(torch.from_numpy(betas)[None], torch.from_numpy(style)[None])
        truth = garment.pose(rest + 0.003, posed.transforms)[0].numpy()
        made.append(_runs.Sample(truth, pose, betas, style, 1.0 + k))
    return _runs.SampleSet(GARMENT, N_SAMPLES, None, made.__getitem__)


METHODS = (
    "tailornet",
    "naive-accurate",
    "optimisation-accurate",
    "refu-accurate",
    "refu-hybrid",
    "fixed-accurate-bare",
)


@pytest.fixture(scope="module")
def study(samples: _runs.SampleSet) -> _runs.Study:
    study = _runs.Study()
    _runs.run_methods(
        study, samples, (*METHODS, "collision-loss-approx"), library=Emulated(without=("collision-loss-approx",))
    )
    return study


def fcl_pairs(garment: NDArray[Any], faces: NDArray[Any], body: NDArray[Any], body_faces: NDArray[Any]) -> int:
    def model(vertices: NDArray[Any], triangles: NDArray[Any]) -> fcl.CollisionObject:
        bvh = fcl.BVHModel()
        bvh.beginModel(len(vertices), len(triangles))
        bvh.addSubModel(vertices.astype(np.float64), triangles.astype(np.int64))
        bvh.endModel()
        return fcl.CollisionObject(bvh, fcl.Transform())

    request = fcl.CollisionRequest(num_max_contacts=1_000_000, enable_contact=True)
    return int(fcl.collide(model(garment, faces), model(body, body_faces), request, fcl.CollisionResult()))


def test_figures_of_the_baseline_against_a_loop_of_other_libraries(
    study: _runs.Study, samples: _runs.SampleSet
) -> None:
    """MPVE, VFCP and CFMP of the emulated backbone, from its definition, libigl and fcl alone."""
    garment, body = load_garment(GARMENT), load_body("male")
    backbone, collider = Noisy(garment, 0.006), Collider(body)
    errors, inside, free = [], [], []
    for k in range(N_SAMPLES):
        sample = samples.read(k)
        pose, betas, style = (torch.from_numpy(a)[None] for a in (sample.pose, sample.betas, sample.style))
        posed = body(pose, betas)
        unposed = garment.rest(betas, style) + backbone(betas, pose, style)
        apart = collider(posed.vertices, posed.transforms)
        taken = garment.pose(unposed, posed.transforms) + SkinBelow.of(garment, body)(apart - posed.vertices)
        mine, skin, skin_faces = taken[0].numpy().astype(float), apart[0].numpy().astype(float), body.faces.numpy()
        errors.append(
            np.mean([np.linalg.norm(a - b) for a, b in zip(mine, sample.vertices.astype(float), strict=True)])
        )
        inside.append(np.mean(igl.fast_winding_number(skin, skin_faces, mine) > 0.5))
        free.append(not inside[-1] and not fcl_pairs(mine, garment.faces.numpy(), skin, skin_faces))
    figures = study.runs[GARMENT, "tailornet"].figures
    assert figures.n_frames == N_SAMPLES
    assert figures.mpve_mm == pytest.approx(1000 * np.mean(errors), rel=1e-4)
    assert figures.vfcp_percent == pytest.approx(100 * np.mean(inside), rel=1e-6)
    assert figures.cfmp_percent == pytest.approx(100 * np.mean(free))
    assert figures.vfcp_percent > 0


def test_methods_do_what_their_names_say(study: _runs.Study) -> None:
    figures = {method: study.runs[GARMENT, method].figures for method in METHODS}
    for method in ("naive-accurate", "refu-accurate", "optimisation-accurate"):
        assert figures[method].vfcp_percent < 0.2 * figures["tailornet"].vfcp_percent, method
    # α >= 1 and a margin: no vertex stays inside, and no edge cuts a corner that ε = 0 leaves.
    assert figures["refu-accurate"].vfcp_percent == 0
    assert figures["refu-accurate"].avg_ee < figures["fixed-accurate-bare"].avg_ee
    assert set(study.runs[GARMENT, "refu-hybrid"].samples[0].ms) == {"backbone", "sdf", "refu"}
    assert study.runs[GARMENT, "optimisation-accurate"].median_ms("post-process") > 0
    assert study.runs[GARMENT, "tailornet"].median_ms("refu") is None
    # Only vertices that the backbone left inside are in the Laplacian error.
    assert figures["tailornet"].laplacian_mm is not None


def test_what_is_not_trained_says_so_in_its_row(study: _runs.Study, tmp_path: Path) -> None:
    table = _build.sample_table(study, "comparison")
    assert table.value(GARMENT, "collision-loss-approx", "mpve_mm") is None
    assert table.value(GARMENT, "refu-hybrid", "vfcp_percent") is not None
    page = "\n".join(table.markdown(source=""))
    assert "| collision loss, approx (not measured) | – | *6.79* |" in page
    command = "refu train short-pant-male --data DIR --backbone tailornet --mode collision-approx"
    assert f"`{command} --output weights/short-pant-male`" in page
    assert "| ReFU, hybrid | " in page
    change = table.value(GARMENT, "refu-hybrid", "mpve_mm_trend")
    a, b = (table.value(GARMENT, m, "mpve_mm") for m in ("refu-hybrid", "tailornet"))
    assert change == pytest.approx(100 * (a / b - 1))
    path = table.write(tmp_path, command="refu evaluate", n_samples=study.n_samples)
    assert path.read_text(encoding="utf-8").startswith("# Comparison")
    rows = json.loads((tmp_path / "comparison.json").read_text(encoding="utf-8"))["rows"]
    assert {tuple(row) for row in rows} == {("table", "garment", "method", "metric", "value", "paper")}
    again = _tables.read_table(tmp_path, "comparison")
    assert again is not None
    assert (again.rows, again.missing) == (table.rows, table.missing)
    summary = _tables.write_summary(tmp_path).read_text(encoding="utf-8")
    assert "](comparison.md)" in summary
    assert "not made yet: `refu evaluate --table sdf`" in summary
    assert "| ReFU, accurate | " in summary
    (tmp_path / "comparison.json").write_text("[]", encoding="utf-8")
    with pytest.raises(RefuError, match="not results of refu evaluate"):
        _tables.read_table(tmp_path, "comparison")


def test_all_tables_and_plots_of_a_study(study: _runs.Study, tmp_path: Path) -> None:
    for name in (*_build.SAMPLE_TABLES, "time"):
        table = _build.time_table(study) if name == "time" else _build.sample_table(study, name)
        assert table.rows, name
        assert all(row.table == name for row in table.rows)
        table.write(tmp_path, command="refu evaluate", n_samples=study.n_samples)
        for file, _ in _plots.PLOTS[name](study, tmp_path) if name in _plots.PLOTS else []:
            assert (tmp_path / file).read_bytes().startswith(b"<?xml")
    assert {path.name for path in tmp_path.iterdir()} >= {"energy.svg", "energy_zoom.svg", "scale.svg"}


def test_plots_of_the_same_figures_are_the_same_files(study: _runs.Study, tmp_path: Path) -> None:
    contents = []
    for _ in range(2):
        _plots.PLOTS["energy"](study, tmp_path)
        contents.append((tmp_path / "energy.svg").read_bytes())
    assert contents[0] == contents[1]


@pytest.mark.usefixtures("little_light")
def test_pictures(
    study: _runs.Study, samples: _runs.SampleSet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_plots, "_SHOT", (60, 80))
    ((file, caption),) = _plots.picture_garments(study, [samples], tmp_path, library=Emulated())
    assert (tmp_path / file).read_bytes().startswith(b"\x89PNG")
    assert "ReFU, hybrid" in caption


# ---- sums ------------------------------------------------------------------------------------------------------------


@given(
    st.lists(st.tuples(st.floats(-1e3, 1e3) | st.none(), st.integers(0, 500)), max_size=6),
)
def test_weighted_mean_equals_the_mean_over_single_samples(pairs: list[tuple[float | None, int]]) -> None:
    single = [value for value, count in pairs for _ in range(count)]
    found = _tables.weighted(pairs)
    if not single or any(value is None for value, _ in pairs):
        assert found is None
    else:
        assert found == pytest.approx(np.mean(single), abs=1e-6)


@given(seed=st.integers(0, 2**31))
def test_scales_by_ratio_equal_a_loop(seed: int) -> None:
    rng = np.random.default_rng(seed)
    accurate, approx, alpha = rng.normal(-0.005, 0.01, 60), rng.normal(-0.005, 0.01, 60), rng.uniform(0, 3, 60)
    tensors = [torch.from_numpy(a) for a in (alpha, approx, accurate)]
    count, total = _runs.scales_by_ratio(_runs.MethodOutput(torch.zeros(0, 3), {}, *tensors))
    edges = _runs.RATIO_EDGES
    for k in range(len(edges) - 1):
        members = [
            a for a, f, s in zip(alpha, approx, accurate, strict=True) if f < 0 > s and edges[k] <= f / s < edges[k + 1]
        ]
        assert count[k] == len(members)
        assert total[k] == pytest.approx(sum(members))


def test_unseen_groups_are_as_large_as_each_other_and_sorted(study: _runs.Study) -> None:
    run = study.runs[GARMENT, "tailornet"]
    assert [[float(d) for d in distance] for distance, _ in _build.unseen_groups(run)] == [[1.0], [2.0], [3.0]]
    values = _build.SAMPLE_TABLES["unseen"].of(run)
    assert list(values) == [f"error [mm] at {d:.2f} to {d:.2f}" for d in (1, 2, 3)]
    assert list(values.values()) == pytest.approx(run.values("collision_error_mm"))
    unknown = _runs.MethodRun(run.method, [one._replace(unseen=float("nan")) for one in run.samples])
    assert _build.unseen_groups(unknown) == []


# ---- the other tables ------------------------------------------------------------------------------------------------


def test_distance_table(samples: _runs.SampleSet) -> None:
    table = _sdf.sdf_table([samples], library=_methods.Library())
    assert table.value(GARMENT, "approx", "mean_absolute_mm") < 2
    assert table.value(GARMENT, "approx, within 2 cm", "missed_percent") < 2
    assert table.value(GARMENT, "approx, within 2 cm", "p99_mm") < 1
    assert table.value(GARMENT, "approx, within 2 cm", "hidden_percent") == 0
    for pose in ("squat", "crossed arms", "hands on hips"):
        assert 0 < table.value(GARMENT, f"approx, {pose}", "mean_absolute_mm") < 2
    assert table.value(GARMENT, "neural", "mean_absolute_mm") is None
    assert [(m.method, m.reason) for m in table.missing] == [("neural", "not trained")]
    assert next(row.paper for row in table.rows if row.method == "neural") == 2.46


def test_distance_table_of_a_garment_of_one_style() -> None:
    name, body = "tshirt-neutral", load_body("neutral")
    assert load_garment(name).styledirs is None
    pose, betas, style = np.zeros((24, 3), np.float32), np.zeros(10, np.float32), np.zeros(4, np.float32)
    posed = body(torch.from_numpy(pose)[None]).transforms
    vertices = load_garment(name).pose(load_garment(name).v_template[None], posed)[0].numpy()
    sample = _runs.Sample(vertices, pose, betas, style, float("nan"))
    table = _sdf.sdf_table([_runs.SampleSet(name, 1, None, lambda _: sample)], library=_methods.Library())
    assert table.value(name, "approx", "mean_absolute_mm") < 2


def test_sequence_table_has_both_numbers_of_shapes(samples: _runs.SampleSet) -> None:
    study = _runs.Study()
    _runs.run_methods(study, samples, ("mlp-5", "mlp-5-refu-approx"), library=Emulated())
    table = _build.sample_table(study, "sequence")
    assert [row.paper for row in table.rows if row.metric == "cfmp_percent"] == [18.69, 52.53, 13.30, 38.39]
    assert table.value(GARMENT, "mlp-5", "mpve_mm") == study.runs[GARMENT, "mlp-5"].figures.mpve_mm
    assert {m.method: m.reason for m in table.missing} == dict.fromkeys(
        ("mlp-17", "mlp-17-refu-approx"), "no set of 17 shapes was given"
    )


def test_two_garments_are_weighted_by_their_samples(study: _runs.Study) -> None:
    both = _runs.Study(dict(study.runs), dict(study.missing), {GARMENT: N_SAMPLES, "shirt-male": 2 * N_SAMPLES})
    for method in METHODS:
        run = study.runs[GARMENT, method]
        both.runs["shirt-male", method] = _runs.MethodRun(method, run.samples[:1] * (2 * N_SAMPLES))
    table = _build.sample_table(both, "comparison")
    for method in METHODS[:5]:
        every = np.concatenate([both.runs[g, method].values("mpve_mm") for g in (GARMENT, "shirt-male")])
        assert table.value(_tables.ALL, method, "mpve_mm") == pytest.approx(np.mean(every))
    assert table.value(_tables.ALL, "collision-loss-approx", "mpve_mm") is None


def test_postures_against_a_loop(study: _runs.Study) -> None:
    """In a study whose methods stand for the network and for the node."""
    alone, node = (study.runs[GARMENT, name] for name in ("tailornet", "refu-hybrid"))
    postures = [*("squat", "sitting", None) * N_SAMPLES][:N_SAMPLES]
    small = _runs.Study(n_samples={GARMENT: N_SAMPLES})
    for name, run in (("tailornet", alone), ("node-hybrid", node)):
        held = [one._replace(posture=posture) for one, posture in zip(run.samples, postures, strict=True)]
        small.runs[GARMENT, name] = _runs.MethodRun(name, held)
    table = _build.posture_table(small)
    assert {row.method for row in table.rows} == {"squat", "sitting", "all of them"}
    errors = node.values("mpve_mm")
    whole = np.mean([error for error, name in zip(errors, postures, strict=True) if name])
    assert table.value(GARMENT, "all of them", "mpve_mm") == pytest.approx(whole)
    squats = [k for k, name in enumerate(postures) if name == "squat"]
    error = errors[squats].mean()
    assert table.value(GARMENT, "squat", "n_samples") == len(squats)
    assert table.value(GARMENT, "squat", "mpve_mm") == pytest.approx(error)
    assert table.value(GARMENT, "squat", "share_of_mean") == pytest.approx(error / whole)
    before = alone.values("mpve_mm")[squats].mean()
    assert table.value(GARMENT, "squat", "network_mpve_mm") == pytest.approx(before)
    free = 100 * node.values("is_free")[squats].mean()
    assert table.value(GARMENT, "squat", "cfmp_percent") == pytest.approx(free)
    assert table.missing == []


def test_samples_without_postures_have_no_rows_and_the_page_says_what_makes_some(study: _runs.Study) -> None:
    node = study.runs[GARMENT, "refu-hybrid"]
    small = _runs.Study(n_samples={GARMENT: N_SAMPLES})
    for name in _build.POSTURE_METHODS:
        small.runs[GARMENT, name] = _runs.MethodRun(name, node.samples)
    table = _build.posture_table(small)
    assert table.rows == []
    assert f"`refu simulate {GARMENT} --postures 1" in "\n".join(table.markdown(source=""))


@pytest.fixture(scope="module")
def walk() -> Motion:
    """Arms hang, so that they press on the flanks; a leg swings."""
    poses = np.zeros((9, 24, 3), np.float32)
    poses[:, 1, 0] = 0.4 * np.sin(0.3 * np.arange(9))
    poses[:, 16, 2], poses[:, 17, 2] = -1.3, 1.3
    return Motion(poses, np.zeros((9, 3)), np.zeros(10, np.float32), 60.0)


@pytest.fixture(scope="module")
def library() -> _methods.Library:
    """The weights that ship; a pipeline is loaded once."""
    library = _methods.Library()
    library.pipeline = functools.cache(library.pipeline)  # type: ignore[method-assign]
    return library


@pytest.fixture(scope="module")
def motion_table(walk: Motion, library: _methods.Library) -> _tables.ResultTable:
    short = Motion(walk.poses[3:6], walk.transl[3:6], walk.betas, walk.fps)
    return _motion.motion_table({"long": walk, "short": short}, library=library, every=4)


def test_motion_table_weighs_clips_by_their_frames(motion_table: _tables.ResultTable) -> None:
    assert not motion_table.missing  # the weights of what it shows ship
    groups = list(dict.fromkeys(row.garment for row in motion_table.rows))
    names = (*PAPER_GARMENTS, "male body", "female body")
    assert set(groups) == {f"{name}, {clip}" for name in names for clip in ("all clips", "long", "short")}
    for method in ("node-hybrid", "node-accurate"):
        for metric, of in (("vfcp_percent", np.average), ("self_crossings", np.average), ("jump_max_mm", None)):
            whole, *parts = (
                motion_table.value(f"{GARMENT}, {c}", method, metric) for c in ("all clips", "long", "short")
            )
            assert whole == pytest.approx(max(parts) if of is None else of(parts, weights=[2, 1]))


@pytest.mark.parametrize("garments", [DEFAULT_GARMENTS, ("skirt-female",)])
def test_motion_table_against_a_loop(
    walk: Motion, motion_table: _tables.ResultTable, garments: tuple[str, ...]
) -> None:
    """Frames 0 and 4 of nine, each with the one after it."""
    pipeline = GarmentPipeline.load(garments)
    skinned = GarmentPipeline.load(garments, backbone="skinned", sdf="none")
    body = pipeline.body.faces.numpy()
    ways = []
    found: dict[str, dict[str, list[float]]] = {name: {} for name in garments}
    for index, betas in zip((0, 4), _motion.drawn_shapes(3), strict=False):
        shape = np.zeros(10, np.float32) if betas is None else betas
        told = [replace(f, betas=shape) for f in PoseHistory.told(walk.frame(i) for i in range(index + 2))[-2:]]
        now, then, start, end = (p(frame) for p in (pipeline, skinned) for frame in told)
        ways += np.linalg.norm(now.body - now.skin, axis=1).tolist()
        for name, garment in pipeline.garments.items():
            faces, edges = garment.faces.numpy(), garment.edges.numpy()
            winding = igl.fast_winding_number(now.body.astype(float), body, now[name].local.astype(float))
            rest = garment.rest(torch.tensor(shape[None]))[0].numpy()
            length, wanted = (np.linalg.norm(v[edges[:, 0]] - v[edges[:, 1]], axis=1) for v in (now[name].local, rest))
            ahead = (then[name].local - now[name].local) - (end[name].local - start[name].local)
            worn = [one for one in garments if one != name]
            figures = {
                "vfcp_percent": 100 * (winding > 0.5).mean(),
                "cfmp_percent": 100.0 * (fcl_pairs(now[name].local, faces, now.body, body) == 0),
                "skin_cfmp_percent": 100.0 * (fcl_pairs(now[name].local, faces, now.skin, body) == 0),
                "stretched_percent": 100 * (length > 2 * wanted).mean(),
                "jump_max_mm": 1e3 * np.linalg.norm(ahead, axis=1).max(),
                "layers_cut_percent": 100.0
                * any(fcl_pairs(now[name].local, faces, now[one].local, now[one].faces) for one in worn),
            }
            for metric, value in figures.items():
                found[name].setdefault(metric, []).append(value)
    for name, figures_of in found.items():
        for metric, values in figures_of.items():
            wanted_value = max(values) if metric == "jump_max_mm" else np.mean(values)
            value = motion_table.value(f"{name}, long", "node-hybrid", metric)
            if metric == "layers_cut_percent" and len(garments) == 1:
                assert value is None
            else:
                assert value == pytest.approx(wanted_value, rel=1e-3, abs=1e-3), (name, metric)
    shift = {row.metric: row.value for row in motion_table.rows if row.garment == f"{pipeline.body.name} body, long"}
    assert shift == {
        "shift_mean_mm": pytest.approx(1e3 * np.mean(ways), rel=1e-4),
        "shift_p99_mm": pytest.approx(1e3 * np.percentile(ways, 99), abs=0.05),
        "shift_max_mm": pytest.approx(1e3 * max(ways), rel=1e-5),
        "shift_moved_percent": pytest.approx(100 * np.mean(np.array(ways) > 1e-4), abs=0.01),
    }
    assert max(ways) > 0.002  # the arms do press


def test_every_other_person_has_a_shape_of_their_own() -> None:
    shapes = _motion.drawn_shapes(2000)
    assert all(betas is None for betas in shapes[::2])
    drawn = np.stack([betas for betas in shapes[1::2] if betas is not None])
    assert len(np.unique(drawn, axis=0)) == 1000
    assert -2 <= drawn.min() < -1.9
    assert 1.9 < drawn.max() <= 2
    assert np.abs(drawn.mean(0)).max() < 0.15


def test_motion_of_one_frame_has_no_pair(walk: Motion, library: _methods.Library) -> None:
    one = Motion(walk.poses[:1], walk.transl[:1], walk.betas, walk.fps)
    assert _motion.motion_table({"still": one}, library=library, every=1).rows == []


def test_shipped_weights_are_found_by_name(tmp_path: Path) -> None:
    library = _methods.Library([tmp_path])
    with pytest.raises(WeightsError, match="not trained"):
        library.find("alt1/tailornet-approx", "tshirt-male")
    (tmp_path / "tshirt-male" / "alt1").mkdir(parents=True)
    (tmp_path / "tshirt-male" / "alt1" / "tailornet-approx.json").write_text("{}", encoding="utf-8")
    assert (
        library.find("alt1/tailornet-approx", "tshirt-male") == tmp_path / "tshirt-male" / "alt1" / "tailornet-approx"
    )


def test_the_node_without_networks_has_none() -> None:
    (wearable,) = _methods.Library().pipeline(_methods.METHODS["node-skinned"], "tshirt-male").outfit.wearables.values()
    assert isinstance(wearable.backbone, Skinned)
    assert wearable.refu is None
