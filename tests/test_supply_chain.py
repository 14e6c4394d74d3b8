"""What is installed with the project: pinned for CI, and under licences that permit commercial use."""

from __future__ import annotations

import runpy
import sys
from importlib.metadata import requires
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
LOCKS = sorted((ROOT / "requirements").glob("ci-*.lock"))


@pytest.fixture(scope="module")
def script() -> dict[str, Any]:
    return runpy.run_path(str(ROOT / "scripts" / "dependencies.py"))


def test_all_licences_permit_commercial_use(script: dict[str, Any]) -> None:
    found = script["dependencies"]()
    assert {"numpy", "torch", "warp-lang"} <= {row.name for row in found if row.is_used}
    assert [(row.name, row.licence) for row in found if not row.is_allowed] == []


@pytest.mark.parametrize(
    ("licence", "allowed"),
    [
        ("MIT", True),
        ("BSD-3-Clause", True),
        ("Apache Software License", True),
        ("GNU Lesser General Public License v3 (LGPLv3)", True),
        ("GPL-3.0-or-later", False),
        ("GNU General Public License v3 (GPLv3)", False),
        ("AGPL-3.0", False),
        ("CC-BY-NC-4.0 (non-commercial)", False),
        ("MIT, for research only", False),
        ("unknown", False),
        ("submit to us", False),
    ],
)
def test_which_licences_do(script: dict[str, Any], licence: str, allowed: bool) -> None:
    assert script["is_allowed"]("some-package", licence) is allowed


@pytest.mark.parametrize("path", LOCKS, ids=lambda path: path.stem)
def test_every_requirement_is_pinned_to_a_version_that_it_accepts(path: Path) -> None:
    lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    pins = dict(line.split("==") for line in lines)
    version = path.stem.removeprefix("ci-")
    for text in requires("refu-ros") or ():
        requirement = Requirement(text)
        environments = [{"extra": extra, "python_version": version} for extra in ("", "ros", "train", "test", "dev")]
        if requirement.marker is None or any(map(requirement.marker.evaluate, environments)):
            pin = pins.get(canonicalize_name(requirement.name))
            assert pin is not None, f"{path.name}: {requirement.name} isn't pinned"
            assert requirement.specifier.contains(pin), f"{path.name}: {requirement} doesn't accept {pin}"
    assert not [line for line in lines if "/" in line or "@" in line], "a lock names versions, and no places"


def test_the_lock_of_this_python_says_what_is_installed(script: dict[str, Any]) -> None:
    path = ROOT / "requirements" / f"ci-{sys.version_info[0]}.{sys.version_info[1]}.lock"
    assert script["lock"]().startswith(f"# Constraints of CI's pip with Python {path.stem.removeprefix('ci-')}")
    assert all("+" not in line for line in script["lock"]().splitlines())
