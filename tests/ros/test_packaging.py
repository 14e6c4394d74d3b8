"""What colcon and ROS tools find: every file that is named exists, names agree, and the package builds and runs."""

from __future__ import annotations

import ast
import configparser
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import pytest
import yaml

from refu_core import __version__
from refu_core.options import specs_of
from refu_ros._settings import NodeSettings

ROOT = Path(__file__).parents[2]
SPECS = specs_of(NodeSettings)
INSTALLED_FOLDERS = ("launch", "config", "rviz", "foxglove", "resource")
LAUNCH_FILES = sorted((ROOT / "launch").glob("*.launch.py"))
TOPICS = {"/garments", "/body"}
ON_REQUEST = {"/openings", "/points"}
"""Not shown at first: what isn't shown isn't computed."""


@pytest.fixture(scope="module")
def setup_cfg() -> configparser.ConfigParser:
    parser = configparser.ConfigParser()
    parser.read(ROOT / "setup.cfg")
    return parser


@pytest.fixture(scope="module")
def package_xml() -> ET.Element:
    return ET.parse(ROOT / "package.xml").getroot()


def data_files(setup_cfg: configparser.ConfigParser) -> dict[str, list[str]]:
    return {target: files.split() for target, files in setup_cfg["options.data_files"].items()}


def imports(path: Path) -> set[str]:
    """Top-level packages that a file imports, wherever in it."""
    nodes = list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
    names = [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]
    names += [node.module for node in nodes if isinstance(node, ast.ImportFrom) and node.module]
    return {name.partition(".")[0] for name in names}


def test_data_files_are_complete(setup_cfg: configparser.ConfigParser) -> None:
    listed = {file for files in data_files(setup_cfg).values() for file in files}
    assert all((ROOT / file).is_file() for file in listed)
    present = {
        f"{folder}/{path.name}" for folder in INSTALLED_FOLDERS for path in (ROOT / folder).iterdir() if path.is_file()
    }
    assert present <= listed
    assert data_files(setup_cfg)["share/ament_index/resource_index/packages"] == ["resource/refu_ros"]


def test_scripts_have_a_main(setup_cfg: configparser.ConfigParser) -> None:
    """Seen without importing them: they need rclpy."""
    scripts = dict(
        line.split(" = ") for line in setup_cfg["options.entry_points"]["console_scripts"].strip().splitlines()
    )
    assert {"refu", "garment_node", "smpl_publisher"} == set(scripts)
    for target in scripts.values():
        module, function = target.split(":")
        tree = ast.parse((ROOT / (module.replace(".", "/") + ".py")).read_text(encoding="utf-8"))
        assert function in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


def test_package_xml(package_xml: ET.Element) -> None:
    (project_version,) = re.findall(r'^version = "(.+)"$', (ROOT / "pyproject.toml").read_text(), flags=re.MULTILINE)
    assert package_xml.findtext("version") == project_version == __version__
    assert package_xml.findtext("name") == "refu_ros"
    assert package_xml.findtext("export/build_type") == "ament_python"


@pytest.mark.parametrize("folder", [".", "refu_msgs"])
def test_package_xml_is_valid(folder: str) -> None:
    catkin = pytest.importorskip("catkin_pkg.package", reason="catkin_pkg isn't installed (extra test)")
    warnings: list[str] = []
    package = catkin.parse_package(str(ROOT / folder), warnings=warnings)
    package.validate(warnings=warnings)
    assert not warnings
    assert package.version == __version__


def test_the_interfaces_are_all_built() -> None:
    """What CMake is told of is what there is, and no definition uses a package that isn't a dependency."""
    folder = ROOT / "refu_msgs"
    listed = set(re.findall(r'"(\w+/\w+\.\w+)"', (folder / "CMakeLists.txt").read_text(encoding="utf-8")))
    files = [path for kind in ("msg", "srv", "action") for path in (folder / kind).iterdir()]
    assert listed == {f"{path.parent.name}/{path.name}" for path in files}
    used = {name for path in files for name in re.findall(r"^(\w+)/\w+", path.read_text(), flags=re.MULTILINE)}
    xml = ET.parse(folder / "package.xml").getroot()
    assert used - {"refu_msgs"} <= {element.text for element in xml.findall("depend")}


def test_package_xml_depends_on_what_is_imported(package_xml: ET.Element) -> None:
    depends = {element.text for element in package_xml.findall("exec_depend")}
    used = set().union(*(imports(path) for path in [*(ROOT / "refu_ros").glob("*.py"), *LAUNCH_FILES]))
    of_ros = {name for name in used if re.fullmatch(r"rclpy|launch\w*|ament_\w+|std_srvs|\w+_(msgs|interfaces)", name)}
    of_ros -= {"builtin_interfaces"}  # comes with every package of messages
    assert {"rclpy", "launch_ros"} <= of_ros <= depends
    executables = {name for path in LAUNCH_FILES for name in re.findall(r'package="(\w+)"', path.read_text())}
    assert executables - {"refu_ros", "rviz2"} <= depends


