"""Arguments of `refu`: what no command takes is one line and 2, before any work is done."""

from __future__ import annotations

import argparse
import io
import json
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from msg_adapters import BagWriter
from refu_core import GarmentPipeline, RefuError
from refu_core._device import checked_device
from refu_lab import cli
from refu_lab.cli import main
from refu_lab.commands import _common
from refu_lab.commands._common import numbers, tell
from refu_lab.render import save_png
from refu_lab.replay import _paced
from refu_lab.tables import REPLAY_TITLE, html_page
from tests.core.test_files import SPECIAL
from tests.forked import run_forked
from tests.lab.test_interrupts import Interrupting
from tests.virtual_time import VirtualTime

BAG = str(Path(__file__).parents[1] / "bags" / "walk")
NEEDED = {
    "replay": ["replay", BAG],
    "simulate": ["simulate", "tshirt-male", "--count", "1"],
    "train": ["train", "tshirt-male", "--data", "x"],
    "evaluate": ["evaluate"],
    "benchmark": ["benchmark"],
    "stress": ["stress"],
    "info": ["info"],
}
PATHS = [
    ("replay", "--output"),
    ("replay", "--report"),
    ("replay", "--json"),
    ("simulate", "--output"),
    ("train", "--output"),
    ("evaluate", "--output"),
    ("benchmark", "--output"),
    ("stress", "--output"),
    ("info", "--json"),
]


USELESS = (
    ["--seconds", "5"],
    ["--shapes", "3"],
    ["--fps", "30"],
    ["--input-axes", "z-up"],
    ["--sequences", "--postures", "0.5"],
)
"""Options of `refu simulate` that do nothing without --sequences or --motions, for which they were meant, or with
them."""


