"""Writing bags as rosbag2 of ROS 2 Jazzy does: MCAP of profile ros2 in compressed chunks, metadata.yaml beside it."""

from __future__ import annotations

import errno
import os
from collections.abc import Collection, Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import BinaryIO

from msg_adapters.bags import _metadata
from msg_adapters.bags._mcap_writer import McapWriter
from msg_adapters.definitions import full_type_name, message_definition
from msg_adapters.errors import BagError
from refu_core._files import check_no_dead_link
from refu_core._numbers import NOT_NUMBERS, as_whole

LIBRARY = "refu-ros"
"""The writer's name in a bag, within its first 64 bytes."""
_DEFAULT_QOS = _metadata.QosProfile()
_PARTIAL = ".partial"
"""Suffix of files that aren't complete yet."""


class BagWriter:
    """Writes one bag: a single file where `path` ends in `.mcap`, otherwise a rosbag2 directory.

    Each full chunk is handed to the operating system: a process that is killed leaves a file that can be read up to
    there. A power cut, too, leaves what came before the last `sync`, and all of a finished bag. Leaving the `with`
    block finishes the bag, also after an exception.

    With `in_background`, a separate thread packs and writes each full chunk while the caller goes on. A kill then also
    loses the chunk that this thread is working on, and a disk error is raised by a later call.

    With `overwrite`, a bag that is there already stays until the new one is finished and takes its place.

    Raises `BagError` when the path can't be written, or holds something and `overwrite` isn't set, or holds files that
    aren't a bag's; nothing is left behind then.
    """

    def __init__(
        self, path: str | Path, *, chunk_bytes: int = 1 << 20, overwrite: bool = False, in_background: bool = False
    ) -> None:
        self.path = Path(path)
        self._directory = None if self.path.suffix == ".mcap" else self.path
        self._old: list[Path] = []
        """Files of the bag that was there before."""
        self._made: list[Path] = []
        """Files and folders that this writer made, in order."""
        self._entered: list[Path] = []
        """Directories with entries that a power cut could still lose."""
        self._topics: dict[str, _metadata.TopicSummary] = {}
        self._finished = False
        try:
            with self._writing():
                name = self.path.absolute().name  # fails in a folder that was removed
                self.file_path = self.path if self._directory is None else self.path / f"{name}_0.mcap"
                """The MCAP file itself."""
                self._target = self._working = self.file_path
                """Where that is, with links followed, and the file that is written until it is complete."""
                self._stream = self._open(overwrite=overwrite)
                self._writer = McapWriter(self._stream, chunk_bytes=chunk_bytes, in_background=in_background)
                self._writer.start(profile="ros2", library=LIBRARY)
        except BagError:
            self.discard()
            raise

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        with nullcontext() if error is None else suppress(BagError):  # the original error says more
            self.finish()

    @property
    def topics(self) -> Collection[str]:
        """Names of the topics declared so far."""
        return self._topics.keys()

    @property
    def n_whole(self) -> int:
        """How many messages are in whole chunks: those that the file keeps where it can't be written any further."""
        return self._writer.n_whole

    def add_topic(
        self,
        topic: str,
        message_type: str,
        *,
        definition: str | None = None,
        type_hash: str | None = None,
        qos: _metadata.QosProfile = _DEFAULT_QOS,
        betas_of: str = "",
    ) -> None:
        """Declare a topic before its first message; declaring it again with the same type does nothing.

        `definition` (`ros2msg` text) and `type_hash` are built in for the types of this project. `betas_of` says whose
        shape space the messages' β belong to: `builtin`, or nothing. It is kept in the topic's metadata and read back
        as `TopicInfo.betas_of`; other readers ignore it.

        Raises `BagError` for a type that isn't built in and has no definition, and for a second type on one topic.
        """
        message_type = full_type_name(message_type)
        known = self._topics.get(topic)
        if known is not None:
            if known.message_type != message_type:
                msg = f"{self.path}: {topic} already carries {known.message_type}, it can't carry {message_type} too"
                raise BagError(msg)
            return
        if definition is None:
            builtin = message_definition(message_type)
            definition, type_hash = builtin.text, type_hash or builtin.type_hash
        metadata = {"offered_qos_profiles": qos.to_yaml(), "topic_type_hash": type_hash or ""}
        metadata |= {_metadata.BETAS_OF: betas_of} if betas_of else {}
        with self._writing():
            channel = self._writer.add_channel(topic, message_type, definition, metadata)
        self._topics[topic] = _metadata.TopicSummary(topic, message_type, type_hash or "", qos, channel)

    def write(self, topic: str, data: bytes, *, log_time_ns: int) -> None:
        """Append a message in CDR, sent and received at `log_time_ns`.

        Raises `BagError` for an undeclared topic, a time that rosbag2 can't hold, and when writing fails.
        """
        if topic not in self._topics:
            raise BagError(f"{self.path}: {topic} isn't declared; call add_topic first")
        try:
            time_ns = as_whole(log_time_ns)
        except NOT_NUMBERS:
            time_ns = -1
        if not 0 <= time_ns <= _metadata.MAX_TIME_NS:
            raise BagError(f"{self.path}: a bag's times are nanoseconds in [0, 2^63), got {log_time_ns!r}")
        with self._writing():
            self._writer.add_message(self._topics[topic].channel, data, log_time_ns=time_ns)

    def sync(self) -> None:
        """Bring everything that was written so far to the disk, where it survives a power cut and can be read.

        Ends the chunk under way, so it shouldn't be called for each message. Blocks until the disk has it all.

        Raises `BagError` when writing fails.
        """
        with self._writing():
            self._writer.flush()
            self._sync_stream()

    def finish(self) -> None:
        """Write what is buffered, the summary and the metadata, and bring it to the disk; a second call does nothing.

        Raises `BagError` when writing fails; the file stays readable up to its last whole chunk.
        """
        if self._finished:
            return
        name, topics, written = self.file_path.name, [*self._topics.values()], self._writer
        times = {"start_ns": written.first_ns, "end_ns": written.last_ns}
        text, record = _metadata.dump_metadata(file_name=name, topics=topics, counts=written.counts, **times)
        with self._writing():
            self._writer.add_metadata("rosbag2", {"serialized_metadata": record})
            self._writer.finish()
            self._sync_stream()
            self._finished = True
            self._stream.close()
            for old in self._old:
                old.unlink(missing_ok=True)
            if self._working != self._target:
                self._working.replace(self._target)
                _entries_to_disk(self._target.parent)
            if self._directory is not None:
                # Written under another name first: a reader never sees half of it.
                partial = self._directory / f"{_metadata.METADATA_FILE}{_PARTIAL}"
                with partial.open("w", encoding="utf-8") as file:
                    file.write(text)
                    file.flush()
                    _to_disk(file.fileno())
                partial.replace(self._directory / _metadata.METADATA_FILE)
                _entries_to_disk(self._directory)

    def discard(self) -> None:
        """Remove this unfinished bag; one that was there before stays."""
        self._abandon()
        for path in reversed(self._made):
            with suppress(OSError):  # a directory that somebody else has put something into
                path.rmdir() if path.is_dir() else path.unlink()

    def _sync_stream(self) -> None:
        _to_disk(self._stream.fileno())
        if not os.path.samestat(os.fstat(self._stream.fileno()), self._working.stat()):
            raise OSError(errno.ESTALE, "another file has taken its place")
        while self._entered:  # a file whose directory entry isn't on the disk is lost with all its content
            _entries_to_disk(self._entered[-1])
            self._entered.pop()

    def _open(self, *, overwrite: bool) -> BinaryIO:
        name = str(self.file_path)
        if name.encode(errors="replace").decode() != name:  # metadata and diagnostics, which name it, are UTF-8
            raise BagError(f"{self.path}: wanted a name in UTF-8, as a bag's metadata has it")
        if self._directory is not None and self._directory.exists():
            self._old = self._own_files(self._directory, overwrite=overwrite)
        parent = self.file_path.absolute().parent
        for folder in reversed([folder for folder in (parent, *parent.parents) if not folder.exists()]):
            check_no_dead_link(folder, error=BagError)
            folder.mkdir(exist_ok=True)
            self._made.append(folder)
        self._entered = [*(folder.parent for folder in self._made), parent]
        if overwrite and self.file_path.is_fifo():
            raise BagError(f"{self.path}: a FIFO; choose another path")
        if overwrite and (self._old or self.file_path.is_file()):
            self._target = Path(os.path.realpath(self.file_path))
            self._working = self._target.with_name(f"{self._target.name}{_PARTIAL}")
        is_new = self._working != self.file_path or not self.file_path.exists()
        try:
            stream = self._working.open("wb" if overwrite else "xb")
        except FileExistsError as error:
            raise BagError(
                f"{self.path}: exists already; choose another path, or --overwrite it (overwrite=True in Python)"
            ) from error
        if is_new:
            self._made.append(self._working)
        return stream

    def _own_files(self, directory: Path, *, overwrite: bool) -> list[Path]:
        """The files of the bag in a directory; raises `BagError` if it mustn't be replaced, or isn't alone there."""
        found = [*directory.iterdir()]
        own = {f"{directory.absolute().name}_0.mcap", _metadata.METADATA_FILE}
        with suppress(BagError):
            own |= {file.name for file in _metadata.read_file_paths(directory)}
        others = [file.name for file in found if file.name.removesuffix(_PARTIAL) not in own]
        if found and (others or not overwrite):
            foreign = f"it holds other files than a bag's: {others[0]}" if overwrite else ""
            hint = foreign or "choose another path, or --overwrite it (overwrite=True in Python)"
            raise BagError(f"{directory}: the directory isn't empty; {hint}")
        return [file for file in found if not file.name.endswith(_PARTIAL)]

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Turn file system errors into a `BagError` of one line, and leave a readable file whatever interrupts."""
        if self._finished:
            raise BagError(f"{self.path}: the bag is finished; nothing can be added")
        try:
            yield
        except BagError:
            raise
        except (OSError, ValueError) as error:  # ValueError: a name that no file system takes
            self._abandon()
            raise BagError(f"{self.path}: can't be written: {getattr(error, 'strerror', None) or error}") from error
        except BaseException:
            self._abandon()
            raise

    def _abandon(self) -> None:
        """Cut the file back to its last whole chunk: the writer's state isn't known any more."""
        self._finished = True
        stream, writer = getattr(self, "_stream", None), getattr(self, "_writer", None)
        if stream is None or stream.closed:
            return
        if writer is not None:
            writer.close()
        descriptor = os.dup(stream.fileno())  # by now its name may belong to another file
        with suppress(OSError):  # `close` tries to write what is buffered
            stream.close()
        with suppress(OSError):  # readers cope with a torn end as well
            os.ftruncate(descriptor, 0 if writer is None else writer.whole)
        os.close(descriptor)


def _to_disk(descriptor: int) -> None:
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # what isn't kept on a disk can't be synced to one
            raise


def _entries_to_disk(directory: Path) -> None:
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        _to_disk(descriptor)
    finally:
        os.close(descriptor)
