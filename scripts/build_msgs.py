"""Builds refu_msgs for a pip-installed rclpy: eval "$(python scripts/build_msgs.py FOLDER)" puts it on PYTHONPATH.

A ROS workspace doesn't need this: colcon builds refu_msgs beside refu_ros. The wheels of rclpy bring rosidl's
generators and headers along, but no ament_cmake, so the code that rosidl writes is compiled here, for Fast DDS alone.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib
import os
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from concurrent.futures import ThreadPoolExecutor
from contextlib import redirect_stdout
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Sequence

PACKAGE = "refu_msgs"
SOURCE = Path(__file__).parents[1] / PACKAGE
_C, _DISPATCH, _PYTHON = "rosidl_generator_c", "rosidl_typesupport_c", "rosidl_generator_py"
_FAST_DDS, _INTROSPECTION = "rosidl_typesupport_fastrtps_c", "rosidl_typesupport_introspection_c"
_KINDS = (_C, _FAST_DDS, _INTROSPECTION, _DISPATCH, _PYTHON)
_DEPENDS = ("std_msgs", "shape_msgs", "geometry_msgs", "action_msgs", "service_msgs", "unique_identifier_msgs")
_DEPENDS = (*_DEPENDS, "builtin_interfaces")
_FLAGS = ("-O0", "-fPIC", "-w")  # a message is copied here, not computed: -O2 takes three times as long to build


class BuildError(Exception):
    """A compiler has failed; the message is its output."""


class MissingError(BuildError):
    """A compiler or rosidl is missing."""


def definitions() -> list[Path]:
    """The .msg, .srv and .action files, in an order in which each comes after what it uses."""
    return [path for kind in ("msg", "srv", "action") for path in sorted((SOURCE / kind).iterdir())]


def key() -> str:
    """A hash of what a build depends on: the definitions, this file, Python, and the generators."""
    parts = [path.read_bytes() for path in [*definitions(), Path(__file__)]]
    parts += [sys.version.encode(), sys.prefix.encode()]
    return hashlib.sha256(b"\0".join(parts)).hexdigest()[:16]


def build(folder: Path) -> None:
    """Leaves the Python package in a folder, whole or not at all. Raises `BuildError`."""
    if any(shutil.which(compiler) is None for compiler in ("gcc", "g++")):
        raise MissingError("a C and a C++ compiler are missing (gcc, g++)")
    prefix = Path(sys.prefix)
    os.environ["AMENT_PREFIX_PATH"] = str(prefix)  # where the generators look for their templates
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="build-", dir=folder) as temporary:
        code = Path(temporary)
        try:
            with redirect_stdout(sys.stderr):  # the generators print the name of each file
                _generate(code, prefix / "share")
        except (ImportError, LookupError) as error:
            msg = f"rosidl is missing: source a ROS 2 installation, or pip install 'refu-ros[ros]' ({error})"
            raise MissingError(msg) from error
        _compile(code, prefix)
        try:
            (code / _PYTHON / PACKAGE).rename(folder / PACKAGE)
        except OSError:  # somebody else was faster
            if not (folder / PACKAGE).is_dir():
                raise


def _generate(code: Path, share: Path) -> None:
    """rosidl's C, type support and Python, from the definitions; a folder for each."""
    adapter = importlib.import_module("rosidl_adapter")
    parser: Any = importlib.import_module("rosidl_parser.parser")
    parser.get_ast_from_idl_string = cache(parser.get_ast_from_idl_string)  # else each generator parses each file
    for path in definitions():
        adapter.convert_to_idl(SOURCE, PACKAGE, path.relative_to(SOURCE), code / "idl")
    files = [f"{code / 'idl'}:{path.relative_to(SOURCE).with_suffix('.idl')}" for path in definitions()]
    depends = [share / name for name in _DEPENDS]
    # Called by class: the command `rosidl` finds each of the wheels' generators twice, and takes none.
    hashes = importlib.import_module("rosidl_generator_type_description.cli").HashTypeDescription("type_description")
    described = hashes.generate_type_hashes(PACKAGE, files, depends, output_path=code / "hashes")
    generators: list[tuple[str, str, dict[str, Any], dict[str, Any]]] = [
        (_C, "GenerateC", {}, {"type_description_files": described}),
        (_FAST_DDS, "GenerateFastRTPSCTypesupport", {}, {}),
        (_INTROSPECTION, "GenerateIntrospectionCTypesupport", {}, {}),
        (_DISPATCH, "GenerateCTypesupport", {"typesupport_implementations": [_FAST_DDS, _INTROSPECTION]}, {}),
        (_PYTHON, "GeneratePython", {"typesupport_implementations": [_DISPATCH]}, {}),
    ]
    for module, name, made_with, called_with in generators:
        generator = getattr(importlib.import_module(f"{module}.cli"), name)(name, **made_with)
        generator.generate(PACKAGE, files, depends, code / module / PACKAGE, **called_with)


