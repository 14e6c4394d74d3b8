"""`refu benchmark`: a tiny round, what it writes and refuses; its parts. What things cost is never asserted."""

from __future__ import annotations

import json
import math
import shlex
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from refu_core import GarmentPipeline, RefuError, SmplFrame, load_body, load_garment
from refu_lab.benchmark._measure import BenchmarkResult, BenchmarkRow, Timing, measure, one_core, processor_clock
from refu_lab.benchmark._paper import PaperSettings, PaperStructure
from refu_lab.benchmark._sdfs import PLAIN_QUERY, read_stretches, sdf_frame, sdf_methods
from refu_lab.benchmark._sections import GRAPH, LAUNCHES, Section, frame_runners
from refu_lab.cli import _parser, main
from refu_lab.commands.benchmark import BenchmarkOptions
from refu_lab.reproduction import published_modes

BAGS = Path(__file__).parents[2] / "bags"
SHORTS = "short-pant-male"


def run(*arguments: object) -> int:
    return main([str(argument) for argument in ("benchmark", *arguments, "--quiet")])


class Round:
    """What a tiny round left behind."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "results"
        weights = folder / "no weights"
        weights.mkdir()
        options = ("--quick", "--device", "cpu", "--garments", SHORTS, "--bags", BAGS, "--weights", weights)
        self.code = run(*options, "--output", self.folder, "--json", folder / "out.json")
        self.result: dict[str, Any] = json.loads((folder / "out.json").read_text())
        self.rows: list[dict[str, Any]] = self.result["rows"]

    def of(self, stage: str, **facts: object) -> list[dict[str, Any]]:
        return [r for r in self.rows if r["stage"] == stage and all(r[key] == value for key, value in facts.items())]


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Round:
    return Round(tmp_path_factory.mktemp("benchmark"))


def test_every_row_says_what_was_measured_and_its_ratio(tiny: Round) -> None:
    assert tiny.code == 0
    assert tiny.result["quick"]
    for row in tiny.rows:
        assert {"stage", "mode", "garment", "ms_median", "ratio", "device"} <= set(row)
        numbers = [value for value in row.values() if isinstance(value, float)]
        assert all(map(math.isfinite, numbers))
        assert row["ms_median"] > 0
        assert row["ratio"] > 0
        if "ms_q1" in row:
            assert row["ms_q1"] <= row["ms_median"] <= row["ms_q3"]


def test_a_round_has_all_parts(tiny: Round) -> None:
    for mode in ("hybrid", "accurate"):
        for stage in ("sdf", "frame", "persons", "unchanged"):
            assert tiny.of(stage, mode=mode), (stage, mode)
        for stage in ("decode", "body", "backbone", "sdf", "refu", "encode"):
            assert tiny.of(f"frame.{stage}", mode=mode), (stage, mode)
        assert [row["persons"] for row in tiny.of("persons", mode=mode)] == [1, 2]
    assert [row["ratio"] for row in tiny.of("sdf", mode="plain")] == [1.0]
    assert tiny.of("frame", mode="paper")
    (start,) = tiny.of("start")
    assert start["resident_mb"] <= start["peak_mb"]


def test_frames_carry_their_errors(tiny: Round) -> None:
    for row in tiny.of("frame", backbone="skinned"):
        assert row["mpve_mm"] > 0
        assert 0 <= row["vfcp_percent"] <= 100
        assert 0 <= row["cfmp_percent"] <= 100


def test_page_data_and_plot_say_the_same(tiny: Round) -> None:
    assert json.loads((tiny.folder / "performance.json").read_text()) == tiny.result
    page = (tiny.folder / "performance.md").read_text()
    assert f"`{tiny.result['command']}`" in page
    given = _parser().parse_args(shlex.split(tiny.result["command"])[1:])
    assert (given.device, given.weights, given.quick) == ("cpu", Path("no weights"), True)
    for row in tiny.of("sdf"):
        assert row["method"] in page
    widths = {line.count("|") for line in page.split("## ")[1].splitlines() if line.startswith("|")}
    assert len(widths) == 1
    assert (tiny.folder / "time-against-error.png").read_bytes().startswith(b"\x89PNG")


def test_on_a_gpu_frames_are_measured_with_graphs_and_without(monkeypatch: pytest.MonkeyPatch) -> None:
    """With pipelines of a CPU in their place, since there needn't be a GPU."""
    asked: list[dict[str, Any]] = []

    def load(_: BenchmarkOptions, garment: str, *, mode: str, **rest: Any) -> GarmentPipeline:
        asked.append({"mode": mode, **rest})
        return GarmentPipeline.load([garment], sdf=mode, backbone="skinned")

    monkeypatch.setattr(BenchmarkOptions, "load_pipeline", load)
    options = BenchmarkOptions(quick=True)
    modes = ("hybrid", "accurate")
    pipelines = {("skinned", mode): GarmentPipeline.load([SHORTS], sdf=mode, backbone="skinned") for mode in modes}
    result = BenchmarkResult("refu benchmark", quick=True)
    runners = {
        device: frame_runners(
            Section(garment=SHORTS, windows=[], options=options, result=result, progress=lambda: None, device=device),
            pipelines,
        )
        for device in ("cpu", "cuda")
    }
    assert list(runners["cpu"]) == [("skinned", mode, None) for mode in modes]
    assert [method for _, _, method in runners["cuda"]] == [GRAPH] * 2 + [LAUNCHES] * 2
    assert asked == [{"device": "cuda", "mode": mode, "backbone": "skinned", "graph": False} for mode in modes]


