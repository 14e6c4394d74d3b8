"""All that is installed with refu-ros and its extras: versions to pin, and licences.

    python scripts/dependencies.py licences [--json FILE]   # exit status 1 for a licence that isn't on the list below
    python scripts/dependencies.py lock > requirements/ci-3.11.lock   # what CI installs with that Python

Read from the metadata of the environment that runs it: nothing is asked of a network.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from dataclasses import asdict, dataclass
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

PROJECT = "refu-ros"
EXTRAS = ("ros", "train", "test", "dev")
USED_EXTRAS = ("", "ros", "train")
"""What users install; `test` and `dev` are for those who work on the project."""
ALLOWED = (
    *(
        r"apache",
        r"\bmit\b",
        r"\bbsd\b",
        r"\bisc\b",
        r"\bpsf\b",
        r"python software foundation",
        r"\bmpl[- ]?2",
        r"mozilla",
    ),
    *(r"\bhpnd\b", r"historical permission", r"unlicense", r"\bcc0\b", r"\b0bsd\b", r"\bzlib\b", r"public domain"),
    *(r"\blgpl\b", r"lesser general public", r"boost", r"matplotlib", r"cnri"),
)
"""Licences that permit commercial use and ask nothing of the source of what merely uses the package."""
REFUSED = (
    r"(?<!lesser )general public licen[cs]e",
    r"(?<!l)\bagpl\b",
    r"(?<![al])\bgpl\b",
    r"non-?commercial",
    r"research only",
)
_CUDA = "NVIDIA's terms for CUDA, which permit commercial use; comes with torch's CUDA build alone"
_FORTRAN = "BSD-3-Clause; the GPL in its metadata is libgfortran's, which has the runtime library exception"
EXCEPTIONS = {
    "apsw": "MIT-like (any licence that OSI approves)",
    "cuda-toolkit": _CUDA,
    "docutils": "public domain, BSD-2-Clause; the GPL in its metadata is of an editor mode that isn't installed",
    "libigl": "MPL-2.0; its wheel leaves out what is under the GPL",
    "numpy": _FORTRAN,
    "ros-fastcdr": "Apache-2.0",
    "ros-fastrtps": "Apache-2.0",
    "ros-jazzy-common-interfaces": "Apache-2.0 (a name for several packages, nothing in itself)",
    "ros-jazzy-rclpy": "Apache-2.0 (a name for several packages, nothing in itself)",
    "scipy": _FORTRAN,
    "setuptools": "MIT",
}
"""Looked up by hand, where metadata says nothing or names a part that isn't used."""
EXCEPTED_FAMILIES = {"nvidia-": _CUDA}
"""The same, by how names begin."""


@dataclass(frozen=True)
class Dependency:
    """One installed distribution."""

    name: str
    version: str
    licence: str
    is_used: bool
    """Whether users have it; otherwise it is for tests and development."""
    is_allowed: bool


def closure(extras: tuple[str, ...]) -> dict[str, Distribution]:
    """The project's installed dependencies with these extras, and theirs, by canonical name."""
    found: dict[str, Distribution] = {}
    todo: list[tuple[str, frozenset[str]]] = [(PROJECT, frozenset(extras))]
    seen: set[tuple[str, frozenset[str]]] = set()
    while todo:
        name, wanted = todo.pop()
        if (name, wanted) in seen:
            continue
        seen.add((name, wanted))
        try:
            package = distribution(name)
        except PackageNotFoundError:
            continue
        found[canonicalize_name(name)] = package
        for text in package.requires or ():
            requirement = Requirement(text)
            if requirement.marker is None or any(requirement.marker.evaluate({"extra": e}) for e in wanted or {""}):
                todo.append((canonicalize_name(requirement.name), frozenset(requirement.extras)))
    del found[PROJECT]
    return dict(sorted(found.items()))


def licence_of(package: Distribution) -> str:
    """What the metadata says, shortest form first."""
    metadata = package.metadata
    expression = metadata.get("License-Expression", "")
    classifiers = [text for text in metadata.get_all("Classifier") or () if text.startswith("License ::")]
    named = "; ".join(text.rsplit(" :: ", maxsplit=1)[-1] for text in classifiers)
    text = metadata.get("License", "")
    # ROS packages keep theirs in another file.
    manifests = [Path(str(file.locate())) for file in package.files or () if file.name == "package.xml"]
    if manifests:
        named = "; ".join(re.findall(r"<license[^>]*>([^<]*)<", manifests[0].read_text(encoding="utf-8"))) or named
    return expression or (named if named not in ("", "OSI Approved") else " ".join(text.split())[:200]) or "unknown"


def exception(name: str) -> str | None:
    """What was looked up by hand; None where metadata will do."""
    families = (licence for start, licence in EXCEPTED_FAMILIES.items() if name.startswith(start))
    return EXCEPTIONS.get(name) or next(families, None)


def is_allowed(name: str, licence: str) -> bool:
    """Whether a licence is on the list, and not on the other one."""
    if exception(name) is not None:
        return True
    text = licence.lower()
    return any(re.search(pattern, text) for pattern in ALLOWED) and not any(re.search(p, text) for p in REFUSED)


def dependencies() -> list[Dependency]:
    """All that is installed of the project's dependencies."""
    used = closure(USED_EXTRAS)
    return [
        Dependency(
            name,
            package.version,
            exception(name) or licence_of(package),
            name in used,
            is_allowed(name, licence_of(package)),
        )
        for name, package in closure(("", *EXTRAS)).items()
    ]


def lock() -> str:
    """Constraints for pip: each version as it is installed, without the label of a local build."""
    version = ".".join(map(str, sys.version_info[:2]))
    head = f"# Constraints of CI's pip with Python {version}, made by scripts/dependencies.py lock.\n"
    lines = [f"{name}=={package.version.split('+')[0]}\n" for name, package in closure(("", *EXTRAS)).items()]
    return head + "".join(lines)


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("licences", "lock"))
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the licences as JSON")
    args = parser.parse_args()
    if args.what == "lock":
        sys.stdout.write(lock())
        return 0
    rows = dependencies()
    for row in rows:
        mark = " " if row.is_allowed else "!"
        print(f"{mark} {row.name:<36} {row.version:<16} {'used' if row.is_used else 'test'}  {row.licence}")
    if args.json is not None:
        args.json.write_text(json.dumps({"rows": [asdict(row) for row in rows]}, indent=1) + "\n")
    refused = [row.name for row in rows if not row.is_allowed]
    print(f"{len(rows)} packages, {len(refused)} with a licence that isn't on the list: {', '.join(refused) or 'none'}")
    return int(bool(refused))


if __name__ == "__main__":
    sys.exit(main())
