"""What a request asks for, checked: a frame, what to wear in it, a bag's path. Who has sent it may mean harm."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from refu_core import RefuError, SmplFrame
from refu_core.frames import N_BETAS
from refu_core.modes import BUILTIN_GARMENTS
from refu_ros._scene import check_plausible
from refu_ros._settings import NodeSettings

_PART = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
"""A folder or file: nothing hidden, no `..`, no option of a command."""
_MOST_PARTS = 8
_MOST_GARMENTS = 16


def asked_frame(request: Any) -> SmplFrame:
    """Of a `refu_msgs/srv/Dress` request. Raises `FrameError` for what no body has."""
    betas = np.asarray(request.betas, np.float32)
    stamp = request.header.stamp
    frame = SmplFrame(
        pose=np.asarray(request.pose),
        betas=np.pad(betas, (0, max(0, N_BETAS - len(betas)))),
        transl=np.asarray(request.transl),
        style=np.asarray(request.style) if len(request.style) else None,
        stamp_ns=stamp.sec * 10**9 + stamp.nanosec,
    )
    check_plausible(frame)
    return frame


def asked_settings(request: Any, settings: NodeSettings) -> NodeSettings:
    """The settings with a request's garments and mode of collisions. Raises `RefuError` for some that make no sense.

    Garments are files: those that ship may be named, and what the operator has chosen, but no path.
    """
    names, sdf = tuple(request.garments[:_MOST_GARMENTS]), request.sdf or settings.sdf
    known = list(dict.fromkeys([*settings.garments, *BUILTIN_GARMENTS]))
    if unknown := [name for name in names if name not in known] or request.garments[_MOST_GARMENTS:]:
        msg = f"garments: wanted up to {_MOST_GARMENTS} of {', '.join(known)}, got {unknown[0]!r}"
        raise RefuError(msg)
    # A style is of the garments that the parameters name: others may have none.
    style = settings.style if names in ((), settings.garments) else (0.0,) * len(settings.style)
    asked = replace(settings, garments=names or settings.garments, sdf=sdf, style=style)
    asked.pipeline.check()
    return asked


def asked_path(settings: NodeSettings, name: str) -> Path:
    """A path below the parameter `bags`. Raises `RefuError` for any other, links out of that folder included."""
    if not settings.bags:
        msg = "a request may name no file: start the node with the parameter bags, a folder for them"
        raise RefuError(msg)
    parts = name.split("/")
    folder = Path(settings.bags).expanduser().resolve()
    if len(parts) <= _MOST_PARTS and all(map(_PART.fullmatch, parts)):
        path = (folder / name).resolve()
        if folder in path.parents:
            return path
    msg = f"wanted a path below the parameter bags, as today/walk.mcap, got {name!r}"
    raise RefuError(msg)