def _compile(code: Path, prefix: Path) -> None:
    """Makes the libraries that ament_cmake would, but side by side in the Python package."""
    import numpy as np

    package = code / _PYTHON / PACKAGE
    package.joinpath("__init__.py").touch()  # else the folder of the definitions may be taken for the package
    includes = [*(code / module for module in _KINDS)]
    includes += [prefix / "include", *(prefix / "include").iterdir()]
    includes += [Path(sysconfig.get_paths()["include"]), Path(np.get_include())]
    flags = [*_FLAGS, *(f"-I{path}" for path in includes), f'-DROS_PACKAGE_NAME="{PACKAGE}"']

    def library(name: str, modules: Sequence[str], own: Sequence[str] = ()) -> str:
        def compiled(path: Path) -> str:
            compiler = ["g++", "-std=c++17"] if path.suffix == ".cpp" else ["gcc", "-std=gnu11"]
            _run([*compiler, *flags, "-c", str(path), "-o", f"{path}.o"])
            return f"{path}.o"

        with ThreadPoolExecutor(os.cpu_count()) as pool:
            objects = [*pool.map(compiled, [path for module in modules for path in (code / module).rglob("*.c*")])]
        linked = [f"-l{of}__{module}" for of in _DEPENDS for module in _KINDS]
        linked += [f"-l{name}" for name in ("rosidl_runtime_c", _FAST_DDS, _INTROSPECTION, _DISPATCH, "fastcdr")]
        paths = [f"-L{prefix / 'lib'}", f"-L{package}", f"-Wl,-rpath,$ORIGIN:{prefix / 'lib'}", f"-Wl,-soname,{name}"]
        _run(["g++", "-shared", *objects, "-o", str(package / name), *paths, "-Wl,--no-as-needed", *own, *linked])
        return f"-l:{name}"

    # Type supports are opened by name: those that are loaded already are found wherever they are.
    c = library(f"lib{PACKAGE}__{_C}.so", [_C])
    supports = [library(f"lib{PACKAGE}__{module}.so", [module], [c]) for module in (_FAST_DDS, _INTROSPECTION)]
    suffix = sysconfig.get_config_var("EXT_SUFFIX")
    library(f"{PACKAGE}_s__{_DISPATCH}{suffix}", [_DISPATCH, _PYTHON], [c, *supports])
    for left in [*package.rglob("*.c"), *package.rglob("*.o")]:
        left.unlink()


def _run(command: list[str]) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False, env={**os.environ, "LC_ALL": "C"})
    if done.returncode:
        raise BuildError(f"{' '.join(command[:1])} failed on {command[-3]}:\n{done.stderr[-2000:]}")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="where the package goes")
    folder = parser.parse_args().folder
    shutil.rmtree(folder / PACKAGE, ignore_errors=True)  # built from older definitions
    try:
        build(folder)
    except BuildError as error:
        print(f"build_msgs: error: {error}", file=sys.stderr)
        return 2
    print(f"export PYTHONPATH={folder.absolute()}:$PYTHONPATH")
    return 0


if __name__ == "__main__":
    sys.exit(main())
