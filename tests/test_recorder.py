"""Recordings that can't be opened, and what a power cut leaves of those that can."""

from __future__ import annotations

import os
import shutil
import socket
import stat
import subprocess
import sys
import threading
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from mcap.exceptions import McapError
from mcap.records import Message
from mcap.stream_reader import StreamReader

from msg_adapters import BagError, BagReader, BagWriter, QosProfile, encoder_for, open_smpl_bag
from msg_adapters.bags import Recorder
from refu_core import SmplFrame
from tests.virtual_time import VirtualTime

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

TOPIC, TYPE = "/smpl_params", "std_msgs/msg/Float32MultiArray"
PERIOD_S = 1.0
RATE = 30
"""Messages a second."""
NOISE = np.random.default_rng(0).bytes(40_000)
FRAME = encoder_for("multiarray")(SmplFrame(np.zeros(72)))


def put(recorder: Recorder, i: int, data: bytes = FRAME) -> None:
    recorder.put(TOPIC, TYPE, data, time_ns=i, qos=QosProfile())


@pytest.fixture
def time(monkeypatch: pytest.MonkeyPatch) -> VirtualTime:
    """That of the recorder: its promises in seconds hold to the microsecond, and no machine is too busy for them."""
    time = VirtualTime()
    time.rules("msg_adapters.bags._recorder", monkeypatch)
    return time


def times(path: Path) -> list[int]:
    """Log times of the messages in a bag, as our reader and mcap's find them; they must agree."""
    reader = BagReader(path)
    ours = [message.log_time_ns for message in reader.messages()]
    theirs: list[int] = []
    (file,) = path.glob("*.mcap") if path.is_dir() else (path,)
    with file.open("rb") as stream:
        try:
            theirs.extend(record.log_time for record in StreamReader(stream).records if isinstance(record, Message))
        except McapError:
            assert reader.truncated
    assert ours == theirs
    return ours


# Paths --------------------------------------------------------------------------------------------

LONG = "x" * 251  # its directory can be made, its file can't


def make_socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(path))


BAD_NAMES = ("/", "/dev/null", "/dev/null/bag", "/proc/nope", "~nosuchuser/x", "a\0b", "a\udc80b", "a\x1b[31mb", "a\nb")
IN_THE_WAY = ("file", "fifo", "fifo.mcap", "socket", "file/bag", "loop/bag", "dangling")


@pytest.mark.parametrize("path", [*BAD_NAMES, *IN_THE_WAY, LONG, 300 * "x", 3000 * "x/"])
def test_a_path_that_cannot_be_recorded_to_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, path: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("file").write_text("not a bag")
    os.mkfifo("fifo")
    os.mkfifo("fifo.mcap")
    make_socket(Path("socket"))
    Path("loop").symlink_to("loop")
    Path("dangling").symlink_to("nowhere")
    before = sorted(tmp_path.iterdir())
    running = Recorder(tmp_path / "running")
    with pytest.raises(BagError) as caught:
        Recorder(path)
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) <= 310
    put(running, 7)
    running.close()
    assert times(tmp_path / "running") == [7]
    shutil.rmtree(tmp_path / "running")
    assert sorted(tmp_path.iterdir()) == before  # nothing is left of what didn't begin


def test_a_link_to_a_disk_that_is_not_there_is_said(tmp_path: Path) -> None:
    """It was "File exists" where nothing does."""
    (tmp_path / "usb").symlink_to(tmp_path / "unmounted")
    for path in ("usb", "usb/bag"):
        with pytest.raises(BagError, match=r"usb: a link to .*unmounted, which isn't there; mount its disk"):
            Recorder(tmp_path / path)


def test_ever_new_topics_end_no_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of people who come and go: MCAP numbers topics in 16 bits."""
    monkeypatch.setattr("msg_adapters.bags._recorder._MOST_TOPICS", 3)
    recorder = Recorder(tmp_path / "bag")
    for i in range(6):
        recorder.put(f"/p{i}", TYPE, FRAME, time_ns=2 * i, qos=QosProfile())
        recorder.put("/p0", TYPE, FRAME, time_ns=2 * i + 1, qos=QosProfile())
    recorder.close()
    state = recorder.state()
    assert (state.written, state.dropped, state.error) == (9, 3, "")
    assert times(tmp_path / "bag") == [0, 1, 2, 3, 4, 5, 7, 9, 11]


def test_a_program_that_ends_without_closing_has_a_whole_bag(tmp_path: Path) -> None:
    """Python waits for threads, and the recorder's waited for messages: the program never ended."""
    lines = [
        "from msg_adapters.bags import QosProfile, Recorder",
        "recorder = Recorder('bag')",
        f"recorder.put('/p', {TYPE!r}, bytes(16), time_ns=1, qos=QosProfile())",
        "raise KeyboardInterrupt",
    ]
    path = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])}
    subprocess.run([sys.executable, "-c", "\n".join(lines)], cwd=tmp_path, env=path, timeout=60, check=False)
    assert times(tmp_path / "bag") == [1]
    assert (tmp_path / "bag" / "metadata.yaml").exists()


