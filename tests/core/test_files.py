"""Opening of input files, and text that is safe to print."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from msg_adapters import BagError
from refu_core import BodyError, RefuError
from refu_core._files import open_file, read_file
from refu_core.errors import printable
from tests.limits import refusal, run_limited

read = partial(read_file, most=1000, error=BodyError, wanted="a body")


def fifo(path: Path) -> None:
    os.mkfifo(path)


def link_to_fifo(path: Path) -> None:
    os.mkfifo(path.with_suffix(".fifo"))
    path.symlink_to(path.with_suffix(".fifo"))


def unix_socket(path: Path) -> None:
    here = Path.cwd()
    os.chdir(path.parent)  # the path of a socket is short
    try:
        with socket.socket(socket.AF_UNIX) as made:
            made.bind(path.name)
    finally:
        os.chdir(here)


def sparse(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(1 << 42)


SPECIAL: list[tuple[Callable[[Path], object], str]] = [
    (fifo, "a FIFO; wanted"),
    (link_to_fifo, "a FIFO; wanted"),
    (unix_socket, "a socket; wanted"),
    (Path.mkdir, "a directory; wanted"),
    (Path.touch, "an empty file; wanted"),
    (sparse, "4194304 MiB, at most"),
    (lambda path: path.symlink_to(path), "Too many levels"),
    (lambda path: path.symlink_to("/dev/zero"), "a device; wanted"),
    (lambda path: path.symlink_to("/proc/self/mem"), "an empty file; wanted"),
    (lambda path: path.symlink_to("/proc/self/pagemap"), "an empty file; wanted"),
    (lambda path: path.symlink_to("/proc/kcore"), "can't be read"),
    (lambda path: path.symlink_to("/nowhere"), "No such file or directory; wanted"),
]
"""What may lie where a file is looked for, and what is said of it."""


@pytest.mark.parametrize(("lay", "said"), SPECIAL)
def test_only_regular_files_are_opened(tmp_path: Path, lay: Callable[[Path], object], said: str) -> None:
    path = tmp_path / "x"
    lay(path)
    message = refusal(lambda: read(path))
    assert message.startswith(f"{path}: ")
    with pytest.raises(BodyError, match=said):
        read(path)


@pytest.mark.parametrize("name", ["a\0b", "a\ud800b", "a" * 300, "a\x1b[2Jb" * 20, ""])
def test_names_that_no_file_has(name: str) -> None:
    message = refusal(lambda: read(name))
    assert message.isprintable()


def test_a_file_that_grows_is_read_as_it_was(tmp_path: Path) -> None:
    path = tmp_path / "x"
    path.write_bytes(bytes(1000))
    assert read(path) == bytes(1000)
    with open_file(path, most=1000, error=BagError, wanted="a bag") as file:
        with path.open("ab") as more:
            more.write(b"1")
        assert len(file.read(1000)) == 1000
    with pytest.raises(BodyError, match="at most"):
        read(path)


def test_another_file_may_take_its_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, before = tmp_path / "x", Path(__file__).stat()
    os.mkfifo(path)
    monkeypatch.setattr(Path, "stat", lambda _: before)
    assert "a FIFO" in refusal(lambda: open_file(path, most=1 << 20, error=BodyError, wanted="a body"))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("plain – ä 猫", "plain – ä 猫"),
        ("two\nlines\tand\x00a\x1b[31mcolour", r"two lines and\x00a\x1b[31mcolour"),
        ("\ud800 \u202e \x9b", r"\ud800 \u202e \x9b"),
        (r"\x1b stays", r"\x1b stays"),
    ],
)
def test_messages_are_safe_to_print(text: str, said: str) -> None:
    assert printable(text) == said
    assert str(BodyError(text)) == said
    assert printable(said) == said


def test_messages_are_short() -> None:
    message = str(RefuError("start " + "\x1b" * 3_000_000 + " end"))
    assert len(message) <= 300
    assert message.startswith("start")
    assert message.endswith("end")
    assert run_limited(lambda: printable("x\n" * 50_000_000)).seconds < 2
