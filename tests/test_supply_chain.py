"""What is installed with the project: pinned by hash, under licences that permit commercial use, and listed."""

from __future__ import annotations

import json
import re
import runpy
import subprocess
import sys
from importlib.metadata import requires
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
LOCK = ROOT / "requirements" / "lock.txt"
PYTHONS = ("3.10", "3.11", "3.12", "3.13")
FLAWED = [{"name": "numpy", "version": "2", "vulns": [{"id": "PYSEC-1", "aliases": ["CVE-1"], "fix_versions": ["3"]}]}]


@pytest.fixture(scope="module")
def script() -> dict[str, Any]:
    return runpy.run_path(str(ROOT / "scripts" / "dependencies.py"))


@pytest.fixture(scope="module")
def installed(script: dict[str, Any]) -> list[Any]:
    """All that is installed for the project, which takes seconds to find."""
    found: list[Any] = script["dependencies"]()
    return found


def test_all_licences_permit_commercial_use(installed: list[Any]) -> None:
    assert {"numpy", "torch", "warp-lang"} <= {row.name for row in installed if row.is_used}
    assert [(row.name, row.licence) for row in installed if not row.is_allowed] == []


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


def pins(version: str) -> dict[str, tuple[str, list[str]]]:
    """What the lock holds for a Python on this kind of machine: version and hashes by name."""
    found: dict[str, tuple[str, list[str]]] = {}
    for block in re.split(r"\n(?=[a-z])", LOCK.read_text())[1:]:
        requirement = Requirement(block.split("\\")[0])
        environment = {"python_version": version, "python_full_version": f"{version}.5"}
        if requirement.marker is None or requirement.marker.evaluate(environment):
            assert requirement.name not in found, f"Python {version}: {requirement.name} is pinned twice"
            (pin,) = requirement.specifier
            found[requirement.name] = pin.version, re.findall(r"--hash=sha256:([0-9a-f]{64})\b", block)
    return found


@pytest.mark.parametrize("version", PYTHONS)
def test_every_requirement_is_pinned_to_a_version_that_it_accepts(version: str) -> None:
    found = pins(version)
    for text in requires("refu-ros") or ():
        requirement = Requirement(text)
        extras = ("", "ros", "lab", "train", "test", "dev")
        environments = [{"extra": extra, "python_version": version} for extra in extras]
        if requirement.marker is None or any(map(requirement.marker.evaluate, environments)):
            name = canonicalize_name(requirement.name)
            assert name in found, f"Python {version}: {requirement.name} isn't pinned: dependencies.py lock"
            assert requirement.specifier.contains(found[name][0]), (
                f"Python {version}: {requirement} isn't {found[name][0]}"
            )


@pytest.mark.parametrize("version", PYTHONS)
def test_all_that_is_pinned_has_hashes(version: str) -> None:
    assert [name for name, (_, hashes) in pins(version).items() if not hashes] == []
    assert len(pins(version)) > 150


def test_the_lock_names_no_places() -> None:
    assert "://" not in LOCK.read_text()
    assert "@" not in LOCK.read_text()


def test_the_lock_covers_what_is_installed(installed: list[Any]) -> None:
    found = pins(f"{sys.version_info[0]}.{sys.version_info[1]}")
    assert sorted({row.name for row in installed} - set(found)) == []


def test_the_bill_of_materials_has_all_that_is_installed(script: dict[str, Any], installed: list[Any]) -> None:
    bom = json.loads(script["bill_of_materials"](installed))
    assert (bom["bomFormat"], bom["specVersion"]) == ("CycloneDX", "1.6")
    assert bom["metadata"]["component"]["name"] == "refu-ros"
    listed = {part["name"]: part for part in bom["components"]}
    assert sorted(listed) == sorted(row.name for row in installed)
    assert all(part["licenses"] and part["purl"] for part in listed.values())
    assert (listed["numpy"]["scope"], listed["pytest"]["scope"]) == ("required", "excluded")


@pytest.mark.parametrize(
    ("answer", "accepted", "code", "said"),
    [
        ("", {}, 0, "not looked for, no service can be reached"),
        ([{"name": "numpy", "skip_reason": "not found on PyPI"}], {}, 0, "not looked for"),
        ([{"name": "numpy", "version": "2", "vulns": []}], {}, 0, "1 packages, 0 advisories"),
        (FLAWED, {}, 1, "numpy 2: PYSEC-1; fixed in: 3"),
        (FLAWED, {"CVE-1": "not called"}, 0, "1 advisories, 0 not accepted"),
    ],
)
def test_an_advisory_fails_the_audit_and_no_network_does_not(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    answer: Any,
    accepted: dict[str, str],
    code: int,
    said: str,
) -> None:
    script = runpy.run_path(str(ROOT / "scripts" / "dependencies.py"))
    answered = answer if isinstance(answer, str) else json.dumps({"dependencies": answer})
    audit = script["audit"]
    monkeypatch.setitem(audit.__globals__, "ACCEPTED", accepted)
    monkeypatch.setattr(
        script["subprocess"], "run", lambda *_, **__: subprocess.CompletedProcess([], 1, stdout=answered, stderr="")
    )
    assert audit() == code
    assert said in capsys.readouterr().out
