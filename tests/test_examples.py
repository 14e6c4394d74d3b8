"""Each example runs as a user runs it, and what it prints is right."""

from __future__ import annotations

import re
import runpy
import sys
from pathlib import Path

import pytest
import trimesh

from refu_core import load_body, load_garment

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    """Runs `python examples/NAME.py ARGUMENTS` in an empty folder; what it prints."""

    def of(name: str, *arguments: str) -> str:
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", [f"{name}.py", *arguments])
        runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")
        return capsys.readouterr().out

    return of


def numbers(pattern: str, text: str) -> list[float]:
    """The groups of the only match."""
    (match,) = re.finditer(pattern, text)
    return [float(group) for group in match.groups()]


def test_every_example_has_a_test_and_is_short() -> None:
    here = Path(__file__).read_text(encoding="utf-8")
    for path in EXAMPLES.glob("*.py"):
        assert f'run("{path.stem}"' in here
        assert len(path.read_text(encoding="utf-8").splitlines()) <= 60


def test_signed_distance(run) -> None:
    said = run("signed_distance")
    off, slope = numbers(r"the derivative to (\S+); .*surface: (\S+)", said)
    assert off < 1e-5
    assert slope == pytest.approx(-1, abs=0.02)
    distances = [float(d) for d in re.findall(r"\]: (\S+) m", said)]
    assert distances == pytest.approx([0.3, 0.05**0.5 - 0.5, 0.1], abs=2e-3)


def test_own_mesh(run) -> None:
    inside, _, before, after = numbers(
        r"(\d+) of (\d+) vertices were inside(?s:.*): (\d+) before, (\d+) after", run("own_mesh")
    )
    assert inside > 1000
    assert before > 100
    assert after == 0


def test_own_mesh_from_a_file(run, tmp_path: Path) -> None:
    template = load_garment("tshirt-male")
    mesh = trimesh.Trimesh(template.v_template + 0.02, template.faces, process=False)
    mesh.export(tmp_path / "mine.obj")
    before, after = numbers(r": (\d+) before, (\d+) after", run("own_mesh", "mine.obj"))
    assert before > 0
    assert after == 0
    trimesh.Trimesh(100 * mesh.vertices, mesh.faces, process=False).export(tmp_path / "centimetres.obj")
    _, high = numbers(r"all were (-?\d+) to (\d+) mm off the skin", run("own_mesh", "centimetres.obj"))
    assert high > 10_000  # else nobody sees why nothing was inside
    with pytest.raises(SystemExit, match=r"own_mesh.py: gone.obj: can't be read: No such file"):
        run("own_mesh", "gone.obj")


def test_refu_layer(run) -> None:
    first, last, inside = numbers(r"loss (\S+) → (\S+); (\S+) %", run("refu_layer"))
    assert last < 0.5 * first
    assert inside == 0


def test_batch(run) -> None:
    counts = re.findall(r"(\d+) inside before, (\d+) after", run("batch"))
    assert len(counts) == 8
    assert all(int(before) > 0 and int(after) == 0 for before, after in counts)


def test_gradients(run) -> None:
    before, after = numbers(r": (\S+) mm → (\S+) mm", run("gradients"))
    assert after < 0.3 * before


def test_export_glb(run, tmp_path: Path) -> None:
    run("export_glb", "out.glb")
    scene = trimesh.load(tmp_path / "out.glb")
    assert set(scene.geometry) == {"body", "tshirt-male", "short-pant-male"}
    assert len(scene.geometry["body"].faces) == len(load_body("male").faces)
    assert scene.extents == pytest.approx([1.0, 1.7, 0.4], abs=0.4)


def test_robot_outputs(run) -> None:
    said = run("robot_outputs")
    for name in ("waist", "left_leg", "right_leg"):
        assert f"{name}: at " in said
    assert numbers(r"nearest to the skin: (\S+) mm", said)[0] > 0
    assert "between ('trunk', 'left_thigh')" in said
    assert numbers(r"planner: (\d+) triangles", said)[0] <= 2000
    seen, sigma = numbers(r"seen: (\d+)%; sigma (\S+) mm", said)
    assert 10 < seen < 80
    assert 5 < sigma < 30


def test_follow_camera(run) -> None:
    said = re.findall(r"(\d+) places, (\S+) mm → (\S+) mm, (\d+) inside", run("follow_camera"))
    frames = [[float(number) for number in row] for row in said]
    assert len(frames) == 4
    for points, before, after, inside in frames:
        assert points > 100
        assert after < 0.7 * before
        assert inside == 0
