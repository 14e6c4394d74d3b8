"""Tables of several people: one array for all, a row for each person and image, told apart by the columns beside it."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from refu_core.recordings import _layouts as table
from refu_core.recordings._containers import Content, Key, words_of
from refu_core.recordings._rotations import is_one_frame

_MOST_ROWS = 300_000
"""Most rows of all tables that have such columns [1]: 80 minutes of two people at 30 Hz, about a second's work."""
_MOST_PERSONS = 5_000
"""Most people of a table [1], such as a thousand sequences of five; they take two seconds."""
_MOST_UNTRACKED = 50_000
"""Most rows without a column of persons that are followed by where they are [1]; more would take seconds."""
_LONGEST_NUMBER = 9
"""Most digits of a frame's number; more are a time stamp [1]."""


def told_apart(content: Content, notes: list[str]) -> Content:
    """The content with one mapping per person for each table of several people's rows; all else stays as it is.

    CoMotion and BEDLAM write such tables. Rows are told apart by the columns of `table.PERSONS`, and by the folders of
    their images. Without either, rows of one image become a list, so that they are followed by their places. Rows of
    one person are brought into the order of their frames' numbers.

    Raises `ValueError` for tables of more than `_MOST_ROWS` rows or `_MOST_PERSONS` people.
    """
    found: dict[int, Mapping[Key, Any]] = {}
    left = _MOST_ROWS
    for _, node in content.nodes():
        n = _n_rows(content, node)
        left -= n
        if left < 0:
            raise ValueError(f"tables of more than {_MOST_ROWS} rows with columns of persons or images; save fewer")
        people = _people(content, node, n, notes) if n > 1 else None
        if people is not None:
            found[id(node)] = people
    return content.changed(lambda node: found.get(id(node), node)) if found else content


def numbers_of(content: Content, node: Mapping[Key, Any]) -> NDArray[Any] | None:
    """The numbers of the frames in a mapping, of any shape but a single number's; None if there are none."""
    for name in table.FRAME_NUMBERS:
        array = None if node.get(name) is None else content.column(node[name])
        if array is not None and array.dtype.kind in "iuf":  # else a count of frames, or their pictures
            is_whole = array.dtype.kind == "f" and bool(((array == np.round(array)) & (np.abs(array) < 2**53)).all())
            return array.astype(np.int64) if is_whole else array  # tables of text give floats
    return None


def number_of(content: Content, row: Mapping[Key, Any]) -> int | None:
    """The frame's number in a mapping of one person in one image: its own, or that in the image's name."""
    numbers = [number for name in table.FRAME_NUMBERS if isinstance(number := content.single(row.get(name)), int)]
    images = [image for name in table.IMAGES if isinstance(image := content.single(row.get(name)), str)]
    return next(iter([*numbers, *(_image(image)[1] for image in images)]), None)


def _people(content: Content, node: Mapping[Key, Any], n: int, notes: list[str]) -> Mapping[Key, Any] | None:
    """What a table of n rows becomes; None if all of them are one person's and in order."""
    images = _words(content, node, table.IMAGES, n)
    places = [_image(str(image)) for image in images]
    numbers = [number for _, number in places]
    if (column := numbers_of(content, node)) is not None:
        numbers = column.reshape(-1).tolist() if column.size == n and column.dtype.kind in "iu" else []
    if not all(isinstance(number, int) for number in numbers):
        numbers = []
    persons = _words(content, node, table.PERSONS, n)
    if len(set(persons)) == n and not 0 < len(set(numbers)) < n:
        persons = []  # the column numbers the rows
    folders: Sequence[str] = [folder for folder, _ in places]
    if len(set(folders)) in (1, n):
        folders = []
    if not persons and not folders and 1 < len(set(images)) < n <= _MOST_UNTRACKED:
        return _by_image(content, node, images)
    rows: dict[Key, list[int]] = {}
    names: Sequence[Key] = folders or persons or [0] * n
    if folders and persons:
        names = [f"{folder}/{person}" for folder, person in zip(folders, persons, strict=True)]
    for i, name in enumerate(names):
        rows.setdefault(name, []).append(i)
    if len(rows) == 1:
        has_own = any(name in node for name in table.FRAME_NUMBERS)
        return {**node, table.FRAME_NUMBERS[0]: np.array(numbers)} if numbers and not has_own else None
    by = [name for name, given in (("their images' folders", folders), ("their column of persons", persons)) if given]
    notes.append(f"the rows are {len(rows)} persons', told apart by {' and '.join(by)}")
    if len(rows) > _MOST_PERSONS:
        raise ValueError(f"{len(rows)} persons, at most {_MOST_PERSONS} are told apart; save fewer of them in a file")
    return _tracks(content, node, n, rows, numbers)


