"""`refu view`: films of motion and of bags, what is marked, the player, and what a real browser shows of it."""

from __future__ import annotations

import re
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import browser
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import cKDTree

import msg_adapters as adapters
from msg_adapters.markers import MarkerMesh, encode_delete
from refu_core import GarmentPipeline, RefuError, SmplFrame
from refu_core.garments import load_garment, save_garment
from refu_core.metrics import CollisionChecker
from refu_lab.cli import main
from refu_lab.commands.replay import RecordingOptions
from refu_lab.commands.view import ViewOptions
from refu_lab.view import view
from refu_lab.view._dressed import DressedFilm, PersonMotion
from refu_lab.view._film import BODY, SKIN, SceneMesh
from refu_lab.view._marks import CLEARANCE, Band, BandFinder, Marking
from refu_lab.view._player import Player
from refu_lab.view._recorded import MarkerScene, RecordedFilm, Topology, is_drawable
from refu_lab.view._stage import Stage
from refu_lab.view._view import _serve, open_film

ROOT = Path(__file__).parents[2]
SHORTS = ("short-pant-male",)


def motion(n: int = 5, *, left: float = 0.0) -> list[SmplFrame]:
    """Somebody who lifts a knee, far from the origin."""
    frames = []
    for i in range(n):
        pose = np.zeros((24, 3), np.float32)
        pose[16, 2], pose[17, 2], pose[1, 0] = -1.1, 1.1, -0.3 * i
        frames.append(SmplFrame(pose, transl=np.array([5000 + left, 1.0, 0.1 * i]), stamp_ns=10**18 + i * 10**8))
    return frames


def write_bag(path: Path, people: dict[str, list[SmplFrame]]) -> Path:
    encode = adapters.encoder_for("multiarray")
    with adapters.BagWriter(path) as writer:
        for topic, frames in people.items():
            writer.add_topic(topic, adapters.INPUT_TYPES["multiarray"])
            for frame in frames:
                writer.write(topic, encode(frame), log_time_ns=frame.stamp_ns)
    return path


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_bag(tmp_path_factory.mktemp("bag") / "knee.mcap", {"/smpl_params": motion()})


@pytest.fixture(scope="module")
def film(bag: Path) -> DressedFilm:
    return DressedFilm([bag], RecordingOptions(input=Path(), garments=SHORTS))


def by_name(shapes: Any, person: str = "") -> dict[str, SceneMesh]:
    return {shape.name: shape for shape in shapes if shape.person == person}


# ---- films -----------------------------------------------------------------------------------------------------------


def test_a_dressed_film_shows_what_the_pipeline_says(film: DressedFilm) -> None:
    pipeline = GarmentPipeline.load(SHORTS)
    np.testing.assert_allclose(film.times, 0.1 * np.arange(5), atol=1e-9)
    for index, frame in enumerate(motion()):
        shapes, wanted = by_name(film.shapes(index)), pipeline(frame)
        origin = motion()[0].transl
        for name, local in ((BODY, wanted.body), (SKIN, wanted.skin), (SHORTS[0], wanted[SHORTS[0]].local)):
            there = adapters.vertices_ros_from_smpl(local + (frame.transl - origin))
            np.testing.assert_allclose(shapes[name].vertices, there, atol=1e-5)
    assert film.front == pytest.approx(0.0)  # along z of SMPL, which is x here


