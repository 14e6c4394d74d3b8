"""Many recordings and many processes: found, replayed once each, whatever dies; the same bytes whoever does it."""

from __future__ import annotations

import itertools
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import fsspec
import pytest
from fsspec.implementations.memory import MemoryFile
from hypothesis import given
from hypothesis import strategies as st

from msg_adapters import BagReader, BagWriter
from refu_core import RefuError, SmplFrame
from refu_core._engine import InProcess, Lost
from refu_lab.cli import main
from refu_lab.commands.replay import ReplayOptions
from refu_lab.fleet import find_recordings, fleet_table, is_plain, open_engine
from refu_lab.fleet._engine import DaskEngine, FleetError, run_function
from refu_lab.fleet._storage import Folder, fetched
from refu_lab.fleet._summary import FleetResult
from refu_lab.fleet.replay import _CODE, _content
from tests.lab import fleet_tasks
from tests.lab.test_replay import motion, write_bag

FAST = ["--garments", "short-pant-male", "--backbone", "skinned", "--sdf", "none", "--no-collider", "--quiet"]


ROW: dict[str, Any] = {"input": "", "frames": 1, "skipped": {}, "latency_ms": {"p50": 1.0, "p95": 1.0}, "garments": {}}


def frames(shift: float = 0.0) -> list[SmplFrame]:
    return [replace(frame, transl=frame.transl + shift) for frame in motion(2)]


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three bags in two folders, and a file that isn't one."""
    folder = tmp_path_factory.mktemp("fleet") / "bags"
    for i, name in enumerate(("a/walk.mcap", "a/turn.mcap", "b/walk.mcap")):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        write_bag(folder / name, frames(0.1 * i))
    (folder / "b" / "broken.mcap").write_bytes(b"not a bag at all")
    return folder


def run(*arguments: object) -> int:
    return main([*map(str, ("replay", *arguments)), *FAST])


def content(folder: Path) -> dict[str, bytes]:
    """Every bag, and every record without what no two runs share."""
    found = {}
    for file in sorted(folder.rglob("*")):
        if file.suffix == ".mcap":
            found[str(file.relative_to(folder))] = file.read_bytes()
        elif file.suffix == ".json":
            found[str(file.relative_to(folder))] = json.dumps(_timeless(json.loads(file.read_text()))).encode()
    return found


def _timeless(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _timeless(v) for k, v in value.items() if k not in ("latency_ms", "output", "kept", "hash")}
    return [_timeless(one) for one in value] if isinstance(value, list) else value


# ---- what is found ---------------------------------------------------------------------------------------------------


def names(*inputs: object) -> list[str]:
    return [recording.name for recording in find_recordings([str(one) for one in inputs])]


def test_folders_globs_and_urls_stand_for_the_same(bags: Path) -> None:
    wanted = ["a/turn", "a/walk", "b/broken", "b/walk"]
    assert names(bags) == wanted
    assert names(f"{bags}/**/*.mcap") == wanted
    assert names(f"file://{bags}") == wanted
    assert names(f"file://{bags}/*/*.mcap") == wanted
    assert names(bags / "a", bags / "b", bags) == wanted
    assert names(bags / "a" / "walk.mcap") == ["walk"]
    with pytest.raises(RefuError, match="no recording there"):
        names(f"{bags}/*.mcap")


def test_what_lies_beside_motions_is_no_recording(tmp_path: Path) -> None:
    for name in ("walk_poses.npz", "RUN.BVH", "shape.npz", "neutral_stagei.npz", "._walk_poses.npz", ".old.mcap"):
        (tmp_path / name).touch()
    assert names(tmp_path) == ["RUN", "walk_poses"]


def test_a_full_disk_is_said_of_the_place_that_was_asked_for(tmp_path: Path) -> None:
    """Results are written beside their places first, in folders whose names nobody knows."""

    def write() -> None:
        with Folder(f"{tmp_path}/").scratch() as own:
            (own / "a" / "b.mcap").mkdir(parents=True)
            BagWriter(own / "a" / "b.mcap", overwrite=True)

    with pytest.raises(RefuError, match=f"^{tmp_path}/a/b.mcap: can't be written"):
        write()


