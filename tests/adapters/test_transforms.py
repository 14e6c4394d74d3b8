"""Where a frame was at a time: against numbers that scipy makes."""

from __future__ import annotations

import time
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference import deserialise, serialise
from scipy.spatial.transform import Rotation, Slerp

from msg_adapters import (
    TF_MESSAGE,
    DecodeError,
    Held,
    MessageFilter,
    Placement,
    TransformBuffer,
    TransformError,
)
from msg_adapters.axes import InputAxes, up_of_sender
from msg_adapters.statistics import Statistics
from msg_adapters.transforms import HISTORY_NS, Transform, decode_transforms, encode_transforms
from refu_core import SmplFrame

S = 10**9
MS = 10**6


def transform(parent: str, child: str, stamp_ns: int = 0, seed: int = 0, **other: Any) -> Transform:
    rng = np.random.default_rng(seed)
    values = {"translation": rng.normal(size=3), "quaternion": Rotation.random(rng=rng).as_quat(), **other}
    return Transform(stamp_ns, parent, child, **values)


def put(buffer: TransformBuffer, *transforms: Transform, is_static: bool = False) -> int:
    return len(buffer.put(encode_transforms(transforms), is_static=is_static))


def matrix(one: Transform | Placement) -> Any:
    """4 by 4, by scipy."""
    full = np.eye(4)
    is_placed = isinstance(one, Placement)
    full[:3, :3] = one.rotation if is_placed else Rotation.from_quat(one.quaternion).as_matrix()  # type: ignore[union-attr]
    full[:3, 3] = one.translation
    return full


def test_messages_are_those_of_tf2() -> None:
    ones = [transform("map", "odom", 5, 1), transform("odom", "base", 7 * S, 2)]
    data = encode_transforms(ones)
    message = deserialise(data, TF_MESSAGE)
    assert serialise(message, TF_MESSAGE) == data
    for theirs, sent, back, values in zip(message.transforms, ones, *decode_transforms(data), strict=True):
        assert (theirs.header.frame_id, theirs.child_frame_id) == (sent.parent, sent.child)
        assert back == (sent.stamp_ns, sent.parent, sent.child)
        t, q = theirs.transform.translation, theirs.transform.rotation
        np.testing.assert_array_equal([t.x, t.y, t.z, q.x, q.y, q.z, q.w], [*sent.translation, *sent.quaternion])
        np.testing.assert_array_equal(values, [*sent.translation, *sent.quaternion])
    with pytest.raises(DecodeError):
        decode_transforms(data[:-40])


@given(st.integers(0, 1000), st.integers(1, 5), st.integers(0, 4))
@settings(max_examples=30)
def test_chains_multiply_as_matrices_do(seed: int, up: int, down: int) -> None:
    """From a leaf to another, over the frame that both hang on; some static, some moving."""
    buffer, left, right = TransformBuffer(), np.eye(4), np.eye(4)
    for i in range(up):
        one = transform(f"l{i}" if i else "root", f"l{i + 1}", S, seed + i)
        put(buffer, one, is_static=bool(i % 2))
        left = left @ matrix(one)
    for i in range(down):
        one = transform(f"r{i}" if i else "root", f"r{i + 1}", S, seed + 50 + i)
        put(buffer, one, is_static=not i % 2)
        right = right @ matrix(one)
    target = f"r{down}" if down else "root"
    found = buffer.lookup(target, f"l{up}", S)
    np.testing.assert_allclose(matrix(found), np.linalg.inv(right) @ left, atol=1e-12)
    back = buffer.lookup(f"l{up}", f"/{target}", S)
    np.testing.assert_allclose(matrix(back) @ matrix(found), np.eye(4), atol=1e-12)
    assert not found.is_late