def test_a_read_only_place_cannot_be_recorded_to(tmp_path: Path) -> None:
    if os.geteuid() == 0:
        place = Path("/proc/sys")  # root may write wherever permissions say no, but not here
    else:
        place = tmp_path
        place.chmod(0o500)
    with pytest.raises(BagError, match="can't be"):
        Recorder(place / "bag")


def test_files_are_numbered_as_directories_are(tmp_path: Path) -> None:
    names = []
    for path in ("bag", "bag", "bag.mcap", "bag.mcap"):
        recorder = Recorder(tmp_path / path)
        recorder.close()
        names.append(recorder.path.name)
    assert names == ["bag", "bag-1", "bag.mcap", "bag-1.mcap"]


def test_a_new_recording_is_open_before_the_old_one_ends(tmp_path: Path) -> None:
    old = Recorder(tmp_path / "bag")
    put(old, 1)
    with pytest.raises(BagError):
        Recorder("/proc/nope")
    new = Recorder(tmp_path / "bag")
    put(old, 2)
    old.close()
    put(new, 3)
    new.close()
    assert (times(old.path), times(new.path)) == ([1, 2], [3])


def test_whatever_goes_wrong_ends_the_recording_and_is_said(tmp_path: Path) -> None:
    class Broken(BagWriter):
        def write(self, *_: Any, **__: Any) -> None:
            raise ZeroDivisionError

    recorder = Recorder(tmp_path / "bag", open_bag=Broken)
    put(recorder, 1)
    recorder.close()
    assert (recorder.running, recorder.state().error, recorder.state().dropped) == (False, "ZeroDivisionError", 1)


# What the disk promises ---------------------------------------------------------------------------

FSYNC = os.fsync


@dataclass
class Disk:
    """What POSIX promises to survive below a directory: the content of a file as of its last fsync, and the entries
    of a directory as of the directory's. Everything else may be lost, and is lost here."""

    root: Path
    time: VirtualTime
    seconds: float = 0.0
    """How long it takes."""
    contents: dict[int, bytes] = field(default_factory=dict)
    """By inode."""
    entries: dict[int, dict[str, tuple[int, bool]]] = field(default_factory=dict)
    """Of each directory by inode: the inode of each name, and whether that is a directory."""
    versions: list[tuple[float, dict[int, bytes], dict[int, dict[str, tuple[int, bool]]]]] = field(default_factory=list)
    """The state after each fsync, and when that returned."""

    def fsync(self, descriptor: int) -> None:
        found = os.fstat(descriptor)
        if stat.S_ISDIR(found.st_mode):
            with os.scandir(descriptor) as entries:
                self.entries[found.st_ino] = {entry.name: (entry.inode(), entry.is_dir()) for entry in entries}
        else:
            self.contents[found.st_ino] = Path(f"/proc/self/fd/{descriptor}").read_bytes()
        FSYNC(descriptor)
        self.time.sleep(self.seconds)
        self.versions.append((self.time.now, dict(self.contents), dict(self.entries)))

    def restore(self, version: int, target: Path) -> float:
        """Puts what survives a cut right after an fsync below `target`; returns when that was."""
        moment, contents, entries = self.versions[version]
        pending = [(self.root.stat().st_ino, True, target)]
        while pending:
            inode, is_directory, path = pending.pop()
            if is_directory:
                path.mkdir()
                pending += [(*child, path / name) for name, child in entries.get(inode, {}).items()]
            else:
                path.write_bytes(contents.get(inode, b""))
        return moment


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="a file is read back through Linux's /proc")
@pytest.mark.parametrize("seconds", [0.0, 0.19], ids=["fast", "slow"])
@pytest.mark.parametrize("name", ["new/deep/bag", "bag.mcap"])
def test_what_is_synced_is_never_older_than_the_period(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, time: VirtualTime, name: str, seconds: float
) -> None:
    """The slow disk takes just less than half the period, which is what the promise holds for."""
    period = 0.4
    (tmp_path / "disk").mkdir()
    disk = Disk(tmp_path / "disk", time)
    monkeypatch.setattr(os, "fsync", disk.fsync)
    recorder = Recorder(disk.root / name, sync_period=period)
    came = [i / RATE for i in range(25)]
    for i, moment in enumerate(came):
        time.at(moment, lambda i=i: put(recorder, i))
    # The first time, the folders' entries get to the disk as well, each in a time of its own.
    time.at(0.5 * period + 1e-9, lambda: setattr(disk, "seconds", seconds))
    in_the_end: list[tuple[float, int]] = []

    def stop() -> None:  # nobody has sent for a while, and no message is left behind
        in_the_end.append((recorder.state().at_risk_s, len(disk.versions)))
        recorder.stop()

    time.at(came[-1] + period + 1e-6, stop)
    time.run()

    ((at_risk, before_the_end),) = in_the_end
    assert at_risk == 0
    durable = [np.inf] * len(came)
    for version in range(len(disk.versions)):
        target = tmp_path / str(version)
        moment = disk.restore(version, target)
        bag = target / name
        found = [] if not bag.exists() else times(bag)
        assert found == list(range(len(found)))
        for i in found:
            durable[i] = min(durable[i], moment)
        if version == before_the_end - 1:
            assert len(found) == len(came)
    assert max(np.subtract(durable, came)) <= period + 1e-9
    assert before_the_end >= 3
    whole = open_smpl_bag(bag)
    assert (len(list(whole)), whole.reader.warnings) == (len(came), [])