def test_results_among_the_recordings_are_not_replayed(bags: Path, tmp_path: Path, capsys: Any) -> None:
    folder = tmp_path / "bags"
    shutil.copytree(bags / "a", folder)
    for _ in range(2):
        assert run(folder, "--output", folder / "out") == 0
        assert "2 of 2 recordings replayed" in capsys.readouterr().out
    (tmp_path / "link").symlink_to(folder)
    for results in (str(folder / "out"), f"file://{folder}/out/", str(tmp_path / "link" / "out")):
        for text in (str(folder), f"file://{folder}", f"{tmp_path}/**/*.mcap"):
            found = [one.source for one in find_recordings([text], results=[None, results])]
            assert found
            assert not any("/out/" in source for source in found)
        with pytest.raises(RefuError, match="no recording there beside the results"):
            find_recordings([str(folder / "out")], results=[results])
    before = [path.read_bytes() for path in sorted(folder.glob("*.mcap"))]
    assert run(folder, "--output", folder) == 2
    assert [path.read_bytes() for path in sorted(folder.glob("*.mcap"))] == before


def test_one_recording_is_one_replay_as_ever(bags: Path, tmp_path: Path) -> None:
    split = tmp_path / "long"
    split.mkdir()
    for i in range(2):
        shutil.copy(bags / "a" / "walk.mcap", split / f"long_{i}.mcap")
    assert names(split) == ["long"]
    assert is_plain([str(split)])
    assert is_plain([str(bags / "a" / "walk.mcap")])
    assert is_plain(["bags/walk"])
    assert is_plain(["there/is/none.mcap"])  # said by its reader
    for several in ([str(bags)], [str(bags / "a"), str(split)], [f"{bags}/a/*.mcap"], ["s3://bucket/walk.mcap"]):
        assert not is_plain(several)


@given(st.sets(st.from_regex(r"[ab]{1,2}(/[ab]{1,2}){0,2}\.(mcap|npz|db3)", fullmatch=True), min_size=1, max_size=8))
def test_no_two_recordings_have_one_name(tmp_path_factory: pytest.TempPathFactory, paths: set[str]) -> None:
    folder = tmp_path_factory.mktemp("names")
    for path in paths:
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).touch()
    found = find_recordings([str(folder / path) for path in sorted(paths)])
    assert len({recording.name for recording in found}) == len(paths)
    assert not any(recording.name.startswith(("/", "..")) for recording in found)
    assert not any(one.name.startswith(f"{other.name}/") for one in found for other in found)  # its report is a folder


def test_stores_with_the_same_paths_give_recordings_names_of_their_own(tmp_path: Path) -> None:
    """Both were called walk.mcap: the second one's bag replaced the first one's."""
    store = fsspec.filesystem("memory")
    for folder in (tmp_path, tmp_path / "a"):
        folder.mkdir(exist_ok=True)
        (folder / "walk.mcap").touch()
        store.pipe(f"{folder}/walk.mcap", b"x")
    try:
        assert names(tmp_path, f"memory://{tmp_path}") == ["walk", "a/walk", "memory:/walk", "memory:/a/walk"]
    finally:
        store.store.clear()


