"""The node from its first line to its last: what a bad start says, what a good one says, and who may end it."""

from __future__ import annotations

import signal
import time
from contextlib import closing
from typing import TYPE_CHECKING, Any

import pytest

pytest.importorskip("rclpy", reason="rclpy isn't installed (extra ros): the node isn't tested")

from harness import CHEAP, PATIENCE_S, NodeProcess, Peer, frame

from tests.ros.peers import HostilePeers

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.filterwarnings("ignore:module 'sre_:DeprecationWarning")


def test_hostile_peers_do_not_end_it(ros: None, tmp_path: Path) -> None:  # noqa: ARG001
    with NodeProcess(tmp_path / "log.txt", **CHEAP, use_sim_time=True) as node:
        peers = HostilePeers(tmp_path, seed=0)
        peers.wait()
        peers.attack(tries=500, alive=lambda: node.process.poll() is None)
        peers.recover(alive=lambda: node.process.poll() is None)
        peers.close()
        assert not peers.result.problems, (peers.result, node.log)
        assert not sum(peers.result.unanswered.values()), peers.result
        assert node.stop(signal.SIGINT, signal.SIGINT) == 0, node.log
        assert "Traceback" not in node.log


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"record": "/"}, "record: wanted the path of a folder"),
        ({"betas": "[1.0,2]"}, "betas:=[1.0,2]"),
        ({"margin": "abc"}, "margin: wanted a number, got 'abc'"),
        ({"threads": "x" * 5000}, "Trying to set parameter 'threads'"),  # rclpy's words, with the value
    ],
    ids=["record", "betas", "margin", "threads"],
)
def test_a_bad_parameter_is_named_in_one_line(
    ros: None,  # noqa: ARG001
    tmp_path: Path,
    arguments: dict[str, Any],
    words: str,
) -> None:
    with NodeProcess(tmp_path / "log.txt", **arguments) as node:
        assert node.ends() == 2
        (line,) = node.log.splitlines()
        assert line.startswith("garment_node: error: ")
        assert words in line
        assert len(line) < 330


LOADS_FOREVER = """
import threading
from refu_core.options import PipelineOptions
def load(*_, **__):
    print("loading", flush=True)
    threading.Event().wait()
PipelineOptions.load = load
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_while_it_loads(ros: None, tmp_path: Path, number: signal.Signals) -> None:  # noqa: ARG001
    with NodeProcess(tmp_path / "log.txt", first=LOADS_FOREVER) as node:
        end = time.monotonic() + PATIENCE_S
        while "loading" not in node.log and node.process.poll() is None and time.monotonic() < end:
            time.sleep(0.05)
        assert "loading" in node.log
        assert node.stop(number) == -number, node.log  # at once: it never gets as far as to look whether it was told to
        assert "Traceback" not in node.log


def test_its_frame_is_compared_with_the_senders(ros: None, tmp_path: Path) -> None:  # noqa: ARG001
    with NodeProcess(tmp_path / "log.txt", **CHEAP, frame_id="odom") as node, closing(Peer()) as peer:
        peer.wait_for_node()
        marker = peer.dress(frame(1))
        assert marker.lifetime_ns == 2 * 10**9
        peer.spin_until(lambda: peer.status("input")[2].get("frame") == "map, shown as odom", "both frames are named")
        assert node.log.count("is in map, the garments are in odom") == 1
        for line in (
            "configured with tshirt-male",
            "listening to /smpl_params",
            "active",
            "the first garments are out",
        ):
            peer.spin_until(lambda line=line: line in node.log, line)  # it may be said after the garment has come
        hardware = {status.hardware_id for array in peer.diagnostics for status in array.status}
        assert hardware - {""}
