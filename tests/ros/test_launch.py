"""The launch files as ROS's own launch reads and runs them; skipped where it isn't installed (pip has no launch)."""

from __future__ import annotations

import os
import runpy
import shutil
import signal
import stat
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("launch_ros", reason="launch_ros isn't installed: it comes with a ROS installation")

from harness import GARMENTS, PATIENCE_S, Peer
from launch.launch_description_sources import get_launch_description_from_python_launch_file
from launch.utilities import perform_substitutions
from launch_ros.actions import Node

from launch import LaunchContext
from refu_core.options import specs_of
from refu_ros._settings import NodeSettings

ROOT = Path(__file__).parents[2]
ROS2 = "import sys; sys.argv[0] = 'ros2'; from ros2cli.cli import main; sys.exit(main())"


@pytest.fixture
def prefix(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The package as installed, though with the programs of this Python, ahead of what else is there."""
    share, programs = tmp_path / "share" / "refu_ros", tmp_path / "lib" / "refu_ros"
    index = tmp_path / "share" / "ament_index" / "resource_index" / "packages"
    for folder in (share, programs, index):
        folder.mkdir(parents=True)
    (index / "refu_ros").touch()
    for folder in ("launch", "config", "rviz", "bags/walk"):
        shutil.copytree(ROOT / folder, share / folder)
    for name in ("garment_node", "smpl_publisher"):
        program = programs / name
        program.write_text(f'#!/bin/sh\ncd {ROOT}\nexec {sys.executable} -m refu_ros.{name} "$@"\n')
        program.chmod(program.stat().st_mode | stat.S_IXUSR)
    rest = os.environ.get("AMENT_PREFIX_PATH")
    monkeypatch.setenv("AMENT_PREFIX_PATH", os.pathsep.join([str(tmp_path), *([rest] if rest else [])]))
    return tmp_path


def arguments(name: str) -> dict[str, tuple[str, str]]:
    """Default and description of each argument."""
    description = get_launch_description_from_python_launch_file(str(ROOT / "launch" / name))
    return {
        argument.name: (perform_substitutions(LaunchContext(), argument.default_value or []), argument.description)
        for argument in description.get_launch_arguments()
    }


@pytest.mark.usefixtures("prefix")
def test_every_parameter_is_a_described_argument() -> None:
    of_node = arguments("garments.launch.py")
    others = {"params_file", "namespace", "log_level", "use_sim_time", "input_topic", "output_topic", "body_topic"}
    assert set(of_node) == set(specs_of(NodeSettings)) | others
    of_demo = arguments("demo.launch.py")
    assert set(of_demo) == set(of_node) | {"motion", "bag", "in_place", "rviz"}
    assert all(len(description) > 10 for _, description in [*of_node.values(), *of_demo.values()])


@pytest.mark.usefixtures("prefix")
def test_a_bad_value_is_one_line_and_nothing_is_started() -> None:
    command = [sys.executable, "-c", ROS2, "launch", "refu_ros", "demo.launch.py", "margin:=abc"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    said = done.stdout + done.stderr
    assert done.returncode == 1
    assert "margin: wanted a value like 0.004, got 'abc'" in said
    assert "process started" not in said
    assert "Traceback" not in said


@pytest.mark.usefixtures("prefix")
def test_what_would_be_ignored_is_said(tmp_path: Path) -> None:
    doubts = runpy.run_path(str(ROOT / "launch" / "garments.launch.py"))["doubts"]
    file = tmp_path / "parameters.yaml"
    for key, namespace, fits in (
        ("/**", "robot", True),
        ("/**/garment_node", "", True),
        ("/robot/garment_node", "/robot/", True),
        ("/*/garment_node", "robot", True),
        ("/*/garment_node", "", False),
        ("/garment_node", "robot", False),  # `ros2 param dump` of a node elsewhere
    ):
        file.write_text(f"{key}:\n  ros__parameters:\n    margin: 0.004\n")
        said = doubts(file, namespace, {"margin", "bag", "its_includers"})
        assert bool(said) != fits, (key, namespace)
        assert fits or said[0].startswith(f"params_file: {file} is for {key}; ")
    file.write_text("robot:\n  garment_node:\n    ros__parameters: {}\n")
    assert doubts(file, "robot", {"garmets"}) == ["there is no argument garmets: is garments meant?"]
    file.write_text("a: [1")
    assert not doubts(file, "", set())  # the node says it
    with pytest.raises(RuntimeError, match=r"^params_file: there is no file "):
        doubts(tmp_path / "none.yaml", "", set())


@pytest.mark.usefixtures("prefix")
def test_launch_makes_no_ros_node_of_its_own() -> None:
    """Threads of one in launch's process kept some Ctrl-C from ending it."""
    run = runpy.run_path(str(ROOT / "launch" / "garments.launch.py"))
    context = LaunchContext()
    context.launch_configurations.update(dict.fromkeys([*run["DEFAULTS"], *run["OTHERS"], *run["TOPICS"]], ""))
    context.launch_configurations["params_file"] = str(run["CONFIG"])
    assert [type(one) for one in run["node"](context)] == [Node]


@pytest.mark.usefixtures("prefix")
@pytest.mark.parametrize(
    ("name", "text", "wanted"),
    [
        ("betas", "[1, 2.5]", [1.0, 2.5]),
        ("max_rate", "30", 30.0),
        ("persons", "[ann]", ["ann"]),
        ("lazy", "false", False),
        ("record", "12", "12"),
        ("betas", "[1, x]", None),
        ("betas", "1", None),
        ("persons", "ann", None),
        ("lazy", "perhaps", None),
        ("use_sim_time", "[", None),
    ],
)
def test_values_have_the_type_of_their_parameter(name: str, text: str, wanted: Any) -> None:
    parsed = runpy.run_path(str(ROOT / "launch" / "garments.launch.py"))["parsed"]
    if wanted is None:
        with pytest.raises(RuntimeError, match=f"^{name}: wanted a value like "):
            parsed(name, text)
    else:
        assert parsed(name, text) == wanted
        assert type(parsed(name, text)) is type(wanted)


def test_the_demo_follows_its_arguments_and_goes_on_without_a_viewer(ros: None, prefix: Path) -> None:  # noqa: ARG001
    pytest.importorskip("ros2launch", reason="ros2launch isn't installed")
    peer, log = Peer(), prefix / "log.txt"
    given: dict[str, Any] = {"namespace": "robot", "persons": "[ann, bob]", "output_topic": "/garments"}
    given |= {"follow_humans": "true", "input_type": "joint_state", "log_level": "warn", "garments": f"[{GARMENTS[0]}]"}
    command = [sys.executable, "-c", ROS2, "launch", "refu_ros", "demo.launch.py"]
    command += [f"{name}:={value}" for name, value in given.items()]
    with log.open("wb") as file:
        process = subprocess.Popen(command, stdout=file, stderr=file, start_new_session=True)
    try:
        wanted = {f"{person}/{GARMENTS[0]}" for person in ("ann", "bob")}
        peer.spin_until(
            lambda: (
                process.poll() is not None or wanted <= {marker.ns for markers in peer.garments for marker in markers}
            ),
            "both are dressed",
        )
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=PATIENCE_S) == 0
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
    text = log.read_text()
    assert text.count("process has finished cleanly") == 2
    assert "Traceback" not in text
    if not list(Path(os.environ["AMENT_PREFIX_PATH"].split(os.pathsep)[-1]).glob("lib/rviz2/rviz2")):
        assert "the package rviz2 isn't installed: sudo apt install ros-" in text
    peer.close()