def test_no_result_leaves_its_folder(bags: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`refu replay walk.mcap ../b --output out` wrote out/../b/walk.mcap."""
    monkeypatch.chdir(bags / "a")
    assert names("walk.mcap", "../b", "../a/walk.mcap") == ["a/walk", "b/broken", "b/walk"]
    store = fsspec.filesystem("memory")
    for name in ("/fleet/bag/metadata.yaml", "/fleet/bag/../../../home/.bashrc", "/fleet/../../evil.mcap"):
        store.store[name] = MemoryFile(store, name, b"x")
    try:
        with pytest.raises(RefuError, match=r"wanted a name without '\.\.', which leads out of a folder"):
            names("memory://fleet/**")
        with pytest.raises(RefuError, match="wanted names without"), fetched("memory://fleet/bag"):
            pass
    finally:
        store.store.clear()


# ---- what is done ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def alone(bags: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of one process."""
    folder = tmp_path_factory.mktemp("alone") / "out"
    assert run(bags, "--output", folder) == 2
    return folder


def test_what_there_is_to_warn_of_is_said_of_many_as_of_one() -> None:
    """A night of files in centimetres, or in other axes, isn't taken for granted in silence."""
    rows = [{"name": f"{i}", "input": "", "error": "bad"} for i in range(2)]
    rows += [{"name": f"r{i}", **ROW, "warnings": ["z up <is> taken", *["cm"][: i == 1]]} for i in range(3)]
    result = FleetResult(rows=rows)
    said = ["z up <is> taken (r0 and 2 others)", "cm (r1)"]
    assert [line for line in fleet_table(result).splitlines() if "warning" in line] == [
        f"warning: {one}" for one in said
    ]
    assert '<p class="warn">z up &lt;is&gt; taken (r0 and 2 others)</p><p class="warn">cm (r1)</p>' in result.page()
    two = FleetResult(rows=[{"name": f"r{i}", **ROW, "warnings": ["cm"]} for i in range(2)])
    assert two.warnings() == ["cm (r0 and 1 other)"]
    many = FleetResult(rows=[{"name": "r", **ROW, "warnings": [str(i) for i in range(25)]}])
    assert many.warnings()[-1] == "15 other warnings: --json names all"


def test_names_of_files_are_no_commands_to_the_terminal() -> None:
    rows = [
        ROW | {"name": f"\x1b[2J{i}", "warnings": [f"odd {i}"], **more} for i, more in enumerate(({}, {"error": "x"}))
    ]
    assert fleet_table(FleetResult(rows)).replace("\n", "").isprintable()


def test_a_bad_bag_is_reported_and_the_rest_is_done(bags: Path, alone: Path, tmp_path: Path, capsys: Any) -> None:
    assert {path for path in content(alone) if path.endswith(".mcap")} == {"a/turn.mcap", "a/walk.mcap", "b/walk.mcap"}
    assert run(bags, "--output", alone, "--json", tmp_path / "all.json") == 2
    printed = capsys.readouterr().out
    assert "3 of 4 recordings replayed" in printed
    assert "b/broken: " in printed
    assert "not an MCAP file" in printed
    summary = json.loads((tmp_path / "all.json").read_text())
    assert (summary["recordings"], summary["failed"], summary["frames"]) == (4, 1, 6)
    rows = [row for row in summary["rows"] if "error" not in row]
    (garment,) = summary["garments"].values()
    shares = [row["garments"]["short-pant-male"]["vfcp_percent"] for row in rows]
    assert garment["vfcp_percent"] == pytest.approx(sum(shares) / 3)
    assert garment["n_frames"] == 6
    order = [frame["badness"] for frame in summary["worst"]]
    assert len(order) == 6
    assert order == sorted(order, reverse=True)


@pytest.mark.usefixtures("little_light")
def test_page_over_all_leads_to_each_report(bags: Path, tmp_path: Path) -> None:
    assert run(bags / "b", "--report", tmp_path / "report") == 2
    page = (tmp_path / "report" / "index.html").read_text()
    assert 'href="walk/index.html"' in page
    assert (tmp_path / "report" / "walk" / "index.html").stat().st_size > 1000
    assert "broken" in page
    assert not list((tmp_path / "report").rglob(".partial"))
    assert not list((tmp_path / "report").rglob(".lock"))


@pytest.mark.usefixtures("little_light")
def test_a_name_that_is_no_text_takes_the_report_from_nobody(bags: Path, tmp_path: Path) -> None:
    odd = tmp_path / os.fsdecode(b"w\xff.mcap")
    odd.write_bytes((bags / "b" / "walk.mcap").read_bytes())
    assert run(odd, bags / "a" / "walk.mcap", "--report", tmp_path / "report") == 0
    page = (tmp_path / "report" / "index.html").read_text()
    assert 'w%FF/index.html"' in page
    assert "w\\udcff" in page


def test_what_is_finished_is_not_done_again(bags: Path, alone: Path, tmp_path: Path, capsys: Any) -> None:
    out = tmp_path / "out"
    shutil.copytree(alone, out)
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*.mcap")}
    (out / "a" / "walk.mcap").write_bytes(b"cut")  # its bag is gone: it isn't finished
    write_bag(tmp_path / "new.mcap", frames(0.7))
    changed = tmp_path / "bags"
    shutil.copytree(bags, changed)
    shutil.copy(tmp_path / "new.mcap", changed / "b" / "walk.mcap")  # another recording under the old name
    assert run(changed, "--output", out) == 2
    assert "1 of them before" in capsys.readouterr().out
    again = {path for path, stamp in before.items() if path.stat().st_mtime_ns != stamp}
    assert again == {out / "a" / "walk.mcap", out / "b" / "walk.mcap"}
    assert (out / "a" / "walk.mcap").read_bytes() == (alone / "a" / "walk.mcap").read_bytes()
    assert run(changed, "--output", out, "--frame-id", "world") == 2  # other options, other results
    assert "0 of them before" in capsys.readouterr().out
    assert run(changed, "--output", out, "--frame-id", "world", "--again") == 2
    assert "0 of them before" in capsys.readouterr().out


def test_a_record_that_was_damaged_counts_for_nothing(bags: Path, tmp_path: Path, capsys: Any) -> None:
    """Whatever is wrong in it, its recording is replayed again."""
    arguments = bags / "a", "--output", tmp_path, "--no-evaluate"
    assert run(*arguments) == 0
    record, (whole, other) = (
        tmp_path / "walk.json",
        ((tmp_path / f"{name}.json").read_text() for name in ("walk", "turn")),
    )
    content = json.loads(whole)
    for damaged in (
        content | {"frames": "many"},
        content | {"latency_ms": None},
        content | {"worst": {}},
        {name: value for name, value in content.items() if name != "skipped"},
        json.loads(other) | {"key": content["key"]},
    ):
        record.write_text(json.dumps(damaged))
        capsys.readouterr()
        assert run(*arguments) == 0
        assert "2 of 2 recordings replayed, 1 of them before" in capsys.readouterr().out
        assert _timeless(json.loads(record.read_text())) == _timeless(content)
    assert run(*arguments) == 0
    assert "2 of 2 recordings replayed, 2 of them before" in capsys.readouterr().out


def test_a_result_takes_the_place_of_results_alone(bags: Path, tmp_path: Path, capsys: Any) -> None:
    """Recordings of the same names in the folder of outputs, and a page's folder that holds something else, stay."""
    bag, record, page = (tmp_path / name for name in ("out/walk.mcap", "out2/walk.json", "report/walk/notes.txt"))
    for mine in (bag, record, page):
        mine.parent.mkdir(parents=True)
        mine.write_text('{"years": "of work"}')
    for more in (["--output", tmp_path / "out"], ["--output", tmp_path / "out2"], ["--report", tmp_path / "report"]):
        assert run(bags / "b", *more, *(["--no-evaluate"] if "--output" in more else [])) == 2
        assert "is there already, and no result of refu replay" in capsys.readouterr().out
    assert {mine.read_text() for mine in (bag, record, page)} == {'{"years": "of work"}'}
    assert run(bags / "b", "--output", tmp_path / "out", "--no-evaluate", "--overwrite") == 2
    (tmp_path / "out" / "walk.json").unlink()  # as after a kill between the two
    capsys.readouterr()
    assert run(bags / "b", "--output", tmp_path / "out", "--no-evaluate") == 2
    assert "no result of" not in capsys.readouterr().out
    assert (tmp_path / "out" / "walk.json").exists()


def test_results_by_url_are_those_by_path(bags: Path, tmp_path: Path, capsys: Any) -> None:
    arguments = [f"file://{bags}/a", "--output", f"file://{tmp_path}/out", "--no-evaluate"]
    assert run(bags / "a", "--output", tmp_path / "by-path", "--no-evaluate") == 0
    assert run(*arguments) == 0
    assert run(*arguments) == 0
    said = capsys.readouterr().out
    assert "2 of 2 recordings replayed, 2 of them before" in said
    assert "NAME.mcap" in said
    for name in ("walk", "turn"):
        by_url, by_path = ((tmp_path / folder / f"{name}.mcap").read_bytes() for folder in ("out", "by-path"))
        is_same = by_url == by_path  # pytest would look for all differences of a million bytes
        assert is_same
    record = json.loads((tmp_path / "out" / "walk.json").read_text())
    assert (record["frames"], record["garments"], record["worst"]) == (2, {}, [])


def messages(path: Path) -> list[tuple[str, int, bytes]]:
    """All but the diagnostics, which say what evaluation has found."""
    with BagReader(path) as bag:
        every = [(one.topic, one.log_time_ns, bytes(one.data)) for one in bag.messages()]
    assert {topic for topic, *_ in every} > {"/garments", "/body"}
    return [one for one in every if one[0] != "/diagnostics"]


def test_results_depend_on_garments_and_weights_of_ones_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("REFU_GARMENTS", str(tmp_path))
    options = ReplayOptions(input=Path(), garments=("kilt",), weights=str(tmp_path / "weights"))
    (tmp_path / "weights" / "kilt").mkdir(parents=True)
    seen = []
    for file, content in itertools.product(("weights/kilt/tailornet-hybrid.safetensors", "kilt.npz"), (b"1", b"2")):
        (tmp_path / file).write_bytes(content)
        seen.append(_content(options))
    assert len(set(seen)) == 4


def test_finished_results_stay_so_when_modules_are_compiled() -> None:
    root = Path(__file__).parents[2]
    kinds = {path.suffix for pattern in _CODE for path in root.glob(pattern) if path.is_file()}
    assert kinds == {".py", ".npz", ".json", ".safetensors"}


def test_conversion_alone_gives_the_same_bag(bags: Path, alone: Path, tmp_path: Path, capsys: Any) -> None:
    bag = bags / "a" / "walk.mcap"
    assert run(bag, "--no-evaluate", "--output", tmp_path / "walk.mcap", "--json", tmp_path / "out.json") == 0
    assert "2 frames, not evaluated" in capsys.readouterr().out
    converted, evaluated = (messages(path) for path in (tmp_path / "walk.mcap", alone / "a" / "walk.mcap"))
    is_same = converted == evaluated
    assert is_same
    assert json.loads((tmp_path / "out.json").read_text())["frames"] == 2
    assert run(bag, "--no-evaluate", "--report", tmp_path / "report") == 2


def test_without_dask_one_line_says_what_to_install(bags: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    monkeypatch.setattr("refu_lab.fleet._engine.find_spec", lambda _: None)
    assert run(bags, "--jobs", "2") == 2
    error = capsys.readouterr().err
    assert 'pip install "refu-ros[cluster]"' in error
    assert error.count("\n") == 1


# ---- many processes --------------------------------------------------------------------------------------------------


@pytest.fixture
def scheduler(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """A scheduler and two workers, as a cluster has them: processes of their own."""
    pytest.importorskip("distributed")
    file = tmp_path / "scheduler.json"
    monkeypatch.setenv("REFU_TEST_MARK", str(tmp_path / "mark"))
    monkeypatch.setattr("refu_lab.fleet._engine.CONNECT_S", 300.0)  # a busy machine's answers late
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
    started = [
        subprocess.Popen(
            [sys.executable, "-m", f"distributed.cli.{kind}", "--scheduler-file", str(file), *options],
            env=environment,
            cwd=tmp_path,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        for kind, options in (
            ("dask_scheduler", ["--no-dashboard", "--host", "127.0.0.1", "--port", "0"]),
            ("dask_worker", ["--nworkers", "2", "--nthreads", "1", "--no-dashboard", "--death-timeout", "300"]),
        )
    ]
    try:
        deadline, found = time.monotonic() + 300, ""
        while not found.endswith("}") and time.monotonic() < deadline:  # it is there before all is in it
            time.sleep(0.05)
            found = file.read_text() if file.exists() else ""
        yield json.loads(found)["address"], started[0]
    finally:
        for process in started:
            os.killpg(process.pid, signal.SIGKILL)  # with what they have started
            process.wait(60)


def test_killed_workers_lose_and_double_nothing(
    scheduler: tuple[str, subprocess.Popen[bytes]],
    bags: Path,
    alone: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: Any,
) -> None:
    """A worker dies with a task that then succeeds, one with a task that ends each; the same cluster replays on."""
    address, process = scheduler
    with open_engine(None, address) as engine:
        found = sorted(engine.run(run_function(fleet_tasks.square_unless_first), list(range(20))))
        assert found == [(n, n * n) for n in range(20)]
        assert Path(os.environ["REFU_TEST_MARK"]).exists()
        assert isinstance(engine, DaskEngine)
        engine.client.run_on_scheduler(
            fleet_tasks.allow_no_failure
        )  # else each of six workers would have to start and die
        ((_, lost),) = engine.run(run_function(fleet_tasks.die), [0])
        assert isinstance(lost, Lost)
        assert "out of memory?" in lost.reason
    out = tmp_path / "elsewhere" / "out"
    out.parent.mkdir()
    monkeypatch.chdir(out.parent)  # where no worker is
    assert run(bags, "--scheduler", address, "--output", "out") == 2
    assert "3 of 4 recordings replayed, 0 of them before" in capsys.readouterr().out
    assert content(out) == content(alone)

    with open_engine(None, address) as engine:
        results = engine.run(run_function(time.sleep), [600.0, 0.0, 0.0])  # which of two workers gets which is chance
        assert next(results) in [(1, None), (2, None)]
        process.kill()
        with pytest.raises(FleetError, match="same command again"):
            list(results)
    assert run(bags, "--output", out) == 2  # goes on, here without any
    printed = capsys.readouterr()
    assert "3 of 4 recordings replayed, 3 of them before" in printed.out
    assert "Traceback" not in printed.err


IN_A_DESTRUCTOR = (
    "import signal; from distributed import Future\n"
    "def once(future, then=Future.__del__): Future.__del__ = then; signal.raise_signal(signal.SIGINT); then(future)\n"
    "Future.__del__ = once\n"
)


@pytest.mark.parametrize("first", ["", IN_A_DESTRUCTOR], ids=["any time", "in a destructor"])
def test_ctrl_c_ends_the_processes_in_silence(first: str) -> None:
    pytest.importorskip("distributed")
    code = first + (
        "import time; from refu_lab.fleet._engine import open_engine, run_function\n"
        "with open_engine(2) as engine:\n"
        "    try:\n"
        "        for _ in engine.run(run_function(time.sleep), [600.0, 0.0]): print('up', flush=True)\n"
        "    except KeyboardInterrupt: print('interrupted', flush=True)\n"
    )
    command = [sys.executable, "-c", code]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True) as process:
        assert process.stdout is not None
        if not first:
            assert process.stdout.readline() == b"up\n"
            os.killpg(process.pid, signal.SIGINT)  # to all of them, as a terminal does
        out, error = process.communicate()
    assert (out.removeprefix(b"up\n"), error, process.returncode) == (b"interrupted\n", b"", 0)


def test_no_scheduler_at_the_address_is_one_line(bags: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr("refu_lab.fleet._engine.CONNECT_S", 0.5)
    assert run(bags, "--scheduler", "tcp://127.0.0.1:9") == 2
    error = capsys.readouterr().err
    assert "no Dask scheduler at tcp://127.0.0.1:9" in error
    assert error.count("\n") == 1
    assert run(bags, "--scheduler", "tcp://127.0.0.1:9", "--jobs", "2") == 2


def test_engine_in_this_process_keeps_the_order() -> None:
    assert list(InProcess().run(run_function(fleet_tasks.square), [3, 1])) == [(0, 9), (1, 1)]