def test_a_recorded_film_shows_the_same_as_the_dressed_one(film: DressedFilm, bag: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    assert main(["replay", str(bag), "--output", str(out), "--garments", SHORTS[0], "--no-evaluate", "--quiet"]) == 0
    recorded = open_film(ViewOptions(inputs=(out,), dressing=RecordingOptions(input=Path())))
    assert isinstance(recorded, RecordedFilm)
    np.testing.assert_allclose(recorded.times, film.times, atol=1e-9)
    shift = None
    for index in (3, 0, 4):
        kept, dressed = by_name(recorded.shapes(index)), by_name(film.shapes(index))
        assert set(kept) == {BODY, *SHORTS}
        for name, shape in kept.items():
            corners, wanted = (one.vertices[one.faces.reshape(-1)] for one in (shape, dressed[name]))
            shift = corners[0] - wanted[0] if shift is None else shift  # each has an origin of its own
            np.testing.assert_allclose(corners, wanted + shift, atol=2e-5)
            assert len(shape.vertices) == len(dressed[name].vertices)
            assert shape.color == pytest.approx(dressed[name].color, abs=0.1)
    recorded.close()
    again = open_film(ViewOptions(inputs=(out,), dressing=RecordingOptions(input=Path(), garments=SHORTS), dress=True))
    assert isinstance(again, DressedFilm)


def test_people_of_a_bag_are_shown_together_while_they_are_there(tmp_path: Path) -> None:
    late = [SmplFrame(f.pose, transl=f.transl, stamp_ns=f.stamp_ns + 10**9) for f in motion(2, left=1.0)]
    both = write_bag(
        tmp_path / "two.mcap", {"/anna/smpl_params": motion(14), "/ben/smpl_params": late, "/robot": motion(1)}
    )
    film = DressedFilm([both], RecordingOptions(input=Path(), garments=SHORTS))
    assert {shape.person for shape in film.shapes(0)} == {"anna"}
    shapes = film.shapes(10)
    middles = [by_name(shapes, person)[BODY].vertices[:, 1].mean() for person in ("anna", "ben")]
    assert middles[1] - middles[0] == pytest.approx(1.0, abs=0.05)
    assert {shape.person for shape in film.shapes(13)} == {"anna", "ben"}  # a tenth of a second after ben's last


def test_no_two_people_of_several_files_have_one_name(tmp_path: Path) -> None:
    paths = [tmp_path / name for name in ("here/walk.mcap", "there/walk.mcap", "walk-2.mcap")]
    for path in paths:
        path.parent.mkdir(exist_ok=True)
        write_bag(path, {"/smpl_params": motion(1)})
    shapes = DressedFilm(paths, RecordingOptions(input=Path(), garments=SHORTS)).shapes(0)
    assert [shape.person for shape in shapes if shape.name == BODY] == ["walk", "walk-2", "walk-2-2"]


CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])


def triangle(ns: str, stamp_ns: int, *, lifetime_ns: int = 0) -> bytes:
    mesh = MarkerMesh(ns, np.array([[0, 1, 2]]), 3)
    return adapters.MarkerArrayEncoder([mesh], lifetime_ns=lifetime_ns).encode([CORNERS], stamp_ns=stamp_ns)


def test_recorded_people_stay_until_they_leave_whoever_was_told_of_last(tmp_path: Path) -> None:
    """Two who are sent in turn, then one leaves, another's time is over, and the robot starts anew an hour later."""
    ann, bob = (partial(triangle, f"{name}/shirt") for name in ("ann", "bob"))
    said = [
        (0, ann(10**9)),
        (50, bob(10**9 + 5 * 10**7)),
        (100, ann(10**9 + 10**8)),
        (150, bob(10**9 + 15 * 10**7, lifetime_ns=10**8)),
        (200, encode_delete(["ann/shirt"], stamp_ns=10**9)),
        (3_600_000, ann(10**9)),
    ]
    with adapters.BagWriter(tmp_path / "two.mcap") as writer:
        writer.add_topic("/garments", adapters.MARKER_ARRAY)
        for ms, data in said:
            writer.write("/garments", data, log_time_ns=10**12 + ms * 10**6)
    film = RecordedFilm(tmp_path / "two.mcap")
    people = [sorted(shape.person for shape in film.shapes(i)) for i in range(len(film.times))]
    assert people == [["ann"], ["ann", "bob"], ["ann", "bob"], ["ann", "bob"], ["bob"], ["ann"]]
    np.testing.assert_allclose(film.times, [0, 0.05, 0.1, 0.15, 0.2, 1.2])
    film.close()


