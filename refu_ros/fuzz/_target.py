"""What can be fuzzed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    import random
    from collections.abc import Callable
    from pathlib import Path


class Reader(Protocol):
    """A reader under test, with the input that its search starts from."""

    @property
    def seeds(self) -> list[bytes]:
        """Valid input, and attacks that are known by name."""

    def mutate(self, rng: random.Random, data: bytes, other: bytes) -> bytes:
        """Another input, made of `data` and maybe of parts of `other`."""

    def execute(self, data: bytes) -> None:
        """Reads `data`: returns or raises `RefuError`; anything else is a finding, an `AssertionError` among it."""


@dataclass(frozen=True)
class Target:
    """A reader by name."""

    name: str
    what: str
    """What is read, in a few words."""
    executions: int
    """By default."""
    open: Callable[[Path], Reader]
    """Makes the reader, which may write below a folder of its own."""
    memory_mb: int = 64
    """The memory that any input may make the process take, beyond what valid input takes."""
    seconds: float = 2.0
    """The processor time that any one input may take."""
