"""A pipeline in several threads and tasks gives what it gives in one."""

from __future__ import annotations

import asyncio
import copy
import math
import os
import pickle
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch

from refu_core import GarmentPipeline, RefuError, SmplFrame, load_body, load_garment
from refu_core._warp import Recorded
from refu_core.body import Collider, Surface
from refu_core.contact import Layer, LimbMeshes, Press, Resolver, Sheet, StrainLimit, Unfold, WayOut
from refu_core.mesh import Connectivity
from refu_core.metrics import CollisionChecker, SelfContactDetector, SheetChecker
from refu_core.outputs import LimbContacts
from refu_core.realtime import Dressed, PipelineOutput
from refu_core.realtime._frame import FrameStep
from refu_core.sdf import ApproxSdf, BandSdf, ExactSdf, Winding
from refu_lab.stress._frames import everyday

_GARMENTS = ("tshirt-male", "short-pant-male")


@cache
def _load(sdf: str, threads: int) -> GarmentPipeline:
    return GarmentPipeline.load(_GARMENTS if sdf == "hybrid" else _GARMENTS[:1], sdf=sdf, threads=threads)


@pytest.fixture(scope="module")
def pipeline() -> GarmentPipeline:
    return _load("hybrid", 1)


def _frames(n: int, seed: int = 0) -> list[SmplFrame]:
    rng = np.random.default_rng(seed)
    return [everyday(rng) for _ in range(n)]


def _arrays(out: PipelineOutput) -> list[np.ndarray]:
    return [out.body, *(array for mesh in out.values() for array in (mesh.local, mesh.raw))]


def _are_equal(first: PipelineOutput, second: PipelineOutput) -> bool:
    return all(np.array_equal(a, b) for a, b in zip(_arrays(first), _arrays(second), strict=True))


def _threads(n: int) -> ThreadPoolExecutor:
    # How many threads torch takes for a product, and so how it is rounded, is each thread's own setting.
    return ThreadPoolExecutor(n, initializer=lambda: torch.set_num_threads(1))


def _in_threads(call: Callable[[SmplFrame], PipelineOutput], frames: list[SmplFrame]) -> list[PipelineOutput]:
    with _threads(8) as threads:
        return list(threads.map(call, frames))


@pytest.mark.parametrize(("sdf", "threads"), [("hybrid", 1), ("hybrid", 2), ("accurate", 3)])
def test_eight_threads_give_what_one_gives(sdf: str, threads: int) -> None:
    pipeline, frames = _load(sdf, threads), _frames(16)
    one_by_one = [pipeline(frame) for frame in frames]
    # What is made when it is first asked for (raw, body) is asked for after all frames, by another thread.
    for out, alone in zip(_in_threads(pipeline, frames), one_by_one, strict=True):
        assert _are_equal(out, alone)


def test_bodies_and_garments_hold_nothing_of_a_call(pipeline: GarmentPipeline) -> None:
    body, garment = pipeline.body, pipeline.garments[_GARMENTS[0]]

    def pose(frame: SmplFrame) -> tuple[np.ndarray, ...]:
        posed = body(frame.pose[None], frame.betas[None])
        worn = garment.pose(garment.rest(torch.tensor(frame.betas)[None]), posed.transforms)
        return posed.vertices.numpy(), worn.numpy()

    frames = _frames(64)
    with _threads(8) as threads:
        for found, expected in zip(threads.map(pose, frames), map(pose, frames), strict=True):
            assert all(map(np.array_equal, found, expected))


def test_tasks_and_batches_give_what_one_thread_gives(pipeline: GarmentPipeline) -> None:
    batches = [_frames(2, seed) for seed in range(1, 5)]  # nobody whom an earlier call knew
    alone = [pipeline(batch) for batch in batches]

    async def together() -> list[list[PipelineOutput]]:
        asyncio.get_running_loop().set_default_executor(_threads(4))
        return await asyncio.gather(*(asyncio.to_thread(pipeline, batch) for batch in batches))

    for outs, expected in zip(asyncio.run(together()), alone, strict=True):
        assert all(map(_are_equal, outs, expected))


@pytest.mark.parametrize("threads", [1, 2])
def test_a_call_s_margin_holds_for_that_call(threads: int) -> None:
    pipeline, frames, margins = _load("hybrid", threads), _frames(4), (0.002, 0.006)
    expected = [[pipeline(frame, margin=margin) for frame in frames] for margin in margins]
    assert not _are_equal(expected[0][0], expected[1][0])

    def call(i: int) -> PipelineOutput:
        return pipeline(frames[i % len(frames)], margin=margins[i % 3 % 2])

    with _threads(8) as threads:
        for i, out in enumerate(threads.map(call, range(16))):
            assert _are_equal(out, expected[i % 3 % 2][i % len(frames)])