def test_markers_that_make_no_picture_are_left_out_and_a_rotation_unset_is_none() -> None:
    (whole,) = adapters.decode_marker_array(triangle("shirt", 1))
    unset = replace(whole, pose=(1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 0.0))
    assert is_drawable(whole)
    assert is_drawable(unset)
    first, second = (MarkerScene(lambda shape: shape).shape(one).vertices for one in (unset, whole))
    np.testing.assert_array_equal(first, second)
    for odd in (
        replace(whole, points=whole.points[:2]),
        replace(whole, points=np.full((3, 3), np.nan)),
        replace(whole, points=np.full((3, 3), 1e300)),
        replace(whole, pose=(0.0, 0.0, np.inf, 0.0, 0.0, 0.0, 1.0)),
    ):
        assert not is_drawable(odd)


def test_markers_that_differ_by_their_topics_or_ids_alone_are_shown_side_by_side(server: Any) -> None:
    """As two nodes have them, or other senders: parts of one thing, or people, counted in one namespace."""
    scene: MarkerScene[SceneMesh] = MarkerScene(lambda shape: shape)
    for topic in ("/ann/garments", "/bob/garments"):
        scene.take(topic, triangle("shirt", 1), 0)
    shirts = [replace(shape, vertices=shape.vertices + i) for i, shape in enumerate(scene.shown(1))]
    stage = Stage(server)
    for shown in (shirts, shirts[1:], shirts):
        stage.draw([(shape, [Band(shape.faces, shape.color)]) for shape in shown], wireframe=False)
        found = [one.mesh.vertices for one in stage._drawn.values()]
        np.testing.assert_array_equal(found, [shape.vertices for shape in shown])


def test_meshes_that_stay_for_ever_are_forgotten_in_the_end() -> None:
    scene: MarkerScene[SceneMesh] = MarkerScene(lambda shape: shape)
    for i in range(600):
        scene.take("/garments", triangle(f"p{i}/shirt", 1), 0)
    people = [shape.person for shape in scene.shown(1)]
    assert people == [f"p{i}" for i in range(100, 600)]
    assert len(scene._topologies) == 500


def test_a_robots_own_markers_keep_nobody_from_being_dressed(tmp_path: Path) -> None:
    path = tmp_path / "robot.mcap"
    with adapters.BagWriter(path) as writer:
        writer.add_topic("/smpl_params", adapters.INPUT_TYPES["multiarray"])
        writer.add_topic("/robot", adapters.MARKER_ARRAY)
        writer.write("/robot", encode_delete(["arm"], stamp_ns=1), log_time_ns=10**18)
        for frame in motion(2):
            writer.write("/smpl_params", adapters.encoder_for("multiarray")(frame), log_time_ns=frame.stamp_ns)
    film = open_film(ViewOptions(inputs=(path,), dressing=RecordingOptions(input=Path(), garments=SHORTS)))
    assert isinstance(film, DressedFilm)


def test_what_stays_from_frame_to_frame_is_one_array(film: DressedFilm) -> None:
    first, second = by_name(film.shapes(0)), by_name(film.shapes(1))
    assert all(first[name].faces is second[name].faces for name in first)  # or faces would be sent again and again


def test_files_are_a_person_each_and_garments_can_be_changed(bag: Path, tmp_path: Path) -> None:
    clip = tmp_path / "clip.npz"
    np.savez(clip, poses=np.zeros((3, 72)), trans=np.tile([0.0, 1.0, 0.0], (3, 1)), mocap_framerate=10.0)
    film = DressedFilm([bag, clip, bag], RecordingOptions(input=Path(), garments=SHORTS))
    assert {shape.person for shape in film.shapes(0)} == {"knee", "clip", "knee-2"}
    assert {*SHORTS, "tshirt-male"} <= set(film.wardrobe)
    assert "skirt-female" not in film.wardrobe
    film.wear(["tshirt-male"], "none")
    assert {shape.name for shape in film.shapes(0)} == {BODY, SKIN, "tshirt-male"}
    with pytest.raises(RefuError, match="of one body"):
        film.wear(["tshirt-male", "skirt-female"], "hybrid")
    assert film.garments == ("tshirt-male",)