def test_what_is_not_installed_or_trained_is_named(tiny: Round) -> None:
    command = tiny.result["missing"][f"{SHORTS}: tailornet, hybrid"]
    given = _parser().parse_args(command.split()[1:])
    assert (given.command, given.garment) == ("train", SHORTS)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--garments", "kilt"), ("kilt", "tshirt-male")),
        (("--device", "abacus"), ("abacus", "cpu")),
        (("--weights", "nowhere"), ("nowhere", "folder")),
        (("--motions", "nowhere"), ("nowhere", "--motions")),
        (("--rounds", "0"), ("--rounds", "0")),
    ],
)
def test_wrong_options_are_one_line(
    arguments: tuple[str, ...], words: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    try:
        code: object = run(*arguments)
    except SystemExit as end:
        code = end.code
    assert code == 2
    captured = capsys.readouterr()
    assert not captured.out
    assert len(captured.err.splitlines()) == 1
    assert all(word in captured.err for word in words)


def test_contenders_take_turns_and_jumps_are_not_counted() -> None:
    calls: list[tuple[str, int]] = []
    contenders = {name: (lambda given, name=name: calls.append((name, given))) for name in ("a", "b", "slow")}
    times = measure(contenders, [[0, 1, 2], [10, 11, 12], [20, 21, 22]], rounds=2, slow={"slow"})
    assert {name: len(timing.ms) for name, timing in times.items()} == {"a": 12, "b": 12, "slow": 2}
    assert [given for name, given in calls if name == "a"] == [0, 1, 2, 10, 11, 12, 20, 21, 22] * 2
    assert [given for name, given in calls if name == "slow"] == [1, 11]
    first = [next(name for name, given in calls if given == window) for window in (0, 10, 20)]
    assert first == ["a", "b", "a"]


def test_a_timing_compares_by_the_processor_or_on_a_gpu_by_the_wall() -> None:
    cpu, wall = np.array([1.0, 2.0, 4.0]), np.array([10.0, 20.0, 40.0])
    assert Timing(cpu, wall).median == 2.0
    row = BenchmarkRow.of(Timing(cpu, wall), Timing(cpu, cpu), stage="sdf", mode="plain", garment=SHORTS)
    assert (row.ms_q1, row.ms_median, row.ms_q3) == (1.5, 2.0, 3.0)
    assert (row.wall_ms_median, row.ratio, row.samples) == (20.0, 1.0, 3)
    assert Timing(cpu, wall, on_gpu=True).median == 20.0


def test_clock_and_core_are_given_back() -> None:
    clock, threads = time.perf_counter, torch.get_num_threads()
    with one_core(), processor_clock():
        assert time.perf_counter is time.process_time
        assert torch.get_num_threads() == 1
    assert time.perf_counter is clock
    assert torch.get_num_threads() == threads


def test_every_distance_means_the_same() -> None:
    garment = load_garment(SHORTS)
    body = load_body(garment.body)
    pose = np.zeros((24, 3), np.float32)
    pose[1, 0] = -0.8
    betas = np.full(10, 0.5, np.float32)
    transforms = body(pose[None], betas[None]).transforms
    worn = garment.pose(garment.rest(torch.from_numpy(betas)[None]), transforms)[0]
    frame = sdf_frame(body, garment, SmplFrame(pose, betas), worn)
    methods, _ = sdf_methods(body, garment, network=False)
    assert methods[0].name == PLAIN_QUERY
    reference = methods[0].ask(frame)
    for method in methods[1:]:
        found = method.ask(frame)
        # The band says no more than "farther than the band" of most vertices.
        wanted = np.minimum(reference, found.max()) if method.mode == "accurate" else reference
        close = np.abs(found - wanted) < 2e-4
        assert close[np.abs(reference) < 0.02].mean() > 0.97, method.name
        if method.mode != "hybrid":
            assert close.mean() > 0.99, method.name


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_the_papers_structure_runs_and_counts_its_weights(dtype: torch.dtype) -> None:
    settings = PaperSettings(pivots=2, width=32, dtype=dtype)
    paper = PaperStructure(load_garment(SHORTS), load_body("male"), settings=settings)
    vertices = paper(SmplFrame(np.zeros((24, 3), np.float32)))
    n = load_garment(SHORTS).n_vertices
    assert vertices.shape == (n, 3)
    assert np.isfinite(vertices).all()
    assert list(paper.stages[0]) == ["body", "backbone", "sdf", "refu"]
    heads = 3 * n * (1024 + 1) * (1 + settings.pivots)  # of the low-frequency net and each high-frequency one
    assert paper.n_parameters > heads + 10 * n * (settings.width + 1)


def test_stretches_follow_each_other_at_thirty_hertz(tmp_path: Path) -> None:
    stretches = read_stretches(None, BAGS, count=3, length=5)
    assert [len(stretch) for stretch in stretches] == [5, 5, 5]
    stamps = np.array([[frame.stamp_ns for frame in stretch] for stretch in stretches])
    assert np.allclose(np.diff(stamps) * 1e-9, 1 / 30, atol=1e-4)
    with pytest.raises(RefuError, match="no motion of 5 frames"):
        read_stretches(tmp_path, BAGS, count=3, length=5)


def test_published_times_are_those_of_the_abstract() -> None:
    found = {mode: round(one["ms"], 1) for mode, one in published_modes().items()}
    assert found == {"approx": 22.6, "hybrid": 22.6, "accurate": 126.3}