def _n_rows(content: Content, node: Mapping[Key, Any]) -> int:
    """How many rows of one pose each a table has that has columns beside it; 0 for any other mapping."""
    if all(node.get(name) is None for name in (*table.PERSONS, *table.IMAGES)):
        return 0
    layout = next((one for one in table.LAYOUTS if one.is_in(node)), None)
    if layout is None or layout.is_time_last:
        return 0
    shapes = content.shapes(node, layout.pose)
    n = shapes[0][0] if shapes and len(shapes[0]) > 1 else 0
    each = zip(shapes, layout.joints, strict=True)
    return n if n and all(shape[:1] == (n,) and is_one_frame(shape[1:], counts) for shape, counts in each) else 0


def _words(content: Content, node: Mapping[Key, Any], names: Sequence[str], n: int) -> Sequence[Key]:
    """A column of n words or whole numbers under one of these names; empty if there is none."""
    for name in names:
        value = node.get(name)
        words: Sequence[Any] = words_of(value)
        array = None if words or value is None else content.column(value)
        if array is not None and array.dtype.kind in "iuUS":
            words = array.reshape(-1).tolist()
        if len(words) == n:
            return [word.decode("utf-8", "replace") if isinstance(word, bytes) else word for word in words]
    return []


def _image(name: str) -> tuple[str, int | None]:
    """The folder of an image, and its number, which its name ends with."""
    folder, _, file = name.replace("\\", "/").rpartition("/")
    digits = re.findall(r"\d+", file.rpartition(".")[0] or file)
    return folder, int(digits[-1]) if digits and len(digits[-1]) <= _LONGEST_NUMBER else None


def _by_image(content: Content, node: Mapping[Key, Any], images: Sequence[Key]) -> dict[Key, Any]:
    frames: dict[Key, Any] = {}
    arrays = _split(content, node, len(images))
    for i, image in enumerate(images):
        frames.setdefault(image, []).append({name: array[i] for name, array in arrays.items()})
    return frames


def _tracks(
    content: Content, node: Mapping[Key, Any], n: int, rows: Mapping[Key, list[int]], numbers: Sequence[int | None]
) -> dict[Key, Any]:
    """Each person's rows, in the order of their numbers, and what all n rows have in common."""
    apart = {*table.COLUMNS} - {*table.GENDERS}
    common = {key: value for key, value in node.items() if key in table.ALL_KEYS and key not in apart}
    split, genders = _split(content, node, n), _words(content, node, table.GENDERS, n)
    tracks: dict[Key, Any] = {}
    for person, mine in rows.items():
        order = np.array(sorted(mine, key=lambda i: numbers[i] or 0) if numbers else mine)
        tracks[person] = common | {name: array[order] for name, array in split.items()}
        if genders:
            tracks[person][table.GENDERS[0]] = genders[order[0]]
        if numbers:
            tracks[person][table.FRAME_NUMBERS[0]] = np.array([numbers[i] for i in order])
    return tracks


def _split(content: Content, node: Mapping[Key, Any], n: int) -> dict[Key, NDArray[Any]]:
    """The arrays that have a row for each of n; betas (n,) are one person's, even of ten."""
    arrays: dict[Key, NDArray[Any]] = {}
    for name in table.ARRAYS:
        with contextlib.suppress(ValueError):
            if node.get(name) is not None and (array := content.array(node[name])).ndim > 1 and len(array) == n:
                arrays[name] = array
    return arrays
