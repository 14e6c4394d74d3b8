"""The one decorator that is used of Numba, which has no types of its own: what it compiles keeps its signature."""

from collections.abc import Callable
from typing import Any, TypeVar

_F = TypeVar("_F", bound=Callable[..., Any])

def njit(*, cache: bool = ..., fastmath: bool = ...) -> Callable[[_F], _F]: ...
