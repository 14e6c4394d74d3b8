"""`refu view --live`: a browser shows who is on a node's topics, who moves, and no longer who has left."""

from __future__ import annotations

import re
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="rclpy isn't installed (extra ros): no node can be looked at")

import browser
import rclpy
from harness import PATIENCE_S
from rclpy.qos import QoSProfile, ReliabilityPolicy
from visualization_msgs.msg import MarkerArray

import msg_adapters as adapters
from msg_adapters.markers import encode_delete
from refu_core import RefuError, load_garment
from refu_lab.cli import main
from refu_lab.commands.replay import RecordingOptions
from refu_lab.commands.view import ViewOptions
from refu_lab.view import view
from refu_lab.view._live import LiveFilm
from refu_lab.view._player import Player

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

pytestmark = pytest.mark.filterwarnings("ignore:module 'sre_:DeprecationWarning")


class Node:
    """Sends a garment's markers, as the node does."""

    def __init__(self, reliability: ReliabilityPolicy = ReliabilityPolicy.RELIABLE) -> None:
        garment = load_garment("tshirt-male")
        self.rest = garment.v_template.numpy()
        mesh = adapters.MarkerMesh("tshirt-male", garment.faces.numpy(), len(self.rest), color=(0.1, 0.7, 0.5, 1.0))
        self._encoder = adapters.MarkerArrayEncoder([mesh])
        self._node = rclpy.create_node("dresser")
        self._publisher = self._node.create_publisher(
            MarkerArray, "garments", QoSProfile(depth=5, reliability=reliability)
        )

    def send(self, x: float, stamp_ns: int) -> None:
        """A T-shirt, so far along SMPL's x."""
        self._publisher.publish(self._encoder.encode([self.rest], stamp_ns=stamp_ns, transl=np.array([x, 0.0, 0.0])))

    def leave(self) -> None:
        """Nobody is there."""
        self._publisher.publish(encode_delete(["tshirt-male"], stamp_ns=0))

    def send_raw(self, data: bytes) -> None:
        """Any bytes."""
        self._publisher.publish(data)

    def until(self, condition: Callable[[], bool], then: Callable[[], object]) -> None:
        """Sends until something is so."""
        end = time.monotonic() + PATIENCE_S
        while time.monotonic() < end:
            then()
            if condition():
                return
            rclpy.spin_once(self._node, timeout_sec=0.02)
        pytest.fail("waited in vain")

    def close(self) -> None:
        """Leaves the graph."""
        self._node.destroy_node()


@pytest.fixture
def node(ros: None) -> Iterator[Node]:  # noqa: ARG001
    found = Node()
    yield found
    found.close()


def test_a_film_shows_what_is_published_and_not_who_has_left(node: Node) -> None:
    film = LiveFilm(["garments"])
    try:
        assert not film.wait(lambda: True)
        assert not film.shapes(0)
        node.until(lambda: len(film.shapes(0)) == 1, lambda: node.send(0.0, 10**9))
        (first,) = film.shapes(0)
        assert (first.name, first.person, len(first.vertices)) == ("tshirt-male", "", len(node.rest))
        node.until(lambda: "stamp 2.00 s" in film.facts(0)[0], lambda: node.send(0.5, 2 * 10**9))
        (second,) = film.shapes(0)
        assert second.faces is first.faces
        np.testing.assert_allclose(second.vertices - first.vertices, [[0.0, 0.5, 0.0]] * len(node.rest), atol=1e-5)
        node.until(
            lambda: any("can't be drawn" in fact for fact in film.facts(0)),
            lambda: node.send_raw(b"\0\1\0\0\xff\xff\xff\xff"),
        )
        node.until(lambda: not film.shapes(0), node.leave)
    finally:
        film.close()


def test_a_best_effort_publisher_is_heard_too(ros: None) -> None:  # noqa: ARG001
    """As the guide has it for garments: nothing came, and nothing was shown."""
    node, film = Node(ReliabilityPolicy.BEST_EFFORT), LiveFilm(["garments"])
    try:
        node.until(lambda: bool(film.shapes(0)), lambda: node.send(0.0, 10**9))
    finally:
        film.close()
        node.close()


def test_who_leaves_before_the_viewer_begins_does_not_end_it(node: Node) -> None:
    viser = pytest.importorskip("viser", reason="viser isn't installed (extra view)")
    film, server = LiveFilm(["garments"]), viser.ViserServer(host="localhost", verbose=False)
    try:
        node.until(lambda: bool(film.shapes(0)), lambda: node.send(0.0, 10**9))
        node.until(lambda: not film.shapes(0), node.leave)
        player = Player(server, film)
        end = time.monotonic() + PATIENCE_S

        def is_drawn() -> bool:
            node.send(0.0, 2 * 10**9)  # again and again, as a node does: what is old is gone
            return ("", "tshirt-male", 0) in player._stage._drawn or time.monotonic() > end

        player.run(until=is_drawn)
        assert time.monotonic() < end
    finally:
        server.stop()
        film.close()


def test_what_is_no_topic_is_said(ros: None, capsys: pytest.CaptureFixture[str]) -> None:  # noqa: ARG001
    with pytest.raises(RefuError, match="no topics"):
        LiveFilm(["not a topic"])
    assert main(["view", "--no-browser"]) == 2
    assert "--live" in capsys.readouterr().err
    assert main(["view", "bags/walk", "--live", "garments", "--no-browser"]) == 2
    assert "--live" in capsys.readouterr().err


def green(picture: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Where the T-shirt is."""
    red, other, blue = (picture[..., k].astype(int) for k in range(3))
    return (other - red > 50) & (other >= blue)  # type: ignore[no-any-return]


@pytest.mark.skipif(browser.PROGRAM is None, reason="no Chromium: apt-get install chromium")
def test_a_browser_shows_it(node: Node, tmp_path: Path) -> None:
    pytest.importorskip("viser", reason="viser isn't installed (extra view)")
    said: list[str] = []
    end = threading.Event()
    options = ViewOptions(live=("garments",), dressing=RecordingOptions(input=Path()), browser=False)
    how: dict[str, Any] = {"say": said.append, "until": end.is_set}
    viewer = threading.Thread(target=view, args=(options,), kwargs=how)
    viewer.start()
    chromium = browser.Browser(tmp_path / "profile", size=(640, 420))
    try:
        node.until(lambda: len(said) > 1, lambda: node.send(0.0, 10**9))
        assert said[0] == "live: garments: waiting for garments"
        address = re.search(r"(http://localhost:\d+) ", said[1])
        assert address is not None
        chromium.open(address[1])
        seen = chromium.picture_when(lambda picture: int(green(picture).sum()) > 1500)
        assert green(seen).sum() > 1500  # of 268,800
        node.until(lambda: int(green(chromium.picture()).sum()) < 100, node.leave)
        assert chromium.errors == []
    finally:
        chromium.close()  # before the server ends, which would wait six seconds for it
        end.set()
        viewer.join()
