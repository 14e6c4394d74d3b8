"""Definitions of the messages this project reads and writes, as ROS 2 Jazzy has them: `definitions.msg`.

A bag carries the text of every message type and of those it is built from, so that a reader without ROS can decode it.
It also carries the type's hash (RIHS01), by which ROS knows that both ends mean the same type. Here only the types that
a topic may have come with a hash.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from msg_adapters.errors import BagError

_SEPARATOR = f"\n{'=' * 80}\n"
_NESTED = re.compile(r"^(\w+/\w+)(?:\[\d*\])? \w+", re.MULTILINE)


@dataclass(frozen=True)
class MessageDefinition:
    """A message type's text with all it depends on (`ros2msg`), and its hash."""

    text: str
    type_hash: str


def full_type_name(name: str) -> str:
    """`package/msg/Type` of `package/Type` or `package/msg/Type`."""
    package, _, rest = name.partition("/")
    return name if rest.startswith("msg/") or not rest else f"{package}/msg/{rest}"


@cache
def _definitions() -> dict[str, MessageDefinition]:
    """Each type's own fields, and its hash, by `package/Type`."""
    known = {}
    for part in Path(__file__).with_suffix(".msg").read_text(encoding="utf-8").split(_SEPARATOR):
        head, _, fields = part.strip("\n").partition("\n")
        name, _, type_hash = head.removeprefix("MSG: ").partition(" ")
        known[name] = MessageDefinition(fields, type_hash)
    return known


def _dependencies(name: str, found: dict[str, None]) -> None:
    for nested in _NESTED.findall(_definitions()[name].text):
        if nested not in found:
            found[nested] = None
            _dependencies(nested, found)


@cache
def message_definition(message_type: str) -> MessageDefinition:
    """The definition of a type this project writes.

    Raises `BagError` for any other type; its topics need the definition from the bag they were read from.
    """
    name = full_type_name(message_type).replace("/msg/", "/")
    known = _definitions()
    if name not in known or not known[name].type_hash:
        names = ", ".join(full_type_name(one) for one, definition in known.items() if definition.type_hash)
        raise BagError(f"no definition of {message_type} is built in (there are {names}); give its text as definition")
    nested: dict[str, None] = {}
    _dependencies(name, nested)
    parts = [known[name].text, *(f"MSG: {one}\n{known[one].text}" for one in nested)]
    return MessageDefinition(text=_SEPARATOR.join(parts) + "\n", type_hash=known[name].type_hash)