def test_pipelines_of_their_own_run_beside_each_other(pipeline: GarmentPipeline) -> None:
    frames = _frames(6)
    alone = [pipeline(frame) for frame in frames]

    def load_and_dress(_: int) -> list[PipelineOutput]:
        own = GarmentPipeline.load(_GARMENTS)
        return [own(frame) for frame in frames]

    with _threads(2) as threads:
        for outs in threads.map(load_and_dress, range(2)):
            assert all(map(_are_equal, outs, alone))


@pytest.mark.parametrize("take", [pickle.dumps, copy.deepcopy])
def test_a_pipeline_that_is_pickled_says_what_to_do_instead(
    pipeline: GarmentPipeline, take: Callable[[object], object]
) -> None:
    with pytest.raises(RefuError, match="load one in each process"):
        take(pipeline)


def test_a_fork_in_the_middle_of_a_call_is_told_and_not_waited_for() -> None:
    """Other threads don't outlive it: the memory that they work in never comes back."""
    pipeline = GarmentPipeline.load(_GARMENTS[1:], backbone="skinned", sdf="none")
    frame = _frames(1)[0]

    def fork(_: FrameStep) -> int:
        child = os.fork()
        if not child:
            signal.alarm(300)
            try:
                pipeline(frame)
            except RefuError as error:
                os._exit(0 if "busy when its process was forked: load one in each process" in str(error) else 1)
            os._exit(2)
        return child

    assert os.waitpid(pipeline._crew.call(fork), 0)[1] == 0
    pipeline(frame)


def test_calls_run_at_the_same_time_and_no_more_than_asked_for() -> None:
    pipeline, frame = GarmentPipeline.load(_GARMENTS[1:], threads=2), _frames(1)[0]
    inside, most, both = 0, 0, threading.Event()
    counting = threading.Lock()

    def adjust(dressed: Dressed) -> Dressed:
        nonlocal inside, most
        with counting:
            inside += 1
            most = max(most, inside)
            if inside == 2:
                both.set()
        assert both.wait(60), "each waits for another one to be there, too"
        with counting:
            inside -= 1
        return dressed

    with _threads(4) as threads:
        list(threads.map(lambda _: pipeline.adjusted(frame, adjust), range(4)))
    assert most == 2


@pytest.mark.parametrize("threads", [0, -1, 1.5, "2"])
def test_a_number_of_threads_that_is_none_is_refused(threads: object) -> None:
    with pytest.raises(RefuError, match="thread"):
        GarmentPipeline.load(_GARMENTS, threads=threads)  # type: ignore[arg-type]