def test_a_garment_given_as_a_file_is_taken_off_and_put_on_again(bag: Path, tmp_path: Path) -> None:
    mine = str(save_garment(load_garment("tshirt-male"), tmp_path / "mine.npz"))
    film = DressedFilm([bag], RecordingOptions(input=Path(), garments=(mine, *SHORTS), backbone="skinned"))
    film.wear(SHORTS, "none")
    assert "mine" in film.wardrobe
    film.wear(("mine", *SHORTS), "none")
    assert film.garments == ("mine", *SHORTS)


@given(st.integers(0, 2**32 - 1), st.integers(1, 40), st.integers(3, 12))
def test_topology_is_found_from_corners(seed: int, n_faces: int, n_vertices: int) -> None:
    rng = np.random.default_rng(seed)
    faces = rng.integers(0, n_vertices, (n_faces, 3))
    first, later = rng.normal(size=(2, n_vertices, 3))
    found = Topology.of(first[faces.reshape(-1)])
    assert len(found.first) == len(np.unique(faces))
    for vertices in (first, later):
        points = vertices[faces.reshape(-1)]
        assert found.fits(points)
        np.testing.assert_array_equal(points[found.first][found.faces.reshape(-1)], points)
    assert not found.fits(rng.normal(size=(3 * n_faces + 3, 3)))


@given(st.lists(st.integers(0, 5000), min_size=1, max_size=20, unique=True), st.integers(-1000, 6000))
def test_the_nearest_frame_of_a_person_is_shown_if_it_is_near(stamps: list[int], at: int) -> None:
    times = np.sort(stamps) / 1000
    track = PersonMotion("", [SmplFrame(np.zeros((24, 3)), stamp_ns=int(1e9 * t)) for t in times], times, np.eye(3))
    found, gaps = track.at(at / 1000), np.abs(times - at / 1000)
    if gaps.min() > 0.2501:
        assert found is None
    elif gaps.min() < 0.2499:
        assert found is not None
        assert abs(found.stamp_ns / 1e9 - at / 1000) == pytest.approx(gaps.min(), abs=1e-6)