@pytest.mark.parametrize("tail", [bytes(100_000), NOISE, b"\x05" + bytes(100_000)], ids=["zeros", "noise", "record"])
def test_what_a_disk_makes_of_the_unsynced_end_costs_nothing_else(tmp_path: Path, tail: bytes) -> None:
    """A file may have grown before the cut without its content."""
    bag = BagWriter(tmp_path / "bag.mcap")
    bag.add_topic(TOPIC, TYPE)
    for i in range(5):
        bag.write(TOPIC, FRAME, log_time_ns=i)
    bag.sync()
    path = tmp_path / "left.mcap"
    path.write_bytes(bag.file_path.read_bytes() + tail)
    reader = BagReader(path)
    assert [message.log_time_ns for message in reader.messages()] == list(range(5))
    assert reader.truncated
    bag.finish()


# A real file system -------------------------------------------------------------------------------


@pytest.fixture
def ext4(tmp_path: Path) -> Iterator[tuple[Path, Path]]:
    """An image of a disk with ext4, and where it is mounted."""
    if not sys.platform.startswith("linux") or os.geteuid() != 0:
        pytest.skip("only Linux's root may mount an image of a disk")
    missing = [tool for tool in ("mkfs.ext4", "mount", "umount") if not shutil.which(tool)]
    if missing:
        pytest.skip(f"{', '.join(missing)} isn't installed: no disk can be cut off")
    image, place = tmp_path / "disk.img", tmp_path / "disk"
    place.mkdir()
    with image.open("wb") as file:
        file.truncate(64 << 20)
    subprocess.run(["mkfs.ext4", "-q", "-F", image], check=True, capture_output=True)
    mounted(image, place)
    yield image, place
    subprocess.run(["umount", "--lazy", place], check=True)