@pytest.mark.parametrize("n", [1, 2, 3, 8])
def test_a_batch_is_shared_out_among_threads(pipeline: GarmentPipeline, n: int) -> None:
    shared = _load("hybrid", 3)
    frames = _frames(n, seed=n)
    # A batch of another size rounds otherwise, and deep in a limb that decides between two ways out: the same parts.
    ends = [n * i // min(n, 3) for i in range(min(n, 3) + 1)]
    parts = [out for start, end in pairwise(ends) for out in pipeline(frames[start:end])]
    for out, alone in zip(shared(frames), parts, strict=True):
        assert np.abs(out.body - alone.body).max() < 1e-5
        assert all(np.abs(mesh.local - alone[name].local).max() < 1e-3 for name, mesh in out.items())
    assert len({id(step) for step in _all_steps(shared)}) == 3, "all have come back"


def test_who_fails_in_a_batch_leaves_the_pipeline_as_it_was() -> None:
    pipeline, frames = GarmentPipeline.load(_GARMENTS[1:], threads=2), _frames(4)
    good = pipeline._run

    def bad(step: Any, part: list[SmplFrame], **options: Any) -> list[PipelineOutput]:
        if frames[3] in part:
            raise MemoryError
        return good(step, part, **options)

    pipeline._run = bad  # type: ignore[method-assign, assignment]
    with pytest.raises(MemoryError):
        pipeline(frames)
    assert len({id(step) for step in _all_steps(pipeline)}) == 2
    assert len(pipeline(frames[:3])) == 3


def test_ctrl_c_between_two_instructions_loses_no_step() -> None:
    """Python heeds signals when a function begins, and when one of C's has returned."""
    crew, left = GarmentPipeline.load(_GARMENTS[1:], backbone="skinned", sdf="none")._crew, 0

    def interrupt(_: object, event: str, __: object) -> None:
        nonlocal left
        left -= event in ("call", "c_return")
        if left < 0:
            sys.setprofile(None)
            raise KeyboardInterrupt

    for n in range(1000):
        left = n
        try:
            sys.setprofile(interrupt)
            crew.call(lambda _: None)
        except KeyboardInterrupt:
            continue
        else:
            break
        finally:
            sys.setprofile(None)
            assert crew._free.qsize() == 1, "a later call would wait for ever"
    assert 5 < n < 1000


def test_ctrl_c_in_the_middle_of_a_frame_changes_no_later_one(monkeypatch: pytest.MonkeyPatch) -> None:
    pipeline, (first, second, third) = GarmentPipeline.load(_GARMENTS[:1]), _frames(3, seed=3)
    wanted, launch, left = pipeline(third), Recorded.launch, math.inf

    def interrupt(*given: Any, **options: Any) -> Any:
        nonlocal left
        left -= 1
        if left < 0:
            left = math.inf
            raise KeyboardInterrupt
        return launch(*given, **options)

    monkeypatch.setattr(Recorded, "launch", interrupt)
    for n in range(1000):
        pipeline(first)  # not the third again, which would be known
        left = n
        try:
            pipeline(second)
        except KeyboardInterrupt:
            assert _are_equal(pipeline(third), wanted), n
        else:
            break
    assert 10 < n < 1000


def test_a_batch_after_a_fork_is_dressed_by_one_thread() -> None:
    """The others of its parent's pool don't outlive it."""
    pipeline, frames = GarmentPipeline.load(_GARMENTS[1:], backbone="skinned", threads=2), _frames(3)
    pipeline(frames)
    child = os.fork()
    if not child:
        signal.alarm(300)
        os._exit(0 if len(pipeline(_frames(3, seed=1))) == 3 else 1)
    assert os.waitpid(child, 0)[1] == 0


_AT_EXIT = """
import atexit, os, threading, time
from refu_core import GarmentPipeline, SmplFrame
if child := os.fork():  # two programs for one import: first the child, then its parent
    assert os.waitpid(child, 0)[1] == 0
pipeline = GarmentPipeline.load(["short-pant-male"], threads=2)
frames = [SmplFrame(pose=[k / 1000] * 72) for k in range(3)]
atexit.register(lambda: print(len(pipeline(frames)), "at exit"))
def dress():
    k = 0
    while True:
        k += 1
        pipeline(SmplFrame(pose=[k * 1e-6] * 72))
threading.Thread(target=dress, daemon=True).start()
time.sleep(0.5)
"""


def test_a_daemon_thread_in_a_call_does_not_abort_a_program_that_ends() -> None:
    done = subprocess.run([sys.executable, "-c", _AT_EXIT], capture_output=True, text=True, timeout=300, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, 2 * "3 at exit\n", "")


def _all_steps(pipeline: GarmentPipeline) -> list[FrameStep]:
    free = pipeline._crew._free
    steps = [free.get(timeout=60) for _ in range(pipeline.threads)]
    for step in steps:
        free.put(step)
    return steps


def test_what_holds_memory_of_warp_says_that_it_cannot_leave_its_process() -> None:
    body = load_body("male")
    there = [ExactSdf(body.faces), BandSdf(body.faces), ApproxSdf(body), Resolver(body.faces, body.n_vertices)]
    checkers = [CollisionChecker(body.faces), SelfContactDetector(body.faces, body.v_template), Collider(body)]
    shorts, shirt = load_garment("short-pant-male"), load_garment("tshirt-male")
    skin = Surface(body.v_template.double().numpy(), body.faces.int().numpy())
    sheet = Sheet(Connectivity.of(body.faces, body.n_vertices), body.v_template)
    layer = Layer(shirt.faces, shirt.v_template, shorts.faces, shorts.v_template)
    steps = [sheet, layer, layer.parting, StrainLimit(shorts.mesh, body.device), Unfold(shorts, [shirt]), WayOut(sheet)]
    limbs = LimbMeshes(body)
    checkers += [
        *steps,
        limbs,
        Press(shorts, limbs),
        SheetChecker(shorts.faces),
        LimbContacts(body, {"shorts": shorts}),
        Winding(body.faces),
        skin,
    ]
    for one in [*there, *checkers, *steps]:
        for leave in (pickle.dumps, copy.copy, copy.deepcopy):
            with pytest.raises(RefuError, match=f"^{type(one).__name__} can't be copied"):
                leave(one)