def test_config_holds_every_parameter_with_its_default() -> None:
    config = yaml.safe_load((ROOT / "config" / "garment_node.yaml").read_text(encoding="utf-8"))
    given = config["/**/garment_node"]["ros__parameters"]
    defaults = {name: spec.default for name, spec in SPECS.items()}
    wanted = {name: list(value) if isinstance(value, tuple) else value for name, value in defaults.items()}
    assert given == wanted
    assert {name: type(value) for name, value in given.items()} == {name: type(v) for name, v in wanted.items()}


def test_config_says_what_is_what_and_what_is_live() -> None:
    """The comments are the launch arguments' descriptions, too."""
    lines = (ROOT / "config" / "garment_node.yaml").read_text(encoding="utf-8").splitlines()
    live = {line.split(":")[0].strip() for line in lines if re.search(r"[;#] live$", line)}
    assert live == {name for name, spec in SPECS.items() if spec.live}
    described = {line.split(":")[0].strip() for line in lines if re.search(r":.*  # ..........", line)}
    assert described == set(SPECS)


def test_documented_parameters() -> None:
    text = (ROOT / "docs" / "guide" / "ros.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)` \| (?:`(.*?)`|zeros|all six) \| (yes|no) \|", text, flags=re.MULTILINE)
    assert {name: live == "yes" for name, _, live in rows} == {name: spec.live for name, spec in SPECS.items()}
    given = {name: yaml.safe_load(default) for name, default, _ in rows if default}
    defaults = {name: list(s.default) if isinstance(s.default, tuple) else s.default for name, s in SPECS.items()}
    assert given == {name: defaults[name] for name in given}


@pytest.mark.parametrize("path", LAUNCH_FILES, ids=lambda path: path.name)
def test_launch_files_have_their_entry_point(path: Path) -> None:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    assert "generate_launch_description" in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


def test_rviz_shows_the_topics() -> None:
    manager = yaml.safe_load((ROOT / "rviz" / "refu.rviz").read_text(encoding="utf-8"))["Visualization Manager"]
    displays = {display["Topic"]["Value"]: display for display in manager["Displays"] if "Topic" in display}
    assert {topic for topic, display in displays.items() if display["Enabled"]} == TOPICS
    assert set(displays) == TOPICS | ON_REQUEST
    assert {display["Topic"]["Depth"] for display in displays.values()} == {1}  # a deeper queue only holds old garments
    assert manager["Global Options"]["Fixed Frame"] == SPECS["frame_id"].default


def test_foxglove_shows_the_topics() -> None:
    layout = json.loads((ROOT / "foxglove" / "refu.json").read_text(encoding="utf-8"))
    topics = layout["configById"]["3D!refu"]["topics"]
    assert {name for name, topic in topics.items() if topic["visible"]} == TOPICS
    assert set(topics) == TOPICS | ON_REQUEST | {"/scene"}
    assert layout["configById"]["3D!refu"]["followTf"] == SPECS["frame_id"].default

    def panels(node: Any) -> list[str]:
        return [node] if isinstance(node, str) else panels(node["first"]) + panels(node["second"])

    assert sorted(panels(layout["layout"])) == sorted(layout["configById"])


@pytest.mark.skipif(importlib.util.find_spec("colcon_ros") is None, reason="colcon isn't installed (extra test)")
@pytest.mark.parametrize("options", [(), ("--symlink-install",)], ids=["plain", "symlink"])
def test_colcon_build(options: tuple[str, ...], tmp_path: Path, setup_cfg: configparser.ConfigParser) -> None:
    """The repository root is a package: built, its environment sourced, its programs run."""
    source = tmp_path / "src" / "refu-ros"
    left_out = shutil.ignore_patterns(
        ".*", "__pycache__", "*.egg-info", "build", "install", "log", "data", "out", "tests", "docs", "venv"
    )
    shutil.copytree(ROOT, source, ignore=left_out)
    environment = os.environ | {"PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}

    def run(*command: str) -> str:
        done = subprocess.run(
            command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=600, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    run(sys.executable, "-m", "colcon", "build", "--paths", str(source), *options)
    prefix = tmp_path / "install" / "refu_ros"
    for target, files in data_files(setup_cfg).items():
        for file in files:
            assert (prefix / target / Path(file).name).read_bytes() == (ROOT / file).read_bytes()
    script = f". {tmp_path}/install/local_setup.sh; cd /; "
    package = run("sh", "-c", script + "python3 -c 'import refu_core; print(refu_core.__path__[0])'").strip()
    assert tmp_path in Path(package).resolve().parents
    assert sorted(path.name for path in Path(package).rglob("*.npz")) == sorted(
        path.name for path in (ROOT / "refu_core").rglob("*.npz")
    )
    programs = prefix / "lib" / "refu_ros"
    assert {"refu", "garment_node", "smpl_publisher"} <= {path.name for path in programs.iterdir()}
    assert __version__ in run("sh", "-c", script + f"{programs}/refu --version")
    if importlib.util.find_spec("rclpy") is not None:
        assert "--ros-args" in run("sh", "-c", script + f"{programs}/smpl_publisher --help")
