"""What refu-ros and its extras depend on: versions and hashes, licences, a bill of materials, known advisories.

    python scripts/dependencies.py lock       # resolve anew, and write requirements/lock.txt
    python scripts/dependencies.py licences   # of what is installed; exit code 1 for one that isn't on the list below
    python scripts/dependencies.py sbom FILE  # the same as a bill of materials: CycloneDX 1.6, JSON
    python scripts/dependencies.py audit      # exit code 1 for a locked version with an advisory that isn't accepted

`licences` and `sbom` read the metadata of the environment that runs them, and need no network.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]
LOCK = ROOT / "requirements" / "lock.txt"
PYTHONS = ("3.10", "3.11", "3.12", "3.13")
PROJECT = "refu-ros"
EXTRAS = ("ros", "lab", "train", "cluster", "test", "dev")
USED_EXTRAS = ("", "ros", "lab", "train", "cluster")
"""What users install; `test` and `dev` are for those who work on the project."""
ALLOWED = re.compile(
    r"apache|\bmit\b|\bbsd\b|\bisc\b|\bpsf\b|python software foundation|\bmpl[- ]?2|mozilla|\bhpnd\b"
    r"|historical permission|unlicense|\bcc0\b|\b0bsd\b|\bzlib\b|public domain|\blgpl\b|lesser general public"
    r"|boost|matplotlib|cnri"
)
"""Licences that permit commercial use and demand nothing for the source of what merely uses the package."""
REFUSED = re.compile(
    r"(?<!lesser )general public licen[cs]e|(?<!l)\bagpl\b|(?<![al])\bgpl\b|non-?commercial|research only"
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
ACCEPTED: dict[str, str] = {}
"""Advisories that don't concern the project, each with the reason."""


@dataclass(frozen=True)
class Dependency:
    name: str
    version: str
    licence: str
    is_used: bool
    """Whether users install it; otherwise it is for tests and development."""
    is_allowed: bool
    needs: tuple[str, ...]
    """Names of its direct dependencies."""


def closure(extras: tuple[str, ...]) -> dict[str, tuple[Distribution, set[str]]]:
    """The project with these extras and all installed dependencies, by canonical name, each with its direct ones."""
    found: dict[str, tuple[Distribution, set[str]]] = {}
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
        needs = found.setdefault(name, (package, set()))[1]
        for text in package.requires or ():
            requirement = Requirement(text)
            if requirement.marker is None or any(requirement.marker.evaluate({"extra": e}) for e in wanted or {""}):
                needed = canonicalize_name(requirement.name)
                needs |= {needed} - {name}
                todo.append((needed, frozenset(requirement.extras)))
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
    return _CUDA if name.startswith("nvidia-") else EXCEPTIONS.get(name)


def is_allowed(name: str, licence: str) -> bool:
    """Whether a package is an exception, or its licence is on the allowed list and not on the refused one."""
    text = licence.lower()
    return exception(name) is not None or bool(ALLOWED.search(text) and not REFUSED.search(text))


def dependencies() -> list[Dependency]:
    """All installed dependencies of the project."""
    used, found = closure(USED_EXTRAS), closure(("", *EXTRAS))
    return [
        Dependency(
            name,
            package.version,
            exception(name) or licence_of(package),
            name in used,
            is_allowed(name, licence_of(package)),
            tuple(sorted(needs & found.keys())),
        )
        for name, (package, needs) in found.items()
        if name != PROJECT
    ]


def lock() -> None:
    """Resolves for every Python at once, and writes each version with the hashes of all its files.

    torch is built more than once under one version. The hash of the file that pip takes here, which the index may not
    have, is added to those of the index.
    """
    command = [shutil.which("uv") or "uv", "pip", "compile", "--quiet", "--universal", "--python-version", PYTHONS[0]]
    command += ["--generate-hashes", "--no-annotate", "--no-header", "--upgrade", *(f"--extra={e}" for e in EXTRAS)]
    resolved = subprocess.run(
        [*command, "pyproject.toml"], cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True
    ).stdout
    match = re.search(r"^torch==(\S+).*\n", resolved, re.MULTILINE)
    if match is None:
        raise SystemExit("no version of torch was resolved")
    hashes = sorted(
        {taken for python in PYTHONS for taken in _taken(f"torch=={match[1]}", python)} - {*resolved.split()}
    )
    added = "".join(f"    {text} \\\n" for text in hashes)
    head = "# All dependencies with hashes, for Python 3.10 to 3.13 on Linux: made by scripts/dependencies.py lock.\n"
    LOCK.write_text(head + resolved[: match.end()] + added + resolved[match.end() :], encoding="utf-8")