@given(st.floats(0, 1), st.integers(0, 100))
def test_between_two_transforms_it_is_in_between(fraction: float, seed: int) -> None:
    buffer = TransformBuffer()
    ones = [transform("map", "cam", i * S, seed + i) for i in range(4)]
    put(buffer, *ones)
    stamp = S + int(fraction * S)
    found = buffer.lookup("map", "cam", stamp)
    slerp = Slerp([1, 2], Rotation.from_quat([ones[1].quaternion, ones[2].quaternion]))
    share = (stamp - S) / S
    np.testing.assert_allclose(found.rotation, slerp(1 + share).as_matrix(), atol=1e-7)
    wanted = (1 - share) * np.asarray(ones[1].translation) + share * np.asarray(ones[2].translation)
    np.testing.assert_allclose(found.translation, wanted, atol=1e-12)


@given(st.lists(st.integers(0, 40), min_size=1, max_size=40))
def test_a_time_is_asked_of_those_who_spoke_last(tenths: list[int]) -> None:
    """A clock that is set back, by however little: what was said of a later time before is never mixed in."""
    buffer = TransformBuffer()
    for run, tenth in enumerate(tenths):
        put(buffer, Transform(tenth * S // 10, "map", "cam", [float(run), 0.0, 0.0], [0, 0, 0, 1]))
    kept = [run for run, tenth in enumerate(tenths) if all(tenth < later for later in tenths[run + 1 :])]
    for run in kept:
        assert buffer.lookup("map", "cam", tenths[run] * S // 10).translation[0] == run
    for one, two in pairwise(kept):
        between = buffer.lookup("map", "cam", (tenths[one] + tenths[two]) * S // 20)
        assert between.translation[0] == pytest.approx(0.5 * (one + two))
    with pytest.raises(TransformError, match="older than the input"):
        buffer.lookup("map", "cam", tenths[-1] * S // 10 + 1)


def test_late_and_old_and_missing() -> None:
    buffer = TransformBuffer()
    put(buffer, transform("map", "base", 5 * S), transform("map", "base", 6 * S))
    put(buffer, transform("base", "cam", 0, 3), is_static=True)
    assert not buffer.lookup("map", "cam", 6 * S).is_late
    assert buffer.lookup("map", "cam", 6 * S + 50, tolerance_ns=100).is_late
    with pytest.raises(TransformError, match=r"base is 1\.000 s older"):
        buffer.lookup("map", "cam", 7 * S, tolerance_ns=100)
    with pytest.raises(TransformError, match=r"base is 1\.000 s newer"):
        buffer.lookup("map", "cam", 4 * S)
    for target, source in (("map", "lidar"), ("world", "cam"), ("map", "")):
        with pytest.raises(TransformError, match="no transform leads"):
            buffer.lookup(target, source, 6 * S)
    np.testing.assert_array_equal(matrix(buffer.lookup("cam", "cam", 0)), np.eye(4))  # itself, at any time
    assert not buffer.lookup("base", "cam", 10**18).is_late  # static: at any time


def test_what_makes_no_sense_is_left_out_and_counted() -> None:
    buffer = TransformBuffer()
    bad = [
        transform("map", "map"),
        transform("", "cam"),
        transform("map", ""),
        transform("map", "x" * 256),
        transform("map", "cam", quaternion=np.zeros(4)),
        transform("map", "cam", quaternion=np.array([0, 0, 0, 2.0])),
        transform("map", "cam", translation=np.array([np.nan, 0, 0])),
        transform("map", "cam", translation=np.array([0, 1e300, 0])),
        transform("map", "cam", quaternion=np.array([0, 0, 0, 1e300])),
    ]
    assert put(buffer, *bad) == len(bad)
    assert len(buffer) == 0
    (said,) = buffer.put(encode_transforms(bad[5:6]), is_static=False)
    assert said == "'cam' in 'map', which is no rotation: wanted a quaternion of length 1, got 2"
    put(buffer, transform("a", "b"), transform("b", "a"))  # a ring ends
    for target, source in (("map", "a"), ("a", "b"), ("b", "a")):
        with pytest.raises(TransformError, match=r"ring, end who sends one of these: (a in b in a|b in a in b)$"):
            buffer.lookup(target, source, 0)


@pytest.mark.parametrize("stray", ["cam", "odom", "wrist"])
def test_a_ring_is_an_error_only_for_those_whose_way_goes_along_it(stray: str) -> None:
    """A transform too many, of the map in a frame below it: which of the two ways is meant?"""
    buffer = TransformBuffer()
    put(buffer, transform("map", "odom", S, 1), transform("odom", "cam", S, 2), transform("cam", "lens", S, 3))
    put(buffer, transform("odom", "wrist", S, 4), transform("wrist", "tip", S, 5))
    before = {pair: matrix(buffer.lookup(*pair, S)) for pair in (("cam", "lens"), ("wrist", "tip"))}
    put(buffer, transform(stray, "map", S, 6))
    ring = {"cam": "cam in odom in map", "odom": "odom in map", "wrist": "odom in map in wrist"}[stray]
    for source in ("odom", "cam", "lens"):
        with pytest.raises(TransformError, match="frames form a ring") as raised:
            buffer.lookup("map", source, S)
        assert {*str(raised.value).partition("these: ")[2].split(" in ")} == {*ring.split(" in ")}
        with pytest.raises(TransformError, match="frames form a ring"):
            buffer.known_until("map", source)
    for pair, found in before.items():  # what hangs on the ring without going along it
        np.testing.assert_array_equal(matrix(buffer.lookup(*pair, S)), found)


@given(st.lists(st.tuples(st.integers(1, 30), st.booleans()), min_size=1, max_size=6), st.integers(0, 40))
def test_until_when_a_way_is_known_is_when_it_needs_no_tolerance(links: list[tuple[int, bool]], tenths: int) -> None:
    buffer = TransformBuffer()
    for i, (newest, is_static) in enumerate(links):
        ones = [transform(f"f{i}", f"f{i + 1}", stamp * S // 10, i) for stamp in (0, newest)]
        put(buffer, *ones, is_static=is_static)
    until = buffer.known_until("f0", f"f{len(links)}")
    assert until == min((newest * S // 10 for newest, is_static in links if not is_static), default=2**63 - 1)
    if tenths * S // 10 <= until:
        buffer.lookup("f0", f"f{len(links)}", tenths * S // 10)
    else:
        with pytest.raises(TransformError, match="older than the input"):
            buffer.lookup("f0", f"f{len(links)}", tenths * S // 10)


def test_no_way_is_so_long_that_nobody_else_is_served() -> None:
    buffer = TransformBuffer()
    put(buffer, *(transform(f"f{i + 1}", f"f{i}") for i in range(9_999)), is_static=True)
    assert len(buffer) == 9_999
    assert len(buffer._way("f0")) <= 200
    buffer.lookup("f50", "f0", 0)
    buffer.lookup("f0", "f50", 0)
    with pytest.raises(TransformError, match="no transform leads from f0 to f9999"):
        buffer.lookup("f9999", "f0", 0)


def test_history_is_bounded_and_a_clock_may_go_back() -> None:
    buffer = TransformBuffer()
    for i in range(3000):
        put(buffer, transform("map", "cam", i * S // 100, i))
    track = buffer._tracks["cam"]
    assert track.stamps[-1] - track.stamps[0] == HISTORY_NS
    assert len(track.stamps) == len(track.values) == 1001
    put(buffer, transform("map", "cam", 5 * S))
    assert track.stamps == [5 * S]
    for i in range(10_010):  # all of a moment
        put(buffer, Transform(6 * S + i, "map", "cam", [float(i), 0, 0], [0, 0, 0, 1]))
    assert len(track.stamps) == len(track.values) == 10_000
    put(buffer, transform("odom", "cam", 4 * S))  # another parent: what was known of the one before is over
    with pytest.raises(TransformError):
        buffer.lookup("map", "cam", 5 * S)


def test_frames_that_wait_in_a_crowd_of_frames_cost_little() -> None:
    """Each way was sought through its own length for each of its steps: a message cost seconds, then a minute."""

    def seconds(n: int) -> float:
        buffer, waiting = TransformBuffer(), MessageFilter(Statistics())
        put(buffer, *(transform(f"{side}{i}", f"{side}{i + 1}") for side in "ab" for i in range(n)))
        put(
            buffer, transform("root", "a0"), transform("root", "b0"), *(transform(f"a{n}", f"c{i}") for i in range(640))
        )
        for i in range(640):
            waiting.put(Held(f"p{i % 64}", SmplFrame(np.zeros((24, 3)), stamp_ns=S), f"c{i}", 0))
        begun = time.perf_counter()
        assert not [*waiting.ready(buffer, f"b{n}", 1, S)]
        return time.perf_counter() - begun

    assert min(seconds(95) for _ in range(3)) < 30 * min(seconds(2) for _ in range(3))


def test_where_things_were_is_forgotten_when_the_clock_is_set_back() -> None:
    """What is sent anew was placed where things had been at that time before, or between there and where they are."""
    steady = 0.0
    buffer = TransformBuffer(clock=lambda: steady)
    put(buffer, transform("cam", "lens"), is_static=True)
    for tenths in range(80):
        put(buffer, transform("map", "cam", tenths * S // 10, 1))
    steady = 5.0
    assert not buffer.is_new
    buffer.rewind()
    assert buffer.is_new  # what comes before the next transform is no fault
    put(buffer, transform("map", "cam", 5 * S, 2))
    for stamp_ns in (4 * S + 950 * MS, 5 * S + 100 * MS):
        with pytest.raises(TransformError, match=r"(newer|older) than the input"):
            buffer.lookup("map", "lens", stamp_ns)
    assert matrix(buffer.lookup("map", "cam", 5 * S)) == pytest.approx(matrix(transform("map", "cam", 0, 2)))


def test_transforms_tell_of_a_time_that_was_set_back_before_the_clock_does() -> None:
    """Between /tf and /clock a person was placed half by transforms of the time before."""
    steady = 0.0
    buffer = TransformBuffer(clock=lambda: steady)
    for tenths in range(80):
        put(buffer, transform("map", "odom", tenths * S // 10, 1), transform("odom", "cam", tenths * S // 10, 1))
    put(buffer, transform("robot", "hand", 8 * S), transform("hand", "lens"))
    steady = 1.0
    put(buffer, transform("odom", "cam", 5 * S, 2))
    for ask in (lambda: buffer.lookup("map", "cam", 5 * S), lambda: buffer.known_until("map", "cam")):
        with pytest.raises(TransformError, match="time was set back, and no transform of odom has come since"):
            ask()
    buffer.lookup("robot", "hand", 8 * S)  # whose way is another one loses nothing
    steady = 1.1
    put(buffer, transform("map", "odom", 5 * S, 3))
    wanted = matrix(transform("map", "odom", 0, 3)) @ matrix(transform("odom", "cam", 0, 2))
    np.testing.assert_allclose(matrix(buffer.lookup("map", "cam", 5 * S)), wanted, atol=1e-12)
    put(buffer, transform("odom", "cam", 4 * S + 900 * MS, 2))  # a message that overtook another is no such thing
    buffer.lookup("map", "cam", 5 * S, tolerance_ns=S)


def test_frames_of_people_who_have_left_are_forgotten() -> None:
    now = 0.0
    buffer = TransformBuffer(clock=lambda: now)
    put(buffer, transform("base", "cam"), is_static=True)
    for i in range(50):  # of each, thirty frames for ten seconds; the robot's come all the time
        now = 10.0 * i
        body = [transform("cam", f"body_{i}_{part}", i * S) for part in range(30)]
        assert put(buffer, transform("map", "base", i * S), *body) == 0
        buffer.lookup("map", f"body_{i}_0", i * S)
        assert len(buffer) <= 2 + 2 * 30
    many = [transform("map", f"f{i}") for i in range(10_000)]
    assert put(buffer, *many) > 0
    assert buffer.is_full
    put(buffer, *[transform("map", "f0", i) for i in range(1, 150)])
    assert len(buffer._tracks["f0"].stamps) == 100  # 10,000 of each, as where there are few, would be 26 GB
    for _ in range(2):
        now += 10.0
        put(buffer, transform("map", "base"))
    assert len(buffer) == 2
    assert not buffer.is_full


def test_a_camera_that_looks_ahead_sees_people_upright() -> None:
    """Optical frames have z ahead and y down; the numbers are REP-103's, by hand."""
    buffer = TransformBuffer()
    optical = Rotation.from_euler("ZYX", [-90, 0, -90], degrees=True)
    put(buffer, Transform(0, "map", "camera_link", [2.0, 0.0, 1.5], [0, 0, 0, 1]))
    put(buffer, Transform(0, "camera_link", "optical", [0, 0, 0], optical.as_quat()), is_static=True)
    found = buffer.lookup("map", "optical", 0)
    ahead, down = np.array([0.0, 0.0, 3.0]), np.array([0.0, 1.0, 0.0])
    np.testing.assert_allclose(found.rotation @ ahead + found.translation, [5.0, 0.0, 1.5], atol=1e-12)
    np.testing.assert_allclose(found.rotation @ down, [0.0, 0.0, -1.0], atol=1e-12)


@pytest.mark.parametrize(
    ("axes", "frame_id", "degrees", "up"),
    [
        ("smpl", "map", 0, (0, 1, 0)),
        ("smpl", "camera_color_optical_frame", 0, (0, 1, 0)),  # SMPL's axes, whatever the frame is called
        ("smpl", "map", 30, (0.5, np.sqrt(0.75), 0)),  # a sender that leans to its right
        ("frame", "map", 0, (0, 0, 1)),
        ("frame", "robot/head_optical", 0, (0, -1, 0)),
        ("frame", "map", -90, (0, -1, 0)),
    ],
)
def test_up_is_where_the_frame_of_the_messages_has_it(
    axes: InputAxes, frame_id: str, degrees: float, up: tuple[float, ...]
) -> None:
    turn = Rotation.from_euler("x", degrees, degrees=True).as_matrix()
    np.testing.assert_allclose(up_of_sender(axes, frame_id, turn), up, atol=1e-12)


# Waiting ------------------------------------------------------------------------------------------


class Camera:
    """A camera that moves by 1 m/s along x, a filter, and the time; what came through it is in `shown`."""

    def __init__(self, *, tolerance_ns: int = 100 * MS) -> None:
        self.now_ns, self.tolerance_ns, self.steady = 5 * S, tolerance_ns, 0.0
        self.buffer, self.statistics = TransformBuffer(clock=lambda: self.steady), Statistics()
        self.filter = MessageFilter(self.statistics, most=3)
        self.steady = 2.0
        self.shown: list[tuple[str, int, float]] = []

    def sees(self, stamp_ns: int, person: str = "", frame_id: str = "cam") -> None:
        self.filter.put(Held(person, SmplFrame(np.zeros((24, 3)), stamp_ns=stamp_ns), frame_id, self.now_ns))
        self.looks()

    def is_at(self, stamp_ns: int) -> None:
        put(self.buffer, Transform(stamp_ns, "map", "cam", [1e-9 * stamp_ns, 0, 0], [0, 0, 0, 1]))
        self.looks()

    def looks(self) -> None:
        for one, placement in self.filter.ready(self.buffer, "map", self.now_ns, self.tolerance_ns):
            self.shown.append((one.person, one.frame.stamp_ns, placement.translation[0]))

    def counted(self, key: str) -> int:
        return self.statistics.report().total[key]


@pytest.mark.parametrize("hz", [10, 30, 100])
@pytest.mark.parametrize("delay_ms", [5, 10, 50, 150])
def test_who_is_seen_by_a_moving_camera_is_where_it_was_then(hz: int, delay_ms: int) -> None:
    """However much later than its input each transform comes, as long as it is less than the tolerance."""
    camera = Camera(tolerance_ns=200 * MS)
    steps = [(5 * S + i * S // hz, i) for i in range(2 * hz)]
    events = [(stamp, camera.sees, stamp) for stamp, _ in steps]
    events += [(stamp + delay_ms * MS, camera.is_at, stamp) for stamp, _ in steps]
    for now_ns, happens, stamp in sorted(events, key=lambda one: one[0]):
        camera.now_ns = now_ns
        happens(stamp)
    assert [stamp for _, stamp, _ in camera.shown] == [stamp for stamp, _ in steps]
    assert [x for *_, x in camera.shown] == pytest.approx([1e-9 * stamp for stamp, _ in steps], abs=1e-9)
    assert (camera.counted("late_transform"), len(camera.filter)) == (0, 0)


def test_of_those_whose_wait_ends_at_once_the_scene_gets_what_it_has_room_for() -> None:
    camera = Camera()
    camera.is_at(5 * S)
    for ms in range(10, 60, 10):
        camera.sees(5 * S + ms * MS)
    camera.is_at(5 * S + 45 * MS)
    assert [stamp for _, stamp, _ in camera.shown] == [5 * S + 30 * MS, 5 * S + 40 * MS]
    assert (camera.counted("skip.superseded"), len(camera.filter)) == (2, 1)


def test_what_has_waited_in_vain_is_placed_late_or_dropped_and_that_is_counted() -> None:
    camera = Camera()
    camera.is_at(5 * S)
    camera.sees(5 * S + 40 * MS, "ann")
    camera.sees(5 * S + 150 * MS, "bob")
    camera.sees(5 * S, "eve", "map")  # needs none
    camera.now_ns += 99 * MS
    camera.looks()
    assert camera.shown == [("eve", 5 * S, 0.0)]
    camera.now_ns += MS
    camera.looks()
    assert camera.shown[1:] == [("ann", 5 * S + 40 * MS, 5.0)]
    report = camera.statistics.report()
    assert (report.total["late_transform"], report.total["drop.transform"], len(camera.filter)) == (1, 1, 0)
    assert report.reasons["transform"] == "bob: the newest transform of cam is 0.150 s older than the input"


def test_without_transforms_nobody_is_placed_and_the_reason_says_what_to_do() -> None:
    camera = Camera(tolerance_ns=0)
    camera.steady = 0.5
    camera.sees(5 * S)
    assert (camera.counted("drop.transform"), camera.counted("skip.first_transforms")) == (0, 1)
    camera.steady = 1.5
    camera.sees(6 * S)
    assert camera.shown == []
    reason = camera.statistics.report().reasons["transform"]
    assert reason.startswith("no transform leads from cam to map, none has come: start what sends /tf, or set frame_id")


def test_what_waits_is_bounded_and_no_clock_holds_it_for_ever() -> None:
    camera = Camera(tolerance_ns=10 * S)
    camera.is_at(5 * S)
    for i in range(100):  # time stands still
        camera.sees(5 * S + 1 + i, "ann")
    assert [stamp for _, stamp, _ in camera.shown] == [5 * S + 1 + i for i in range(68)]  # each late, none twice
    for person in ("bob", "cyd", "dan", "eve"):
        camera.sees(6 * S, person)
    assert (len(camera.filter), camera.counted("drop.crowd")) == (3, 2)
    camera.now_ns = S  # a simulation begins anew
    camera.looks()
    assert len(camera.filter) == 0
