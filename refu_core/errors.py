"""Errors of `refu_core`: each message says what was wanted, what came, and what to do next."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping

_MAX_TEXT = 300


def printable(text: object) -> str:
    """One line for a terminal, a log or diagnostics, whatever a file or a peer has put into the text.

    Control characters, lone surrogates and the like are escaped; the middle of a text above 300 characters is left out.
    """
    line = _shortened(" ".join(_shortened(str(text), 4 * _MAX_TEXT).split()), _MAX_TEXT)
    return _shortened(escaped(line), _MAX_TEXT)


def escaped(line: str) -> str:
    """A line without control characters, lone surrogates and the like."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in line)


def _shortened(text: str, most: int) -> str:
    """Leaves out the middle: the start says where the fault is, the end what to do. Words stay whole if possible."""
    if len(text) <= most:
        return text
    start, end = text[: most - most // 3 - 3], text[-(most // 3) :]
    if " " in start[len(start) // 2 :] and " " in end[: len(end) // 2]:
        start, end = start.rpartition(" ")[0], end.partition(" ")[2]
    return f"{start} … {end}"


class RefuError(Exception):
    """Base of every error this project raises on purpose; the commands turn it into one line and exit code 2.

    Its message is safe to print: what a hostile file has put into it is escaped and bounded here, once for all.
    """

    def __init__(self, *args: object) -> None:
        super().__init__(*(printable(arg) if isinstance(arg, str) else arg for arg in args))


def require_type(
    value: object, kind: type | tuple[type, ...], wanted: str, *, error: type[RefuError] = RefuError
) -> None:
    """Raises `error`, with what was `wanted` and what came, for a value of another type."""
    if not isinstance(value, kind):
        raise error(f"wanted {wanted}, got {type(value).__name__}")


def require_pipeline(value: object, *needed: str, error: type[RefuError]) -> None:
    """Raises `error` for anything but a `GarmentPipeline`, or a stand-in with the `needed` attributes."""
    # An output has garments and a body, too.
    if isinstance(value, Mapping) or not all(hasattr(value, name) for name in needed):
        raise error(f"wanted a GarmentPipeline, got {type(value).__name__}")


class FrameError(RefuError, ValueError):
    """Body parameters of a wrong shape, or not finite."""


class BodyError(RefuError, ValueError):
    """A body model file that can't be read, isn't an SMPL-layout model, or a body name that doesn't exist."""


class GarmentError(RefuError, ValueError):
    """An unknown garment, or garments that can't be worn together."""


class MeshError(RefuError, ValueError):
    """Vertices or faces of a wrong shape, not finite, or not watertight where that is needed."""


class WeightsError(RefuError, ValueError):
    """Weights that are missing, damaged, or trained for another garment or body."""


class SimulationError(RefuError, ValueError):
    """Motions, plans or data sets that don't fit together or can't be read."""


@contextlib.contextmanager
def as_before_if_it_fails(*changed: object) -> Iterator[None]:
    """Whatever is raised in the block, an interrupt too, gives these objects back the attributes that they had.

    What the attributes refer to must be replaced there, and not written to.
    """
    before = [vars(one).copy() for one in changed]
    try:
        yield
    except BaseException:
        for one, attributes in zip(changed, before, strict=True):
            vars(one).update(attributes)
        raise
