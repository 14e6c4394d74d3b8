"""The house rules that a program can check: format, lint, types, and who may import whom."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("command", [["ruff", "format", "--check"], ["ruff", "check"], ["mypy"]], ids=" ".join)
def test_tools_are_silent(command: list[str]) -> None:
    if importlib.util.find_spec(command[0]) is None:
        pytest.skip(f"{command[0]} isn't installed (extra dev)")
    if command == ["mypy"] and sys.version_info < (3, 11):
        pytest.skip("numpy's last release for Python 3.10 lacks types that later ones have")
    done = subprocess.run([sys.executable, "-m", *command], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize(
    ("package", "forbidden"),
    [
        ("msg_adapters", {"torch", "warp", "rclpy", "matplotlib", "rosbags"}),
        ("refu_core", {"torch", "warp", "rclpy", "msg_adapters"}),
        ("refu_core.realtime", {"rclpy", "msg_adapters", "matplotlib", "refu_core.evaluation", "refu_core.simulation"}),
        ("refu_ros.cli", {"torch", "warp", "rclpy"}),
    ],
)
def test_imports_point_one_way(package: str, forbidden: set[str]) -> None:
    """What a package must not pull in, seen from a fresh interpreter."""
    code = f"import sys, {package}; print('\\n'.join(sys.modules))"
    loaded = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert not forbidden & set(loaded.split())
