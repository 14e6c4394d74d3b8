"""Recordings that can't be opened, and what a power cut leaves of those that can."""

from __future__ import annotations

import os
import shutil
import socket
import stat
import subprocess
import sys
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from mcap.exceptions import McapError
from mcap.records import Message
from mcap.stream_reader import StreamReader

from msg_adapters import BagError, BagReader, BagWriter, QosProfile, encoder_for, open_smpl_bag
from refu_core import SmplFrame
from refu_ros._recorder import Recorder, RecorderState

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

TOPIC, TYPE = "/smpl_params", "std_msgs/msg/Float32MultiArray"
PERIOD_S = 1.0
SLACK_S = 0.5
"""What a busy machine may add: threads that wait for a core, disks that take long."""
NOISE = np.random.default_rng(0).bytes(40_000)
FRAME = encoder_for("multiarray")(SmplFrame(np.zeros(72)))


def put(recorder: Recorder, i: int, data: bytes = FRAME) -> None:
    recorder.put(TOPIC, TYPE, data, time_ns=i, qos=QosProfile())


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
        self.versions.append((time.monotonic(), dict(self.contents), dict(self.entries)))

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
@pytest.mark.parametrize("name", ["new/deep/bag", "bag.mcap"])
def test_what_is_synced_is_never_older_than_the_period(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    period = 0.4
    (tmp_path / "disk").mkdir()
    disk = Disk(tmp_path / "disk")
    monkeypatch.setattr(os, "fsync", disk.fsync)
    recorder = Recorder(disk.root / name, sync_period=period)
    came = []
    for i in range(25):
        came.append(time.monotonic())
        put(recorder, i)
        time.sleep(1 / 30)
    time.sleep(period + SLACK_S)  # nobody sends any more, and no message is left behind
    assert recorder.state().at_risk_s == 0
    before_the_end = len(disk.versions)
    recorder.close()

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
    assert max(np.subtract(durable, came)) < period + SLACK_S
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
    done = subprocess.run(["mount", "-o", "loop", image, place], capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip(f"no image of a disk can be mounted here: {done.stderr.strip()}")


def after_a_cut(image: Path, path: str, read: Callable[[Path], Any]) -> tuple[Any, float]:
    """What is read at `path` when the power goes now, and when that was.

    Two equal copies one after the other show the disk as it was between them.
    """
    last, content, moment = b"", image.read_bytes(), time.monotonic()
    while content != last:
        last, content, moment = content, image.read_bytes(), time.monotonic()
    copy = image.with_name("copy.img")
    copy.write_bytes(content)
    place = image.with_name("copy")
    place.mkdir(exist_ok=True)
    mounted(copy, place)
    try:
        return read(place / path), moment
    finally:
        subprocess.run(["umount", "--lazy", place], check=True)


@dataclass
class Load:
    """Messages of some size at 30 Hz, as long as the `with` block lasts."""

    recorder: Recorder
    came: list[float] = field(default_factory=list)
    _stop: threading.Event = field(default_factory=threading.Event)

    def __enter__(self) -> Load:
        self._thread = threading.Thread(target=self._run)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stop.wait(1 / 30):
            self.came.append(time.monotonic())
            put(self.recorder, len(self.came) - 1, NOISE)


def test_a_power_cut_takes_no_more_than_the_period(ext4: tuple[Path, Path]) -> None:
    image, place = ext4
    recorder = Recorder(place / "bags" / "today", sync_period=PERIOD_S)
    with Load(recorder) as load:
        for pause in (1.9, 0.3, 0.3):
            time.sleep(pause)
            found, moment = after_a_cut(image, "bags/today", times)
            lost = [came for came in load.came if came <= moment][len(found) :]
            assert found == list(range(len(found)))
            assert found
            assert all(came > moment - PERIOD_S - SLACK_S for came in lost)
    recorder.close()
    whole, _ = after_a_cut(image, "bags/today", open_and_count)
    assert whole == (len(load.came), [])


def open_and_count(path: Path) -> tuple[int, list[str]]:
    assert (path / "metadata.yaml").stat().st_size
    reader = BagReader(path)
    return sum(1 for _ in reader.messages()), reader.warnings


def test_a_disk_that_is_not_waited_for_loses_more(ext4: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    """The test above can fail."""
    image, place = ext4
    monkeypatch.setattr(os, "fsync", lambda _: None)
    recorder = Recorder(place / "bag")
    with Load(recorder):
        time.sleep(0.5)
    recorder.close()
    left, _ = after_a_cut(image, "bag/bag_0.mcap", lambda path: path.exists() and path.stat().st_size)
    assert not left


def test_a_backlog_is_not_synced_message_by_message(tmp_path: Path) -> None:
    syncs = []

    class Slow(BagWriter):
        def write(self, *args: Any, **options: Any) -> None:
            time.sleep(0.01)  # each message has waited for half the period, and longer
            super().write(*args, **options)

        def sync(self) -> None:
            syncs.append(time.monotonic())
            super().sync()

    recorder = Recorder(tmp_path / "bag", sync_period=0.2, open_bag=Slow)
    for i in range(50):
        put(recorder, i)
    recorder.close()
    assert times(tmp_path / "bag") == list(range(50))
    assert len(syncs) > 2
    assert min(np.diff(syncs)) >= 0.1


def test_the_diagnostics_know_what_is_at_risk(tmp_path: Path) -> None:
    gate = threading.Event()

    class Stalled(BagWriter):
        def sync(self) -> None:
            gate.wait()
            super().sync()

    recorder = Recorder(tmp_path / "bag", sync_period=0.02, open_bag=Stalled)
    put(recorder, 1)
    time.sleep(0.1)
    state: RecorderState = recorder.state()
    assert state.at_risk_s >= 0.1
    put(recorder, 2)  # which doesn't wait for the disk either
    gate.set()
    recorder.close()
    assert recorder.state().at_risk_s == 0