def _taken(requirement: str, python: str) -> list[str]:
    """The hash of the file that pip would install, in a lock's form; empty if there is no such file."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder, "report.json")
        command = [sys.executable, "-m", "pip", "install", "--quiet", "--dry-run", "--ignore-installed", "--no-deps"]
        command += ["--only-binary=:all:", f"--python-version={python}", f"--target={folder}", f"--report={report}"]
        if subprocess.run([*command, requirement], check=False, stderr=subprocess.DEVNULL).returncode:
            return []
        (chosen,) = json.loads(report.read_text())["install"]
        return [f"--hash=sha256:{chosen['download_info']['archive_info']['hashes']['sha256']}"]


def bill_of_materials(rows: list[Dependency]) -> str:
    """What is installed, as CycloneDX 1.6 in JSON; what users don't install has the scope `excluded`."""
    from cyclonedx.model.bom import Bom
    from cyclonedx.model.component import Component, ComponentScope, ComponentType
    from cyclonedx.model.license import DisjunctiveLicense
    from cyclonedx.output.json import JsonV1Dot6
    from packageurl import PackageURL

    licence = [DisjunctiveLicense(id="Apache-2.0")]
    version = distribution(PROJECT).version
    project = Component(name=PROJECT, version=version, type=ComponentType.APPLICATION, licenses=licence)
    parts = {
        row.name: Component(
            name=row.name,
            version=row.version,
            bom_ref=f"{row.name}=={row.version}",
            purl=PackageURL("pypi", name=row.name, version=row.version),
            scope=ComponentScope.REQUIRED if row.is_used else ComponentScope.EXCLUDED,
            licenses=[DisjunctiveLicense(name=row.licence)],
        )
        for row in rows
    }
    bom = Bom(components=parts.values())
    bom.metadata.component = project
    direct = closure(("", *EXTRAS))[PROJECT][1]
    bom.register_dependency(project, [parts[name] for name in sorted(direct & parts.keys())])
    for row in rows:
        bom.register_dependency(parts[row.name], [parts[name] for name in row.needs if name in parts])
    return JsonV1Dot6(bom).output_as_string(indent=1) + "\n"


def audit() -> int:
    """Asks an advisory service about everything locked, for the running Python; says so if none answers."""
    for service in ("pypi", "osv"):
        command = [sys.executable, "-m", "pip_audit", "--disable-pip", "--require-hashes", "--progress-spinner=off"]
        command += ["--format=json", f"--vulnerability-service={service}", "--timeout=10", f"--requirement={LOCK}"]
        done = subprocess.run(command, check=False, capture_output=True, text=True)
        try:
            rows = json.loads(done.stdout)["dependencies"]
        except ValueError:  # pip_audit prints nothing if the service can't be reached
            continue
        asked = [row for row in rows if "skip_reason" not in row]
        if not asked:  # an index other than PyPI itself knows no advisories
            continue
        found = [(row["name"], row["version"], advisory) for row in asked for advisory in row["vulns"]]
        refused = [(name, version, a) for name, version, a in found if not {a["id"], *a["aliases"]} & ACCEPTED.keys()]
        for name, version, advisory in refused:
            fixed = ", ".join(advisory["fix_versions"]) or "none yet"
            print(f"! {name} {version}: {advisory['id']}; fixed in: {fixed}")
        print(f"advisories ({service}): {len(asked)} packages, {len(found)} advisories, {len(refused)} not accepted")
        return int(bool(refused))
    print("advisories: not looked for, no service can be reached from here")
    return 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("lock", "licences", "sbom", "audit"))
    parser.add_argument("file", type=Path, nargs="?", metavar="FILE", help="of the bill of materials")
    args = parser.parse_args()
    if args.what == "lock":
        lock()
        return 0
    if args.what == "audit":
        return audit()
    rows = dependencies()
    if args.what == "sbom":
        if args.file is None:
            parser.error("sbom: wanted a FILE to write")
        args.file.write_text(bill_of_materials(rows), encoding="utf-8")
        return 0
    for row in rows:
        mark = " " if row.is_allowed else "!"
        print(f"{mark} {row.name:<36} {row.version:<16} {'used' if row.is_used else 'test'}  {row.licence}")
    refused = [row.name for row in rows if not row.is_allowed]
    print(f"{len(rows)} packages, {len(refused)} with a licence that isn't on the list: {', '.join(refused) or 'none'}")
    return int(bool(refused))


if __name__ == "__main__":
    sys.exit(main())