def mounted(image: Path, place: Path) -> None:
    # Left alone, ext4 writes after five seconds what nobody has asked it to write: a test may take longer.
    done = subprocess.run(["mount", "-o", "loop,commit=300", image, place], capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip(f"no image of a disk can be mounted here: {done.stderr.strip()}")


def after_a_cut(image: Path, path: str, read: Callable[[Path], Any]) -> Any:
    """What is read at `path` when the power goes now.

    Two equal copies one after the other show the disk as it was between them.
    """
    last, content = b"", image.read_bytes()
    while content != last:
        last, content = content, image.read_bytes()
    copy = image.with_name("copy.img")
    copy.write_bytes(content)
    place = image.with_name("copy")
    place.mkdir(exist_ok=True)
    mounted(copy, place)
    try:
        return read(place / path)
    finally:
        subprocess.run(["umount", "--lazy", place], check=True)


def load(recorder: Recorder, time: VirtualTime, *, until: float) -> list[float]:
    """Large messages come at 30 Hz, until the recording is stopped; returns when each comes."""
    came = [i / RATE for i in range(int(until * RATE))]
    for i, moment in enumerate(came):
        time.at(moment, lambda i=i: put(recorder, i, NOISE))
    time.at(until, recorder.stop)
    return came


def test_a_power_cut_takes_no_more_than_the_period(ext4: tuple[Path, Path], time: VirtualTime) -> None:
    image, place = ext4
    recorder = Recorder(place / "bags" / "today", sync_period=PERIOD_S)
    came = load(recorder, time, until=3.0)
    cuts = (1.9, 2.2, 2.5, 2.999)
    left: list[list[int]] = []
    for moment in cuts:
        time.at(moment, lambda: left.append(after_a_cut(image, "bags/today", times)))
    time.run()
    for moment, found in zip(cuts, left, strict=True):
        assert found
        assert found == list(range(len(found)))
        lost = [when for when in came if when <= moment][len(found) :]
        assert all(when > moment - PERIOD_S for when in lost)
    assert after_a_cut(image, "bags/today", open_and_count) == (len(came), [])


def open_and_count(path: Path) -> tuple[int, list[str]]:
    assert (path / "metadata.yaml").stat().st_size
    reader = BagReader(path)
    return sum(1 for _ in reader.messages()), reader.warnings


def test_a_disk_that_is_not_waited_for_loses_more(
    ext4: tuple[Path, Path], time: VirtualTime, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The test above can fail."""
    image, place = ext4
    monkeypatch.setattr(os, "fsync", lambda _: None)
    load(Recorder(place / "bag"), time, until=0.5)
    time.run()
    assert not after_a_cut(image, "bag/bag_0.mcap", lambda path: path.exists() and path.stat().st_size)


def test_a_backlog_is_not_synced_message_by_message(tmp_path: Path, time: VirtualTime) -> None:
    syncs = []

    class Slow(BagWriter):
        def write(self, *args: Any, **options: Any) -> None:
            time.sleep(0.01)  # each message has waited for half the period, and longer
            super().write(*args, **options)

        def sync(self) -> None:
            syncs.append(time.now)
            super().sync()

    recorder = Recorder(tmp_path / "bag", sync_period=0.2, open_bag=Slow)
    for i in range(50):
        put(recorder, i)
    recorder.stop()
    time.run()
    assert times(tmp_path / "bag") == list(range(50))
    assert len(syncs) > 2
    assert min(np.diff(syncs)) >= 0.1 - 1e-9


def test_the_diagnostics_know_what_is_at_risk(tmp_path: Path, time: VirtualTime) -> None:
    class Stalled(BagWriter):
        def sync(self) -> None:
            time.sleep(0.3)
            super().sync()

    recorder = Recorder(tmp_path / "bag", sync_period=0.02, open_bag=Stalled)
    at_risk: list[float] = []
    put(recorder, 1)
    for moment in (0.005, 0.1, 0.3):
        time.at(moment, lambda: at_risk.append(recorder.state().at_risk_s))
    time.at(0.2, lambda: put(recorder, 2))
    time.at(0.7, lambda: at_risk.append(recorder.state().at_risk_s))
    time.at(0.7, recorder.stop)
    time.run()
    assert at_risk == pytest.approx([0.005, 0.1, 0.3, 0.0])
    assert recorder.state().at_risk_s == 0


def test_a_disk_that_stalls_holds_nobody_up_who_records(tmp_path: Path) -> None:
    gate = threading.Event()

    class Stalled(BagWriter):
        def sync(self) -> None:
            assert gate.wait(60)
            super().sync()

    recorder = Recorder(tmp_path / "bag", sync_period=1e-6, open_bag=Stalled)
    for i in range(100):
        put(recorder, i)
    gate.set()  # which comes too late for who waits for the disk
    recorder.close()
    assert (recorder.state().error, recorder.state().written, recorder.state().at_risk_s) == ("", 100, 0)


def test_a_disk_that_does_not_answer_holds_nobody_up_who_asks_how_it_goes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As one on a network that has gone: the node's diagnostics waited for it, and with them all inputs."""
    gate, usage = threading.Event(), shutil.disk_usage

    def stalled(path: Path) -> Any:
        assert threading.current_thread().name == "recorder"
        assert gate.wait(60)
        return usage(path)

    monkeypatch.setattr(shutil, "disk_usage", stalled)
    recorder = Recorder(tmp_path / "bag")
    put(recorder, 0)
    assert (recorder.state().written, recorder.state().free_bytes) == (0, None)
    gate.set()
    recorder.close()
    state = recorder.state()
    assert (state.written, state.size_bytes) == (1, (tmp_path / "bag" / "bag_0.mcap").stat().st_size)
    assert state.free_bytes