def test_what_was_shown_longest_ago_is_forgotten(film: DressedFilm, bag: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    frame_bytes = sum(shape.vertices.nbytes for shape in film.shapes(0))
    monkeypatch.setattr("refu_lab.view._dressed._CACHE_BYTES", 3 * frame_bytes)
    small = DressedFilm([bag], RecordingOptions(input=Path(), garments=SHORTS))
    shown = [small.shapes(index) for index in (0, 1, 2)]
    assert small.shapes(0) is shown[0]
    small.shapes(3)
    assert small.shapes(0) is shown[0]
    assert small.shapes(2) is shown[2]
    assert small.shapes(1) is not shown[1]


# ---- marks -----------------------------------------------------------------------------------------------------------


def test_bands_have_each_face_once_and_say_what_is_so(film: DressedFilm) -> None:
    shapes = by_name(film.shapes(2))
    body, shorts = shapes[BODY], shapes[SHORTS[0]]
    middle = shorts.vertices.mean(0)
    shorts = replace(shorts, vertices=middle + np.float32(0.93) * (shorts.vertices - middle))  # some of it is inside
    marker = BandFinder()
    for marking in Marking:
        (bands,) = marker.bands(marking, [shorts], body)
        joined = np.concatenate([band.faces for band in bands])
        np.testing.assert_array_equal(np.unique(joined, axis=0), np.unique(shorts.faces, axis=0))
        assert len(joined) == len(shorts.faces)
    checker = CollisionChecker(body.faces)
    checker.update(body.vertices)
    found = checker.check(shorts.vertices, shorts.faces)
    (_, red), *_ = marker.bands(Marking.COLLISIONS, [shorts], body)
    assert len(red.faces) > 20
    assert set(map(tuple, shorts.faces[np.unique(found.pairs[:, 0])])) <= set(map(tuple, red.faces))
    (bands,) = marker.bands(Marking.CLEARANCE, [shorts], body)
    assert found.inside[bands[0].faces].any(1).all()
    assert not found.inside[np.concatenate([band.faces for band in bands[1:]])].any()
    # The surface is never farther off than the nearest of many points on it, and less than a face's size nearer.
    corners = body.vertices[body.faces]
    middles = [(corners[:, k] + corners[:, (k + 1) % 3]) / 2 for k in range(3)]
    near = cKDTree(np.concatenate([body.vertices, corners.mean(1), *middles]))
    above = 0.0
    for band, (limit, _) in zip(bands, CLEARANCE, strict=True):
        if above > 0 and len(band.faces):
            distance = near.query(shorts.vertices)[0][band.faces].min(1)
            assert distance.min() >= above - 1e-6
            assert distance.max() <= limit + 0.02
        above = limit


# ---- the player ------------------------------------------------------------------------------------------------------


@pytest.fixture
def server() -> Iterator[Any]:
    viser = pytest.importorskip("viser", reason="viser isn't installed (extra view)")
    with socket.socket() as probe:
        probe.bind(("localhost", 0))
        port = probe.getsockname()[1]
    found = viser.ViserServer(host="localhost", port=port, verbose=False)
    yield found
    found.stop()


def until(n: int) -> Callable[[], bool]:
    """Ends a player after n rounds."""
    rounds = iter(range(n))
    return lambda: next(rounds, None) is None


def test_the_player_plays_seeks_and_dresses_anew(film: DressedFilm, server: Any) -> None:
    player = Player(server, film)
    for index in range(5):
        film.shapes(index)
    seen = []
    player.run(until=lambda: seen.append(player._index) or len(set(seen)) == 5 or len(seen) > 2000)
    assert set(seen) == set(range(5))
    player._toggle(None)
    assert player._verb() == "play"
    player._seek = 3
    player._changed.set()
    player.run(until=until(1))
    assert player._index == 3
    assert "frame 3 of 5" in player._said.content
    assert set(player._stage._drawn) == {("", BODY, 0), ("", SHORTS[0], 0)}
    player._body.value, player._marking.value = "hidden", "collisions"
    player._boxes["tshirt-male"].value = True
    player.run(until=until(1))
    assert set(film.garments) == {*SHORTS, "tshirt-male"}
    assert {name for _, name, _ in player._stage._drawn} == {*SHORTS, "tshirt-male"}
    for box in player._boxes.values():
        box.value = False
    player.run(until=until(1))  # nothing to wear: said, and left as it is
    assert set(film.garments) == {*SHORTS, "tshirt-male"}
    film.wear(SHORTS, "hybrid")


def test_whatever_a_client_sends_the_film_goes_on(film: DressedFilm, server: Any) -> None:
    """viser checks neither choices nor ranges: a number beyond the film ended the viewer."""
    player = Player(server, film)
    for handle in (player._speed, player._body, player._marking, player._sdf):
        handle._impl.value = "\x1b[31m"
    for frame in (10**9, -5):
        player._frame._impl.value = frame
        player._sought(SimpleNamespace(client=server))
        player.run(until=until(2))
        assert 0 <= player._index < 5
    assert film.sdf == "hybrid"


# ---- the command -----------------------------------------------------------------------------------------------------


def test_without_viser_one_line_says_how_to_get_it(
    bag: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    assert main(["view", str(bag)]) == 2
    assert capsys.readouterr().err == 'refu: error: the viewer needs viser: pip install "refu-ros[view]"\n'


def test_a_port_that_is_taken_is_said(bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("viser", reason="viser isn't installed (extra view)")
    with socket.socket() as taken:
        taken.bind(("localhost", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert main(["view", str(bag), "--port", str(port), "--no-browser", "--garments", SHORTS[0]]) == 2
    assert f"localhost:{port}" in capsys.readouterr().err


@pytest.mark.parametrize("where", ["nowhere.mcap", "empty"])
def test_what_cannot_be_shown_is_said(where: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("viser", reason="viser isn't installed (extra view)")
    if where == "empty":
        with adapters.BagWriter(tmp_path / where):
            pass
    assert main(["view", str(tmp_path / where), "--no-browser", "--garments", SHORTS[0]]) == 2
    assert where in capsys.readouterr().err


# ---- what a browser shows --------------------------------------------------------------------------------------------


def chromium(profile: Path) -> closing[browser.Browser]:
    """A browser that leaves before the server ends: that would wait six seconds for it."""
    pytest.importorskip("viser", reason="viser isn't installed (extra view)")
    if browser.PROGRAM is None:
        pytest.skip("no Chromium: apt-get install chromium")
    return closing(browser.Browser(profile, size=(640, 420)))


def coloured(picture: np.ndarray, hue: tuple[float, float]) -> np.ndarray:
    """Which pixels have saturated colours within these hues [degrees], shape (height, width)."""
    r, g, b = np.moveaxis(picture.astype(float), -1, 0) / 255
    high, low = np.maximum.reduce([r, g, b]), np.minimum.reduce([r, g, b])
    span = np.maximum(high - low, 1e-9)
    angle = np.where(high == r, (g - b) / span % 6, np.where(high == g, (b - r) / span + 2, (r - g) / span + 4)) * 60
    return (span > 0.25) & (angle > hue[0]) & (angle < hue[1])


GREEN = (150.0, 185.0)
"""Hues of the T-shirt."""


def dressed_in_the_middle(picture: np.ndarray) -> bool:
    """Whether a T-shirt is seen, of more than 0.5 % of the pixels, on somebody who stands in the middle."""
    there = coloured(picture, GREEN)
    if there.mean() < 0.005:
        return False
    (row, column), (height, width) = np.argwhere(there).mean(axis=0), there.shape
    return bool(0.15 < row / height < 0.6 and 0.33 < column / width < 0.67)


def test_a_browser_shows_somebody_in_a_green_t_shirt(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "still.mcap", {"/smpl_params": motion(1)})  # who draws in software is slow enough
    with running(bag, "tshirt-male") as lines, chromium(tmp_path / "profile") as page:
        assert not coloured(page.picture(), GREEN).any()
        said = re.search(r"still.mcap: 1 frames at (http://localhost:\d+) ", lines[0])
        assert said is not None
        page.open(said[1])
        seen = page.picture_when(dressed_in_the_middle)  # a mesh may come before the camera has its place
        assert dressed_in_the_middle(seen)
        assert page.errors == []


def test_an_empty_stage_has_no_colour(film: DressedFilm, server: Any, tmp_path: Path) -> None:
    player = Player(server, film)
    player._body.value = "hidden"
    player._stage.draw([], wireframe=False)
    with chromium(tmp_path / "profile") as page:
        page.open(f"http://localhost:{server.get_port()}")
        seen = page.picture_when(lambda picture: coloured(picture, (200, 220)).sum() > 800)  # the panel's button
    assert coloured(seen, (200, 220)).sum() > 800
    assert coloured(seen, GREEN).sum() < 100


@contextmanager
def running(bag: Path, *garments: str) -> Iterator[list[str]]:
    """A viewer in a thread, from its first line on; what it says."""
    lines: list[str] = []
    end = threading.Event()
    options = ViewOptions(inputs=(bag,), dressing=RecordingOptions(input=Path(), garments=garments), browser=False)
    how: dict[str, Any] = {"say": lines.append, "until": end.is_set}
    thread = threading.Thread(target=view, args=(options,), kwargs=how)
    thread.start()
    try:
        while not lines:
            assert thread.is_alive()
            time.sleep(0.01)
        yield lines
    finally:
        end.set()
        thread.join()


def test_pages_of_other_sites_are_not_served() -> None:
    """Any page of the web may connect to localhost, and read the people who are shown there."""
    viser = pytest.importorskip("viser", reason="viser isn't installed (extra view)")
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    server = _serve(ViewOptions(dressing=RecordingOptions(input=Path())))
    try:
        port, spoken = server.get_port(), [f"viser-v{viser.__version__}"]
        for origin in (f"http://localhost:{port}", "http://127.0.0.1:9090", None):
            with connect(f"ws://localhost:{port}", origin=origin, subprotocols=spoken, open_timeout=300) as page:
                assert page.recv(timeout=300)
        for origin in ("https://evil.example", f"http://localhost.evil.example:{port}", "null"):
            with (
                pytest.raises(InvalidStatus, match="403"),
                connect(f"ws://localhost:{port}", origin=origin, open_timeout=300),
            ):
                pass
    finally:
        server.stop()


def test_clients_choose_values_and_nothing_else(film: DressedFilm, monkeypatch: pytest.MonkeyPatch) -> None:
    """viser itself would put the people who are shown on the web, for anybody who connects, and take in any file."""
    viser = pytest.importorskip("viser", reason="viser isn't installed (extra view)")
    import msgspec
    from viser import _messages as told
    from websockets.sync.client import connect

    shared = list[bool]()
    monkeypatch.setattr(viser.ViserServer, "request_share_url", lambda _: shared.append(True))
    server = _serve(ViewOptions(dressing=RecordingOptions(input=Path())))
    try:
        player = Player(server, film)
        speed, wire = player._speed._impl, player._wire._impl
        file = {"transfer_uuid": "1", "filename": "a", "mime_type": "b", "part_count": 0, "size_bytes": 0}
        sent = (
            told.ShareUrlRequest(),
            told.FileTransferStartUpload(source_component_uuid=speed.uuid, **file),
            told.GuiUpdateMessage(speed.uuid, {"props": None}),
            told.GuiUpdateMessage(wire.uuid, {"value": True, "props": None}),
            told.GuiUpdateMessage(player._follows._impl.uuid, {"value": False}),
        )
        spoken = [f"viser-v{viser.__version__}"]
        with connect(f"ws://localhost:{server.get_port()}", subprotocols=spoken, open_timeout=300) as page:
            for message in sent:
                page.send(msgspec.msgpack.encode(message.as_serializable_dict()))
            end = time.monotonic() + 300
            while player._follows.value and time.monotonic() < end:
                time.sleep(0.01)
        assert player._follows.value is False
        assert player._speed.value == "1 ×"
        assert player._wire.value is False
        assert speed.props is not None
        player._show(0)
    finally:
        server.stop()
    assert shared == []  # `stop` has waited for what was under way


def test_an_interrupt_closes_the_viewer(bag: Path) -> None:
    pytest.importorskip("viser", reason="viser isn't installed (extra view)")
    lines: list[str] = []
    options = ViewOptions(inputs=(bag,), dressing=RecordingOptions(input=Path(), garments=SHORTS), browser=False)

    def interrupt() -> bool:
        raise KeyboardInterrupt

    view(options, say=lines.append, until=interrupt)
    assert lines[1:] == ["viewer closed"]


def test_view_ends_when_it_is_told_to(bag: Path) -> None:
    pytest.importorskip("viser", reason="viser isn't installed (extra view)")
    lines: list[str] = []
    options = ViewOptions(inputs=(bag,), dressing=RecordingOptions(input=Path(), garments=SHORTS), browser=False)
    view(options, say=lines.append, until=until(2))
    assert any(re.search(r"http://localhost:\d+", line) for line in lines)
