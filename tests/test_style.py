"""The house rules that a program can check: format, lint, types, and who may import whom."""

from __future__ import annotations

import ast
import functools
import importlib.util
import re
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from collections.abc import Iterator

ROOT = Path(__file__).parents[1]
PACKAGES = ("refu_core", "msg_adapters", "refu_ros", "refu_lab")
"""What is shipped; each may import those before it, and refu_lab nothing of refu_ros."""
CORE = (
    {"errors"},
    {
        "_engine",
        "_files",
        "_npz",
        "_numbers",
        "_cache",
        "_collector",
        "_device",
        "_kernel_cache",
        "_versions",
        "_warp",
        "frames",
        "modes",
        "mesh",
        "weights",
    },
    {"skeleton", "_pickle_machine", "history"},
    {"_pickle", "keypoints"},
    {"recordings"},
    {"body"},
    {"garments"},
    {"backbones", "sdf"},
    {"refu", "fitting"},
    {"contact"},
    {"realtime"},
    {"outputs", "options"},
    {"observation"},
    {"metrics"},
    {"simulation"},
    {"training"},
)
"""The layers of refu_core, the lowest first; each may import those below it."""
FILES = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]


PAGES = ("README.md", *(f"docs/guide/{name}.md" for name in ("python", "garments", "outputs")))
"""Those whose Python runs from top to bottom."""


