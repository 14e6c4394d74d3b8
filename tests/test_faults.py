"""Things that break: weights, devices, disks, clocks, processes. Each is a clear word and bounded harm."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import resource
import runpy
import struct
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors

from msg_adapters import BagError, BagReader, BagWriter, QosProfile
from msg_adapters.bags import Recorder
from msg_adapters.diagnostics import DiagnosticStatus
from msg_adapters.scene import Scene
from msg_adapters.statistics import Statistics
from refu_core import GarmentPipeline, SmplFrame, WeightsError, load_body
from refu_core._device import is_device_loss
from refu_core.backbones import TailorNetConfig
from refu_core.outputs import Fittings
from refu_core.training._record import load_checkpoint, save_checkpoint
from refu_core.weights import save_weights
from refu_lab.cli import main
from refu_ros._diagnostics import Situation, statuses
from refu_ros._settings import NodeSettings
from refu_ros._worker import Worker
from tests.core.test_files import SPECIAL
from tests.forked import run_forked
from tests.fuzz.corpus import small_weights
from tests.limits import refusal

GARMENT = "short-pant-male"
KILL_TEST = Path(__file__).parents[1] / "scripts" / "kill_test.py"
LOST = (
    "CUDA error: unspecified launch failure\nCUDA kernel errors might be asynchronously reported at some other API call"
)


# Weights ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights of one's own for the shorts: untrained, and small."""
    folder = tmp_path_factory.mktemp("weights")
    small_weights(folder / GARMENT, TailorNetConfig)
    return folder


def load(weights: Path) -> GarmentPipeline:
    return GarmentPipeline.load([GARMENT], backbone="tailornet", sdf="hybrid", weights=weights)


def copy_of(weights: Path, folder: Path) -> Path:
    for path in (weights / GARMENT).iterdir():
        (folder / GARMENT).mkdir(exist_ok=True)
        (folder / GARMENT / path.name).write_bytes(path.read_bytes())
    return folder


def edit_card(path: Path, **changes: Any) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def test_whole_weights_dress_somebody(weights: Path) -> None:
    mesh = load(weights)(SmplFrame(np.zeros((24, 3), np.float32)))[GARMENT]
    assert np.isfinite(mesh.vertices).all()


@pytest.mark.parametrize(
    "name", ["tailornet-hybrid.safetensors", "tailornet-hybrid.json", "basis.safetensors", "basis.json"]
)
def test_missing_weights_say_what_to_do(weights: Path, tmp_path: Path, name: str) -> None:
    (copy_of(weights, tmp_path) / GARMENT / name).unlink()
    with pytest.raises(WeightsError, match=f"{name}: no such weights; train some with `refu train`"):
        load(tmp_path)


@pytest.mark.parametrize("name", ["tailornet-hybrid.safetensors", "basis.json"])
def test_empty_weights_are_refused(weights: Path, tmp_path: Path, name: str) -> None:
    (copy_of(weights, tmp_path) / GARMENT / name).write_bytes(b"")
    with pytest.raises(WeightsError, match=f"{name}: can't be read: an empty file; wanted weights or their card"):
        load(tmp_path)


@pytest.mark.parametrize("share", [0.01, 0.3, 0.999])
@pytest.mark.parametrize("name", ["tailornet-hybrid.safetensors", "basis.safetensors"])
def test_truncated_weights_are_refused(weights: Path, tmp_path: Path, name: str, share: float) -> None:
    path = copy_of(weights, tmp_path) / GARMENT / name
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    with pytest.raises(WeightsError, match=f"{name}: damaged, or not the file that its card describes"):
        load(tmp_path)


