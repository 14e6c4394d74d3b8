"""What `refu info` shows."""

from __future__ import annotations

import platform
from importlib.util import find_spec
from typing import Any

from refu_core import BodyError, MeshError, RefuError, __version__
from refu_core._versions import installed
from refu_core.body import BUILTIN_BODIES, load_body, load_fit
from refu_core.garments import garment_files, load_garment
from refu_core.mesh import Connectivity
from refu_core.modes import BackboneName, SdfMode
from refu_core.weights import load_card, weights_folder
from refu_lab.sources import fit_facts


def describe_body(source: str) -> dict[str, Any]:
    """What a body model file holds, whether garments can be worn on it, and how well. Raises `BodyError`."""
    body = load_body(source)
    try:
        Connectivity.of(body.faces).require_closed()
        closed = "yes"
    except MeshError:
        closed = "no"  # the reason is given below
    low, high = body.v_template[:, 1].min(), body.v_template[:, 1].max()
    facts: dict[str, Any] = {
        "body": source,
        "fingerprint": body.fingerprint,
        "vertices": body.n_vertices,
        "faces": len(body.faces),
        "height": f"{float(high - low):.2f} m",
        "watertight": closed,
    }
    try:
        fit = load_fit(body)
    except BodyError as error:
        return facts | {"can be worn": f"no: {error}"}
    facts["built-in mesh on it"] = fit.text
    return facts | fit_facts(fit) | ({"warnings": fit.warnings} if fit.warnings else {})


def describe_garment(name: str) -> str:
    """What a named garment's file holds and what its networks were trained from, or why it can't be loaded."""
    stem, networks = weights_folder(name) / "tailornet-hybrid", "no networks: worn by skinning"
    try:
        found = load_garment(name)
        if stem.with_suffix(".json").exists():
            card = load_card(stem)
            networks = "networks" + (f" of {card['like']} and {card['simulated']} samples" if "like" in card else "")
    except RefuError as error:
        return f"can't be loaded: {error}"
    return f"{found.n_vertices} vertices, {len(found.faces)} faces, for {found.body}; {networks}"


def collect() -> dict[str, Any]:
    """Versions, bodies, garments, modes and devices as plain values, ready for JSON."""
    import torch

    n_gpus = torch.cuda.device_count() if torch.cuda.is_available() else 0
    bodies = (load_body(name) for name in BUILTIN_BODIES)
    return {
        "refu": __version__,
        "python": platform.python_version(),
        "machine": f"{platform.system()} {platform.machine()}",
        **{name: installed(name) for name in ("torch", "warp-lang", "numpy")},
        "rclpy": "importable" if find_spec("rclpy") else "not found (needed by the node only)",
        "devices": ["cpu", *(f"cuda: {torch.cuda.get_device_name(i)}" for i in range(n_gpus))],
        "bodies": {body.name: f"{body.n_vertices} vertices, {body.fingerprint}" for body in bodies},
        "garments": {name: describe_garment(name) for name in garment_files()},
        "backbones": [str(one) for one in BackboneName],
        "sdf modes": [str(one) for one in SdfMode],
    }