def programs_of_pages(to: Path) -> Iterator[Path]:
    """What each page shows in Python, as one program a page."""
    for page in map(ROOT.joinpath, PAGES):
        blocks = re.findall(r"^```python\n(.*?)^```$", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
        program = to / f"page_{page.stem.lower()}.py"
        program.write_text("\n".join(blocks), encoding="utf-8")
        yield program


@pytest.mark.parametrize("command", [["ruff", "format", "--check"], ["ruff", "check"], ["mypy"]], ids=" ".join)
def test_tools_are_silent(command: list[str], tmp_path: Path) -> None:
    if importlib.util.find_spec(command[0]) is None:
        pytest.skip(f"{command[0]} isn't installed (extra dev)")
    if command == ["mypy"]:
        if sys.version_info < (3, 11):
            pytest.skip("numpy's last release for Python 3.10 lacks types that later ones have")
        if sys.version_info >= (3, 12):  # numpy's types for it are in its syntax, which no older Python reads
            command = [*command, "--python-version", f"3.{sys.version_info.minor}"]
        command = [*command, *PACKAGES, "examples", *map(str, programs_of_pages(tmp_path))]
    # The collector goes through all that mypy knows again and again, which is a fifth of its time; it ends soon enough.
    tool, *arguments = command
    run = f"import gc, runpy; gc.disable(); runpy.run_module({tool!r}, run_name='__main__', alter_sys=True)"
    command = [sys.executable, "-c", run, *arguments]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


@functools.cache
def nodes(path: Path) -> list[ast.AST]:
    """Of a file's syntax, those that name modules or classes."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return [node for node in ast.walk(tree) if isinstance(node, (ast.Import, ast.ImportFrom, ast.ClassDef))]


def imports(path: Path) -> Iterator[str]:
    """Every module that a file names in an import, wherever in the file it does."""
    for node in nodes(path):
        if isinstance(node, ast.Import):
            yield from (name.name for name in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative imports aren't followed here"
            yield from (f"{node.module}.{name.name}" for name in node.names)


def layer(module: str) -> int | None:
    """Of a module of refu_core; None for the package itself, which has the public names of all layers."""
    name = module.split(".")[1]
    return next((i for i, layer_ in enumerate(CORE) if name in layer_), None)


LIVE = ROOT / "refu_lab" / "view" / "_live.py"
"""The one place where the commands hear a node; they run without ROS."""


def test_packages_import_those_below_them_alone() -> None:
    wrong = []
    for path in FILES:
        package = path.relative_to(ROOT).parts[0]
        allowed = {*PACKAGES[: PACKAGES.index(package) + 1]}
        allowed -= {"refu_ros"} if package == "refu_lab" and path != LIVE else set()
        allowed |= {"rclpy"} if package == "refu_ros" else set()
        names = {name.split(".")[0] for name in imports(path)} & {*PACKAGES, "rclpy"}
        wrong += [f"{path.relative_to(ROOT)} imports {name}" for name in sorted(names - allowed)]
    assert wrong == []


def test_layers_of_the_core_import_those_below_them_alone() -> None:
    wrong = []
    for path in sorted((ROOT / "refu_core").rglob("*.py")):
        if path == ROOT / "refu_core" / "__init__.py":
            continue
        here = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        own = layer(here)
        assert own is not None, f"{here}: in no layer of CORE"
        for name in imports(path):
            other = layer(name) if name.startswith("refu_core.") else None
            is_below = other is None or other < own or name.split(".")[1] == here.split(".")[1]
            if not (is_below or own == other == 1):  # files, devices and kernels help each other
                wrong.append(f"{here} imports {name}")
    assert wrong == []


def test_every_layer_exists() -> None:
    names = {path.stem for path in (ROOT / "refu_core").iterdir() if path.suffix == ".py" or path.is_dir()}
    assert set().union(*CORE) <= names


def test_no_class_has_the_name_of_another() -> None:
    where: dict[str, list[str]] = {}
    for path in FILES:
        for node in nodes(path):
            if isinstance(node, ast.ClassDef):
                where.setdefault(node.name, []).append(str(path.relative_to(ROOT)))
    assert {name: paths for name, paths in where.items() if len(paths) > 1} == {}


def test_no_file_is_longer_than_400_lines() -> None:
    lines = {path.relative_to(ROOT): path.read_text(encoding="utf-8").count("\n") for path in FILES}
    assert {path: n for path, n in lines.items() if n > 400} == {}


HEAVY = {"matplotlib", "PIL", "igl", "fcl", "numba", "trimesh", "rosbags", "viser"}
"""Of the extras: nothing that a robot needs may import them. (tqdm is left out: torch imports it where it is.)"""


FORBIDDEN = {
    "msg_adapters": {"torch", "warp", "rclpy", "refu_core.body"} | HEAVY,
    "refu_core": {"torch", "warp", "rclpy", "msg_adapters"} | HEAVY,
    "refu_lab.cli": {"torch", "warp", "rclpy"} | HEAVY,
    "refu_lab.sources": {"torch", "warp", "rclpy"} | HEAVY,
    "refu_core.realtime": {"rclpy", "msg_adapters", "refu_core.metrics", "refu_core.simulation"} | HEAVY,
    "refu_core.metrics": {"rclpy", "msg_adapters"} | HEAVY,
    "refu_core.training": {"rclpy", "msg_adapters", "numba"},
    "refu_lab.benchmark": {"rclpy", "numba"},
    "refu_lab.reproduction": {"rclpy", "numba"},
    "refu_lab.view": {"rclpy", "refu_ros"} | HEAVY,
}
"""What a package must not pull in; those that may import torch are the last."""
_IMPORTS = """
import importlib, os, sys

for package, *forbidden in map(str.split, sys.argv[1:]):
    if "torch" not in forbidden:
        import refu_core.realtime  # once for all: it takes seconds, and may load nothing that they mustn't
    if os.fork() == 0:
        importlib.import_module(package)
        print(package, *sys.modules, flush=True)
        os._exit(0)
    assert os.wait()[1] == 0, package
for garment in "tshirt-male", "skirt-female":  # with networks for lying people, and for the past
    refu_core.realtime.GarmentPipeline.load([garment], collider=False)
print("networks", *sys.modules)
"""


def test_what_an_import_does_not_load() -> None:
    """Seen from a fresh interpreter, and from copies of it."""
    asked = [" ".join((package, *forbidden)) for package, forbidden in FORBIDDEN.items()]
    command = [sys.executable, "-c", _IMPORTS, *asked]
    told = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.splitlines()
    loaded = {package: set(modules) for package, *modules in map(str.split, told)}
    assert "torch._dynamo" not in loaded.pop("networks")  # torch's compiler takes two seconds
    assert loaded.keys() == FORBIDDEN.keys()
    assert {package: names for package in FORBIDDEN if (names := FORBIDDEN[package] & loaded[package])} == {}