def refused(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """The line that a command ends with."""
    try:
        code = main(arguments)
    except SystemExit as stop:
        code = int(stop.code or 0)
    line = capsys.readouterr().err
    assert (code, line.count("\n")) == (2, 1), line
    assert line.rstrip("\n").isprintable()
    assert len(line) < 500
    return line


@pytest.mark.parametrize(("command", "option"), [*PATHS, ("replay", "--weights"), ("evaluate", "--data")])
@pytest.mark.parametrize("name", ["a\0b", "a\ud800b", ""])
def test_names_that_no_file_has(command: str, option: str, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert f"argument {option}: wanted a path" in refused([*NEEDED[command], option, name], capsys)


@pytest.mark.parametrize(
    ("option", "said"),
    [
        ("--json=~/folder", "wanted a file"),
        ("--body=~/x.npz", "{}/x.npz"),
        ("--garments=tshirt-male,~/x.npz", "{}/x.npz"),
        ("--weights=~/x", "{}/x"),
    ],
)
def test_a_tilde_is_a_home_where_the_shell_leaves_it(
    option: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As bash does after `--option=`: a folder called ~ was made, or nothing was found."""
    (tmp_path / "folder").mkdir()
    monkeypatch.setenv("HOME", str(tmp_path))
    assert said.format(tmp_path) in refused(["replay", BAG, option], capsys)


def test_a_working_directory_that_was_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It was "[Errno 2]" without a name, or torch ended the process."""
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    try:
        assert "the working directory is gone" in refused(["replay", BAG, "--output", "out"], capsys)
        with pytest.raises(RefuError, match="out: can't be written: No such file"):
            BagWriter("out")
    finally:
        os.chdir(tmp_path)


@pytest.mark.parametrize(("command", "option"), PATHS)
def test_outputs_that_are_something_else(
    command: str, option: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    os.mkfifo(tmp_path / "fifo")
    for path in (tmp_path / "fifo", Path("/dev/null"), Path("/dev/full")):
        assert f"argument {option}: wanted a f" in refused([*NEEDED[command], option, str(path)], capsys)
    assert option in refused([*NEEDED[command], option, "x" * 5000], capsys)
    if option == "--json":
        assert "wanted a file" in refused([*NEEDED[command], option, str(tmp_path)], capsys)


@pytest.mark.parametrize(
    "arguments",
    [
        ["info", "--body", "own", "--json", "own"],
        ["garment", "add", "own", "--json", "own"],
        ["garment", "add", "mesh.obj", "--pose", "own", "--output", "own", "--overwrite"],
        ["replay", BAG, "--body", "own", "--json", "link"],
        ["replay", BAG, "--garments", "tshirt-male,own", "--report", "report", "--json", "own"],
        ["export", BAG, "--betas-from", "own", "--output", "out.glb", "--json", "./own"],
        ["simulate", "tshirt-male", "own", "--count", "1", "--output", "set", "--json", "own"],
        ["stress", "--replay", "own", "--json", "own"],
    ],
)
def test_nothing_that_is_read_is_written_over(
    arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("own").write_text("years of work")
    Path("link").symlink_to("own")
    said = refused(arguments, capsys)
    assert "written over the input own" in said
    assert Path("own").read_text() == "years of work"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["link", "own"]


def test_a_report_takes_no_other_pages_place(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = tmp_path / "index.html"
    page.write_text("<title>My home</title>")
    for inputs in ([BAG], [BAG, BAG]):
        assert "no report of refu replay" in refused(["replay", *inputs, "--report", str(tmp_path)], capsys)
    assert page.read_text() == "<title>My home</title>"
    assert f"<title>{REPLAY_TITLE}" in html_page("Replay of a", "", style="")


@pytest.mark.parametrize("name", ["box.stl", "picture.jpg", "picture"])
def test_a_picture_takes_no_other_files_place(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "ends in .png" in refused(["garment", "add", "x.obj", "--picture", str(tmp_path / name)], capsys)


def test_results_are_written_whole_and_before_they_are_printed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the disk is full what was there stays, and who has closed the pipe has the file nevertheless."""
    args = argparse.Namespace(json=tmp_path / "a.json")

    class Gone:
        def write(self, _: str) -> int:
            raise BrokenPipeError

    with monkeypatch.context() as patch:
        patch.setattr("sys.stdout", Gone())
        with pytest.raises(BrokenPipeError):
            tell(args, "text", {"a": 1})
    before = args.json.read_bytes()
    assert json.loads(before) == {"a": 1}
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 16, hard))
    try:
        for write in (
            lambda: tell(args, "text", {"a": "b" * (1 << 17)}),
            lambda: save_png(np.random.default_rng(0).integers(0, 255, (256, 256, 3), np.uint8), args.json),
        ):
            with pytest.raises((RefuError, OSError), match="File too large"):
                write()
            assert args.json.read_bytes() == before
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"]


@pytest.mark.parametrize(
    ("lay", "said"), [case for case in SPECIAL if "directory" not in case[1] and "loop" not in case[1]]
)
def test_bodies_and_inputs_that_are_no_files(
    lay: Callable[[Path], object], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    del said
    for name, arguments in (
        ("x.npz", ["info", "--body"]),
        ("x.pkl", ["info", "--body"]),
        ("x.npz", ["stress", "--replay"]),
    ):
        folder = tmp_path / f"{arguments[0]}-{name}"
        folder.mkdir()
        lay(folder / name)
        assert "can't be read" in refused([*arguments, str(folder / name)], capsys)


@pytest.mark.parametrize(
    "arguments",
    [
        ["replay", BAG, "--device", "meta"],
        ["replay", BAG, "--device", "vulkan"],
        ["replay", BAG, "--device", "cpu\0"],
        ["replay", BAG, "--device", "\ud800"],
        ["replay", BAG, "--device", "\x1b[2J" * 1000],
        ["replay", BAG, "--frame-id", "\ud800"],
        ["replay", BAG, "--topic", "a\x1bb"],
        ["replay", BAG, "--margin", "nan"],
        ["replay", BAG, "--max-frames", "9" * 5000],
        ["replay", BAG, "--betas", "1,nan"],
        ["stress", "--seed", "-1"],
        ["stress", "--hours", "inf"],
        ["simulate", "tshirt-male", "--count", "1", "--output", "x", "--seconds", "1e300"],
        ["simulate", "\ud800", "--count", "1", "--output", "x"],
        ["info", "--body", "\ud800.npz"],
        ["info", "--body", "a\0b.pkl"],
        ["\x1b]0;x\x07" * 1000],
        ["info", "--body", ""],
        ["replay", BAG, "--betas", "1", "--betas-source", "message"],
        ["export", BAG, "--output", "x.glb", "--betas", "1", "--betas-source", "builtin"],
        *(["simulate", "tshirt-male", "--count", "1", "--output", "x", *more] for more in USELESS),
        ["train", "tshirt-male", "--data", ".", "--motions", "."],
        ["train", "tshirt-male", "--data", ".", "--rehearse", "10"],
    ],
)
def test_values_that_no_command_takes(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    refused(arguments, capsys)


PLAIN = ["--garments", "short-pant-male", "--backbone", "skinned", "--sdf", "none", "--no-collider"]
"""What is dressed soonest."""


@pytest.mark.parametrize(
    ("package", "extra", "arguments"),
    [
        ("tqdm", "lab", ["replay", BAG, *PLAIN]),
        ("matplotlib", "lab", ["replay", BAG, "--report", "report"]),
        ("numba", "train", ["simulate", "tshirt-male", "--count", "1", "--output", "set"]),
    ],
)
def test_an_extra_that_is_missing_is_named(package: str, extra: str, arguments: list[str], tmp_path: Path) -> None:
    def run() -> int:
        sys.modules[package] = None  # type: ignore[assignment]  # as Python has it: it can't be imported
        from refu_lab.cli import main

        return main(arguments)

    done = run_forked(run, cwd=tmp_path, forgets=(package, "msg_adapters", "refu_core", "refu_lab"))
    assert done.returncode == 2
    assert done.stderr == f'refu: error: {package} is not installed: pip install "refu-ros[{extra}]"\n'
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("buffered", [True, False], ids=["buffered", "at once"])
@pytest.mark.parametrize("arguments", [["info"], ["--help"]], ids=" ".join)
def test_whose_reader_has_gone_ends_quietly(arguments: list[str], *, buffered: bool) -> None:
    read, write = os.pipe()
    os.close(read)
    environment = os.environ | {"PYTHONUNBUFFERED": "" if buffered else "1"}
    command = [sys.executable, "-m", "refu_lab", *arguments]
    done = subprocess.run(command, env=environment, stdout=write, stderr=subprocess.PIPE, check=False)
    os.close(write)
    assert (done.returncode in (0, _common.EXIT_UNREAD), done.stderr) == (True, b"")


@pytest.mark.parametrize(
    "arguments",
    [["-c", "import refu_core._warp"], ["-m", "refu_lab", "export", "bags/walk", "--output={}", *PLAIN]],
    ids=["library", "command"],
)
def test_without_standard_streams_it_works_as_with_them(arguments: list[str], tmp_path: Path) -> None:
    command = [sys.executable, *(one.format(tmp_path / "a.glb") for one in arguments)]
    closed = ["sh", "-c", 'exec "$@" >&- 2>&-', "sh", *command]
    assert subprocess.run(closed, cwd=Path(__file__).parents[1], check=False).returncode == 0


def test_output_that_cannot_be_written_is_one_line() -> None:
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    with Path("/dev/full").open("w") as full:
        command = [sys.executable, "-m", "refu_lab", "garment", "list"]
        done = subprocess.run(command, env=environment, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert (done.returncode, done.stderr) == (2, "refu: error: [Errno 28] No space left on device\n")


def test_a_terminal_without_arrows_gets_the_rest(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.stdout", io.TextIOWrapper(io.BytesIO(), encoding="latin-1"))
    assert main(["replay", BAG, *PLAIN, "--max-frames", "1", "--quiet"]) == 0
    assert b"before ? after collision handling" in b" ".join(sys.stdout.buffer.getvalue().split())  # type: ignore[attr-defined]
    assert capsys.readouterr().err == ""


def test_an_interrupt_while_imports_run_leaves_no_traceback() -> None:
    """Delivered when NumPy is being imported: as early as anybody can press Ctrl-C."""
    code = (
        "import os, signal, sys\n"
        "class Interrupts:\n"
        "    def find_spec(self, name, *_):\n"
        "        if name == 'numpy': os.kill(os.getpid(), signal.SIGINT)\n"
        "sys.meta_path.insert(0, Interrupts())\n"
        "from refu_lab.__main__ import main\n"
        "sys.exit(main())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (-signal.SIGINT, b"", b"")


@pytest.mark.parametrize("arguments", [[], ["garment"]], ids=["refu", "refu garment"])
def test_a_command_without_its_subcommand_shows_its_help(
    arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 2
    said = capsys.readouterr()
    assert (said.out, said.err.split()[:2]) == ("", ["usage:", "refu"])


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--garments", "a b"], "with commas between them, got 'a b'"),
        (["--max-frames", "0"], "wanted a whole number above zero, got '0'"),
        (["--max-frames", "9999999999"], "wanted a whole number from 1 to 1,000,000,000"),
        (["--output", "w.db3"], "bags are written as NAME.mcap, or as a folder"),
        (["--output", "w.bag"], "bags are written as NAME.mcap, or as a folder"),
        (["--output", "W.MCAP"], "bags are written as NAME.mcap, or as a folder"),
    ],
)
def test_values_say_what_was_wanted(arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert said in refused(["replay", BAG, *arguments], capsys)


@pytest.mark.parametrize(
    ("program", "before"),
    [("refu_lab.cli", "os"), ("refu_ros.garment_node", "rclpy.qos"), ("refu_ros.smpl_publisher", "rclpy.qos")],
)
def test_numpy_starts_no_threads(program: str, before: str) -> None:
    """With threads a small product waits for all cores: beside other work a hundred times as long."""
    pytest.importorskip(before)  # rclpy has threads of its own
    count = "len(os.listdir('/proc/self/task'))"
    code = f"import os, {before}; n = {count}; import {program}, numpy, scipy.linalg; print({count} - n)"
    environment = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout == "0\n"


@pytest.mark.parametrize("device", ["meta", "mps", "cpu:x", "cuda:99", "xla", "", "cpu\0"])
def test_devices_that_there_are_not(device: str) -> None:
    with pytest.raises(RefuError, match="no device"):
        checked_device(device)


@pytest.mark.parametrize("text", ["-1,0,2.5", "-.5,1", "-1"])
@pytest.mark.parametrize("form", [["--betas={}"], ["--betas", "{}"]])
def test_numbers_may_be_negative(form: list[str], text: str) -> None:
    arguments = [part.format(text) for part in form]
    assert cli._parser().parse_args(["replay", BAG, *arguments, "--quiet"]).betas == numbers(10)(text)


def test_a_bug_is_one_line_and_shows_where_it_is_when_asked(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def collect() -> None:
        raise KeyError("it\x1b[2J")

    monkeypatch.setattr("refu_lab.info.collect", collect)
    assert main(["info"]) == _common.EXIT_BUG
    said = capsys.readouterr().err
    assert said == r"refu: a bug of refu, please report it; REFU_DEBUG=1 shows where: KeyError: 'it\x1b[2J'" + "\n"
    monkeypatch.setenv("REFU_DEBUG", "1")
    assert main(["info"]) == _common.EXIT_BUG
    assert "in collect" in capsys.readouterr().err


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_is_not_lost_in_a_destructor(
    number: signal.Signals, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Python printed it, and the replay went on until the node killed it."""

    def collect() -> None:
        Interrupting(number)
        time.sleep(60)

    monkeypatch.setattr("refu_lab.info.collect", collect)
    assert main(["info"]) == _common.EXIT_INTERRUPTED
    assert capsys.readouterr().err == "refu: interrupted\n"


@dataclass
class Record:
    log_time_ns: int


def test_a_gap_of_centuries_isnt_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    time = VirtualTime()
    time.rules("refu_lab.replay", monkeypatch)
    times = (0, 2**63 - 1, 5, 10_000_000)
    assert [r.log_time_ns for r in _paced([Record(t) for t in times], "real")] == list(times)  # type: ignore[arg-type]
    assert time.now < 0.01
    times = (2, 10_000_002, 60_000_000_002)
    assert [r.log_time_ns for r in _paced([Record(t) for t in times], "real")] == list(times)  # type: ignore[arg-type]
    assert time.now == pytest.approx(60, abs=0.01)  # a minute is


def test_an_input_that_is_not_there_is_told_before_anything_is_loaded(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A mistyped path is answered at once: its pipeline would take seconds, and then be of no use."""

    def load(*_args: object, **_options: object) -> None:
        raise AssertionError

    monkeypatch.setattr(GarmentPipeline, "load", load)
    (tmp_path / "a.json").write_text("{}")
    for name in ("nope", "nope.npz", str(tmp_path / "a.json")):
        assert "wanted a" in refused(["replay", name], capsys)
        assert "wanted a" in refused(["export", name, "--output", str(tmp_path / "a.glb")], capsys)
