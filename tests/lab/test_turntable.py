"""The report's frames that are turned: what is packed is what a browser draws, without a network."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import browser
import numpy as np
import pytest
import trimesh

from refu_core import RefuError
from refu_lab.render import RenderMesh
from refu_lab.turntable import STYLE, Frame, turntable

RED, BLUE = (0.9, 0.15, 0.1), (0.1, 0.2, 0.9)


def page(folder: Path, *, unused: int = 0) -> Path:
    """A red ball within half a blue one, on its left (+x); afterwards the blue one is on the right, and wider.

    Vertices that no triangle uses lie among the blue one's.
    """
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.3)
    half = ball.faces[ball.triangles_center[:, 0] > 0]
    colours = {"body": RED, "half": BLUE}
    inner, outer = np.float32(ball.vertices), np.zeros((len(ball.vertices) + unused, 3), np.float32)
    used = np.random.default_rng(0).permutation(len(outer))[: len(inner)]
    outer[used], half = inner, used[half]
    before = [RenderMesh(inner, ball.faces), RenderMesh(1.2 * outer, half)]
    after = [RenderMesh(inner, ball.faces), RenderMesh(np.float32([-1.5, 1.5, 1.5]) * outer, half)]
    frames = [Frame("one", "<One>", before, after, "was <b>", "is", 0.0)]
    path = folder / "page.html"
    path.write_text(f"<!doctype html><style>{STYLE}</style>{turntable(colours, frames)}", encoding="utf-8")
    return path


@pytest.fixture
def chromium(tmp_path: Path) -> Iterator[browser.Browser]:
    pytest.importorskip("websockets", reason="websockets isn't installed (it comes with viser, extra view)")
    if browser.PROGRAM is None:
        pytest.skip("no Chromium: apt-get install chromium")
    found = browser.Browser(tmp_path / "profile", size=(500, 480))
    yield found
    found.close()


def columns(picture: np.ndarray, channel: int) -> np.ndarray:
    """Of the pixels that are mostly of one colour."""
    others = np.delete(picture.astype(int), channel, axis=2).max(2)
    return np.nonzero(picture[..., channel] > others + 60)[1]


def test_a_page_without_network_draws_turns_and_switches(chromium: browser.Browser, tmp_path: Path) -> None:
    chromium.offline()
    chromium.open(page(tmp_path).as_uri())
    seen = chromium.picture_when(lambda picture: len(columns(picture, 0)) > 2000)
    red, blue = columns(seen[:300], 0), columns(seen[:300], 2)
    assert min(len(red), len(blue)) > 2000
    assert blue.mean() < 240 < red.mean()  # the red half's right is the subject's left
    assert chromium.run('document.querySelector("#turntable p").textContent') == "<One>: is"
    chromium.drag((150, 150), (377, 0))  # half a turn and back to front
    turned = chromium.picture()
    assert columns(turned[:300], 2).mean() > 260
    chromium.run('[...document.querySelectorAll("button")].find((b) => b.textContent == "before").click()')
    assert chromium.run('document.querySelector("#turntable p").textContent') == "<One>: was <b>"
    assert columns(chromium.picture()[:300], 2).mean() < 240
    chromium.run('[...document.querySelectorAll("button")].find((b) => b.textContent == "garments alone").click()')
    assert len(columns(chromium.picture()[:300], 0)) < 100
    assert chromium.errors == []


def test_a_garment_of_60_000_vertices_looks_no_different(chromium: browser.Browser, tmp_path: Path) -> None:
    """As many as a garment of one's own may have: a page once showed 32,768, and refused the rest after the replay."""
    pictures = []
    for unused in (0, 60_000 - 642):
        chromium.open(page(tmp_path, unused=unused).as_uri())
        pictures.append(chromium.picture_when(lambda picture: len(columns(picture, 0)) > 2000))
    np.testing.assert_array_equal(*pictures)


def test_too_many_vertices_are_refused() -> None:
    many = RenderMesh(np.zeros((1 << 16, 3), np.float32), np.array([[0, 1, 2]]))
    frame = Frame("one", "One", [many], [many], "", "", 0.0)
    with pytest.raises(RefuError, match="65536 vertices, a page shows at most 65535"):
        turntable({"body": RED}, [frame])