def test_weights_of_another_body_are_refused(weights: Path, tmp_path: Path) -> None:
    card = copy_of(weights, tmp_path) / GARMENT / "tailornet-hybrid.json"
    edit_card(card, body_fingerprint=load_body("female").fingerprint)
    with pytest.raises(WeightsError, match="trained on the body"):
        load(tmp_path)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"format": "refu-weights-2"}, "wanted a card of the format refu-weights-1, got refu-weights-2"),
        ({"backbone": "transformer"}, "a backbone 'transformer' that this version doesn't know"),
        ({"config": {"joints": [0], "heads": 8}}, "a card that this version doesn't know"),
        ({"config": {"joints": [0], "low": [2**40]}}, "low of TailorNetConfig can't be"),
        ({"config": {"joints": [0, 1, 2], "low": [1 << 19], "high": [1 << 19]}}, "of another shape"),
    ],
)
def test_weights_of_another_version_are_refused(
    weights: Path, tmp_path: Path, changes: dict[str, Any], reason: str
) -> None:
    edit_card(copy_of(weights, tmp_path) / GARMENT / "tailornet-hybrid.json", **changes)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(WeightsError, match=rf"tailornet-hybrid\.\w+: .*{reason}"):
        load(tmp_path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # [KiB]; the last one asks for 1 TB


@pytest.mark.parametrize(
    ("refu", "reason"),
    [
        ({"margin": 1e9}, r"wanted a margin of 0 to 0.05 m .* got 1e\+09 m"),
        ({"least": 7.0}, "a least scale of 0 to 1, got 0.004 m and 7"),
        ({"least": "nan"}, "a least scale of 0 to 1"),
        ({"margin": "inf"}, "doesn't fit its card"),
        ({"n_vertices": 10**30}, "doesn't fit its card"),
        ({"scale": []}, "doesn't fit its card"),
    ],
)
def test_layers_that_make_no_sense_are_refused(
    weights: Path, tmp_path: Path, refu: dict[str, Any], reason: str
) -> None:
    card = copy_of(weights, tmp_path) / GARMENT / "tailornet-hybrid.json"
    edit_card(card, refu=json.loads(card.read_text())["refu"] | refu)
    assert re.search(reason, refusal(lambda: load(tmp_path)))


@pytest.mark.parametrize("number", ["NaN", "Infinity", "-1e999"])
def test_cards_of_numbers_that_are_not_finite_are_refused(weights: Path, tmp_path: Path, number: str) -> None:
    card = copy_of(weights, tmp_path) / GARMENT / "tailornet-hybrid.json"
    card.write_text(card.read_text().replace("{", f'{{"x": {number},', 1))
    assert "a finite number was expected" in refusal(lambda: load(tmp_path))


def forge(stem: Path, data: bytes | Path) -> None:
    """Puts tensors under a card, which then has their hash."""
    path = stem.with_suffix(".safetensors")
    if isinstance(data, Path):
        path.unlink()
        path.symlink_to(data)
        return
    path.write_bytes(data)
    edit_card(stem.with_suffix(".json"), sha256=hashlib.sha256(data).hexdigest())


@pytest.mark.parametrize("largest", [1e-4, 1e4, 6e4])
def test_weights_whose_garment_is_nowhere_near_the_body_are_refused(
    weights: Path, tmp_path: Path, largest: float
) -> None:
    stem = copy_of(weights, tmp_path) / GARMENT / "tailornet-hybrid"
    tensors = load_tensors(stem.with_suffix(".safetensors").read_bytes())
    full = {  # weights of that size: bytes are numbers of steps
        k: torch.full_like(v, 1 if v.dtype == torch.int8 else largest) if k.endswith(("weight", "weight.step")) else v
        for k, v in tensors.items()
    }
    forge(stem, save_tensors(full))
    if largest < 1:
        load(tmp_path)
    else:
        assert re.search("weights of at most 10000|of a body at rest", refusal(lambda: load(tmp_path)))


def header(entries: Any, rest: bytes = b"") -> bytes:
    text = entries if isinstance(entries, bytes) else json.dumps(entries).encode()
    return struct.pack("<Q", len(text)) + text + rest


TENSORS: dict[str, bytes | Path] = {
    "eight-bit floats": header({"a": {"dtype": "F8_E4M3", "shape": [4], "data_offsets": [0, 4]}}, bytes(4)),
    "complex numbers": header({"a": {"dtype": "C64", "shape": [1], "data_offsets": [0, 8]}}, bytes(8)),
    "a header of gigabytes": struct.pack("<Q", 1 << 40) + bytes(100),
    "a header of brackets": header(b"[" * 500_000),
    "a header that is a list": header([]),
    "no header": bytes(8),
    "a tensor that isn't there": header({"a": {"dtype": "F32", "shape": [1 << 40], "data_offsets": [0, 1 << 42]}}),
    "a negative shape": header({"a": {"dtype": "F32", "shape": [-1, -1], "data_offsets": [0, 4]}}, bytes(4)),
    "a shape of words": header({"a": {"dtype": "F32", "shape": ["x"], "data_offsets": [0, 4]}}, bytes(4)),
    "an endless device": Path("/dev/zero"),
    "a process's memory": Path("/proc/self/mem"),
}


@pytest.mark.parametrize("data", TENSORS.values(), ids=TENSORS)
def test_hostile_tensors_are_refused(weights: Path, tmp_path: Path, data: bytes | Path) -> None:
    forge(copy_of(weights, tmp_path) / GARMENT / "tailornet-hybrid", data)
    assert "tailornet-hybrid.safetensors" in refusal(lambda: load(tmp_path))


@pytest.mark.parametrize("gigabytes", [2, 6])
def test_sparse_tensors_are_refused_before_they_are_read(weights: Path, tmp_path: Path, gigabytes: int) -> None:
    with (copy_of(weights, tmp_path) / GARMENT / "tailornet-hybrid.safetensors").open("wb") as file:
        file.truncate(gigabytes << 30)
    assert refusal(lambda: load(tmp_path))


@pytest.mark.parametrize("suffix", [".json", ".safetensors"])
@pytest.mark.parametrize(("lay", "said"), SPECIAL)
def test_weights_that_are_no_files(
    weights: Path, tmp_path: Path, lay: Callable[[Path], object], said: str, suffix: str
) -> None:
    path = (copy_of(weights, tmp_path) / GARMENT / "tailornet-hybrid").with_suffix(suffix)
    path.unlink()
    lay(path)
    assert re.search(said, refusal(lambda: load(tmp_path)))


# Devices ------------------------------------------------------------------------------------------


def test_what_a_lost_device_is() -> None:
    assert is_device_loss(RuntimeError(LOST))
    assert is_device_loss(RuntimeError("Warp CUDA error 719: unspecified launch failure"))
    assert not is_device_loss(ValueError(LOST))
    assert not is_device_loss(RuntimeError("mat1 and mat2 shapes cannot be multiplied"))
    assert not is_device_loss(torch.OutOfMemoryError("CUDA out of memory. CUDA error"))


class Failing:
    """A pipeline whose device fails with the third frame."""

    def __init__(self, pipeline: GarmentPipeline) -> None:
        self._pipeline = pipeline
        self.body, self.garments = pipeline.body, pipeline.garments
        self.untrained = pipeline.untrained
        self.threads, self.frames = 1, 0
        self.heeds_past = pipeline.heeds_past

    def __call__(self, frames: list[SmplFrame], *, margin: float | None) -> list[Any]:
        self.frames += 1
        if self.frames > 2:
            raise RuntimeError(LOST)
        return self._pipeline(frames, margin=margin)


class Outlet:
    """Counts what comes out, and does what the node does."""

    def __init__(self, replacement: GarmentPipeline) -> None:
        self.replacement = replacement
        self.worker: Worker | None = None
        self.sent, self.losses = 0, []  # type: ignore[var-annotated]

    def is_watched(self) -> bool:
        return True

    def watchers(self, topic: str) -> int:
        return int(topic == "garments")

    def now_ns(self) -> int:
        return 0

    def send(self, topic: str, data: bytes) -> None:  # noqa: ARG002
        self.sent += 1

    def device_lost(self, reason: str) -> None:
        self.losses.append(reason)


def turned(i: int) -> SmplFrame:
    pose = np.zeros((24, 3), np.float32)
    pose[16, 2] = -0.1 * i
    return SmplFrame(pose, stamp_ns=i)


def status_of(part: str, found: list[DiagnosticStatus]) -> DiagnosticStatus:
    (one,) = (status for status in found if status.name == f"n: {part}")
    return one


def test_a_lost_device_is_reported_once_and_another_pipeline_takes_over() -> None:
    pipeline = GarmentPipeline.load([GARMENT], backbone="skinned", sdf="none")
    statistics, outlet = Statistics(), Outlet(pipeline)
    scene = Scene(statistics)
    settings = NodeSettings(garments=(GARMENT,), backbone="skinned", sdf="none")
    worker = Worker(scene, statistics, outlet, settings=settings, fittings=Fittings(Failing(pipeline)))  # type: ignore[arg-type]

    def tick(i: int) -> None:
        scene.put("", turned(i))
        worker.tick(lambda: scene.take(timeout=0.0))

    for i in range(1, 6):
        tick(i)
    assert (outlet.sent, outlet.losses) == (2, [LOST])
    report = statistics.report()
    assert report.total["drop.device"] == 3
    parts: dict[str, Any] = {"node": "n", "state": "active", "persons": ("",)}
    parts |= {"recording": None, "recording_error": ""}
    output = status_of("garments", statuses(report, settings, Situation(**parts)))
    assert (output.level, "the device has failed" in output.message) == (2, True)
    worker.fittings = Fittings(pipeline)
    tick(6)
    assert outlet.sent == 3
    in_use = replace(settings.pipeline, device="cpu")
    found = statuses(statistics.report(), settings, Situation(**parts, in_use=in_use))
    assert status_of("garments", found).values["device"] == "cpu"


def test_a_command_whose_device_fails_says_so_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def lost() -> None:
        raise RuntimeError(LOST)

    monkeypatch.setattr("refu_lab.info.collect", lost)
    assert main(["info"]) == 1
    assert capsys.readouterr().err == (
        "refu: error: the device has failed: CUDA error: unspecified launch failure; run it again, or on the cpu\n"
    )


# Clocks and names ---------------------------------------------------------------------------------


def test_a_clock_set_back_loses_nothing_and_is_reported(tmp_path: Path) -> None:
    statistics = Statistics()
    scene = Scene(statistics)
    for stamp in (10 * 10**9, 20 * 10**9, 5 * 10**9, 6 * 10**9, 30 * 10**9):
        scene.put("ann", SmplFrame(np.zeros((24, 3), np.float32), stamp_ns=stamp))
        assert scene.take(timeout=0.0)["ann"].frame.stamp_ns == stamp
    statistics.receive()
    now = Situation(node="n", state="active", persons=("",), recording=None, recording_error="")
    found = statuses(statistics.report(), NodeSettings(), now)
    first = status_of("input", found)
    assert (first.level, first.values["stamps that went back"]) == (1, "1")
    assert "was a clock set back" in first.message
    times = [100, 200, 50, 60, 300]
    with BagWriter(tmp_path / "bag") as writer:
        writer.add_topic("/a", "std_msgs/msg/Float32MultiArray")
        for time_ns in times:
            writer.write("/a", b"\0\1\0\0", log_time_ns=time_ns)
    with BagReader(tmp_path / "bag") as reader:
        assert [message.log_time_ns for message in reader.messages()] == times
    text = (tmp_path / "bag" / "metadata.yaml").read_text()
    assert "nanoseconds_since_epoch: 50" in text
    assert "nanoseconds: 250" in text


def test_nodes_of_one_name_are_reported() -> None:
    now = Situation(node="n", state="active", persons=("",), recording=None, recording_error="", n_namesakes=1)
    found = statuses(Statistics().report(), NodeSettings(), now)
    status = status_of("garments", found)
    assert (status.level, status.message) == (
        1,
        "2 nodes have this name: start others with -r __ns:=/another_namespace",
    )


# Disks --------------------------------------------------------------------------------------------


@contextmanager
def small_disk(size: int) -> Iterator[None]:
    """No file gets larger than that [bytes]."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_full_disk_keeps_the_checkpoint_before(tmp_path: Path) -> None:
    path = tmp_path / "training.checkpoint"
    save_checkpoint(path, {"step": 1, "w": torch.zeros(4)})
    with small_disk(50_000), pytest.raises(WeightsError, match="the checkpoint can't be written"):
        save_checkpoint(path, {"step": 2, "w": torch.randn(100_000)})
    state = load_checkpoint(path)
    assert state is not None
    assert state["step"] == 1
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def test_a_full_disk_keeps_the_weights_before(tmp_path: Path) -> None:
    path = save_weights(tmp_path / "w", {"a": torch.zeros(4)}, {"garment": GARMENT})
    before = path.read_bytes()
    with small_disk(50_000), pytest.raises(WeightsError, match="can't be written"):
        save_weights(tmp_path / "w", {"a": torch.randn(100_000)}, {"garment": GARMENT})
    assert path.read_bytes() == before


def test_a_read_only_disk_is_said_before_any_frame(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    opened = Path.open

    def read_only(self: Path, mode: str = "r", *args: Any, **kwargs: Any) -> Any:
        if set(mode) & set("wxa+") and tmp_path in self.parents:
            raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(self))
        return opened(self, mode, *args, **kwargs)

    monkeypatch.setattr(Path, "open", read_only)  # root may write wherever permissions say no
    with pytest.raises(BagError, match="Read-only file system"):
        Recorder(tmp_path / "bag")
    with pytest.raises(WeightsError, match="Read-only file system"):
        save_checkpoint(tmp_path / "x.checkpoint", {"step": 1})


def test_a_disk_that_stalls_costs_messages_and_no_time(tmp_path: Path) -> None:
    gate = threading.Event()

    class Stalling(BagWriter):
        def write(self, *args: Any, **kwargs: Any) -> None:
            assert gate.wait(60), "the disk was waited for"
            super().write(*args, **kwargs)

    recorder = Recorder(tmp_path / "bag", max_queued_bytes=4_000, open_bag=Stalling)
    for i in range(500):
        recorder.put("/a", "std_msgs/msg/Float32MultiArray", bytes(1000), time_ns=i, qos=QosProfile())
    gate.set()
    recorder.close()
    state = recorder.state()
    assert (state.written + state.dropped, state.error) == (500, "")
    assert state.dropped >= 495
    with BagReader(tmp_path / "bag") as reader:
        assert sum(1 for _ in reader.messages()) == state.written


# Processes ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("what", "times"), [("recording", 4), ("training", 3)])
def test_kills_leave_what_can_be_read_and_gone_on_with(what: str, times: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", [str(KILL_TEST), "--what", what, "--times", str(times)])
    done = run_forked(lambda: runpy.run_path(str(KILL_TEST))["main"]())
    assert done.returncode == 0, done
    assert f"{what}: {times} kills" in done.stdout


def test_the_kill_test_notices_damage(tmp_path: Path) -> None:
    recording = runpy.run_path(str(KILL_TEST))["Recording"](tmp_path)
    with BagWriter(tmp_path / "bag") as writer:
        writer.add_topic(recording.topic, recording.message_type)
        for i in (0, 2):
            writer.write(recording.topic, recording.payload(i), log_time_ns=i)
    with pytest.raises(AssertionError, match="message 1 of 2 is another"):
        recording.check(tmp_path)


# Networks -----------------------------------------------------------------------------------------


def test_replays_ask_no_network_for_anything_and_need_no_dask(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of one recording, and of several: Dask is imported where several processes are asked for."""
    walk, other = (str(Path(__file__).parents[1] / "bags" / name) for name in ("walk", "reach_squat"))
    options = ["--garments", GARMENT, "--max-frames", "2", "--backbone", "skinned", "--sdf", "accurate", "--quiet"]
    replays = [["replay", walk, "--output", str(tmp_path / "out.mcap"), *options], ["replay", walk, other, *options]]
    for name in ("HTTP_PROXY", "HTTPS_PROXY", "http_proxy", "https_proxy"):
        monkeypatch.setenv(name, "http://127.0.0.1:9")
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    dask = {"dask", "distributed", "tornado"}

    def refuse(event: str, arguments: object) -> None:
        if event in ("socket.connect", "socket.getaddrinfo", "socket.bind", "socket.sendto", "socket.gethostbyname"):
            sys.stderr.write(f"network: {event} {arguments}\n")
            raise OSError("there is no network")

    def run() -> int:
        sys.addaudithook(refuse)
        from refu_lab.cli import main

        return max(map(main, replays)) or bool(dask & set(sys.modules))

    done = run_forked(run, forgets=(*dask, "fsspec", "msg_adapters", "refu_core", "refu_lab"))
    assert done.returncode == 0, done
    assert "network:" not in done.stderr
    with BagReader(tmp_path / "out.mcap") as reader:
        assert {topic.message_count for topic in reader.topics} == {2}
