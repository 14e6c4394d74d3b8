"""A frame as a CUDA graph, as far as that can be tested without a GPU.

There, a graph is what torch and Warp were asked to do while they were watched, done again on what is in the same memory
by then. `Tape` does that on a CPU, in the place of `torch.cuda.CUDAGraph`: it finds whatever Python looks up or decides
in a frame, which a graph would do as it did when it was captured. What it can't tell is whether CUDA's own calls are
right: `CudaCapture` needs a GPU.
"""

from __future__ import annotations

import copy
import ctypes
import inspect
import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
import warp as wp
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten

from refu_core import GarmentPipeline, SmplFrame
from refu_core._warp import Recorded
from refu_core.backbones import WithBeyond
from refu_core.backbones._perceptron import StackedPerceptrons
from refu_core.errors import MeshError
from refu_core.realtime import GarmentStats, SkinShift, Wearer
from refu_core.realtime._frame import FrameStep, packed_by
from refu_core.realtime._graph import CudaCapture, StepGraphs
from refu_core.sdf import ApproxSdf, ExactSdf, _mesh

CPU = torch.device("cpu")


class NoWaiting(TorchDispatchMode):
    """Refuses what can't be captured: to wait for the device, and shapes that hang on what tensors hold."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        indexes = func.overloadpacket in (torch.ops.aten.index, torch.ops.aten.index_put_, torch.ops.aten.index_put)
        waits = bool({torch.Tag.data_dependent_output, torch.Tag.dynamic_output_shape} & set(func.tags))
        if indexes:  # waits for the number of those that are picked by a mask, which by number they aren't
            waits = any(index is not None and index.dtype in (torch.bool, torch.uint8) for index in args[1])
        copies = func.overloadpacket is torch.ops.aten.lift_fresh  # a list of Python's
        if waits or copies:
            msg = f"{func} would wait for the device"
            raise RuntimeError(msg)
        return func(*args, **(kwargs or {}))


class _Recorder(TorchDispatchMode):
    """Notes the operations of torch that do anything: those that make views and empty tensors needn't be done again."""

    def __init__(self, done: list[Callable[[], object]]) -> None:
        super().__init__()
        self._done = done

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        result = func(*args, **kwargs)
        given = {one.untyped_storage().data_ptr() for one in tree_flatten((args, kwargs))[0] if isinstance(one, Tensor)}
        made = [one for one in tree_flatten(result)[0] if isinstance(one, Tensor)]
        if func._schema.is_mutable:
            self._done.append(partial(func, *args, **kwargs))
        elif "empty" not in func.name() and any(one.untyped_storage().data_ptr() not in given for one in made):
            self._done.append(partial(_again, func, args, kwargs, made))
        return result


def _again(func: Any, args: Any, kwargs: Any, made: list[Tensor]) -> None:
    for old, new in zip(made, tree_flatten(func(*args, **kwargs))[0], strict=True):
        old.copy_(new)


@contextmanager
def recording(done: list[Callable[[], object]]) -> Iterator[None]:
    """Adds what torch and Warp are asked for to `done`, with the arguments that they have then."""
    launch, launch_again, refit = wp.launch, Recorded.launch, wp.Mesh.refit

    def launched(*args: Any, **kwargs: Any) -> Any:
        if not kwargs.get("record_cmd"):
            done.append(partial(launch, *args, **kwargs))
        return launch(*args, **kwargs)

    def launched_again(command: Recorded) -> None:
        now = copy.copy(command)
        now._arguments = type(now._arguments).from_buffer_copy(now._arguments)
        now._addresses = now._addresses[0], ctypes.byref(now._arguments)
        done.append(partial(launch_again, now))
        launch_again(command)

    def refitted(mesh: Any) -> None:
        done.append(partial(refit, mesh))
        refit(mesh)

    with pytest.MonkeyPatch.context() as patch, _Recorder(done):
        patch.setattr(wp, "launch", launched)
        patch.setattr(Recorded, "launch", launched_again)
        patch.setattr(wp.Mesh, "refit", refitted)
        patch.setattr(_mesh, "require_finite", lambda *_: None)  # which a graph can't do, and doesn't
        yield


class Tape:
    """In the place of a CUDA graph: warms up, then records, and does the same again."""

    def __init__(self, run: Callable[[], Tensor], device: torch.device) -> None:
        assert device == CPU
        run()
        self.done: list[Callable[[], object]] = []
        with recording(self.done), NoWaiting():
            self.output = run()

    def replay(self) -> None:
        for act in self.done:
            act()


def as_on_a_gpu(pipeline: GarmentPipeline) -> FrameStep:
    """The pipeline's step, with the launches that a GPU gets, and a tree that isn't built anew."""
    contact, collider = pipeline._steps[0].contact, pipeline.outfit.collider
    for one in pipeline.outfit.wearables.values():
        for module in one.backbone.modules() if isinstance(one.backbone, nn.Module) else ():
            if isinstance(module, (WithBeyond, StackedPerceptrons)):
                module._is_serial = False
    if collider is not None:
        collider._is_serial = collider.anatomy.aside._is_serial = False
    if contact is not None:
        if isinstance(contact.sdf, ExactSdf):
            contact.sdf._rebuild_distance = math.inf
        if isinstance(contact.sdf, ApproxSdf):
            contact.sdf._is_serial = False
        contact._is_serial = False
        if contact.way_out is not None:
            contact.way_out._is_serial = False
        for steps in (contact._press, contact._off_skin, contact._unfold, contact._strain):
            for one in steps.values():
                one._is_serial = False
        for resolver in contact.resolvers.values():
            resolver._is_serial = False
        for layers in contact._layers.values():
            for layer in layers.values():
                layer._is_serial = layer.parting._is_serial = False
    return pipeline._steps[0]


def frames(*seeds: int, style: bool = False) -> list[SmplFrame]:
    rngs = [np.random.default_rng(seed) for seed in seeds]
    return [
        SmplFrame(
            pose=rng.normal(0, 0.3, (24, 3)),
            betas=rng.normal(0, 1, 10),
            transl=rng.normal(0, 9, 3),
            style=rng.normal(0, 1, 4) if style else None,
        )
        for rng in rngs
    ]


LOADED = [
    (["tshirt-male", "short-pant-male"], "hybrid", "tailornet"),
    (["skirt-female"], "accurate", "skinned"),
    (["tshirt-male"], "accurate", "tailornet"),
    (["tshirt-male"], "none", "tailornet"),
]


@pytest.mark.parametrize(("garments", "sdf", "backbone"), LOADED, ids=lambda value: str(value).strip("[]"))
def test_replayed_frames_are_those_of_the_pipeline(
    garments: list[str], sdf: str, backbone: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Other poses, figures and styles than when it was captured, and another number of persons in between."""
    monkeypatch.setattr("refu_core.realtime._contact.exact_sdf", lambda body: ExactSdf(body.faces))
    replaying, usual = (GarmentPipeline.load(garments, sdf=sdf, backbone=backbone) for _ in range(2))
    tapes: list[Tape] = []

    def capture(run: Callable[[], Tensor], device: torch.device) -> Tape:
        tapes.append(Tape(run, device))
        return tapes[-1]

    replaying._graphs = StepGraphs(as_on_a_gpu(replaying).packed, CPU, capture=capture)
    for seeds in ((0,), (1, 2), (3, 5), (4,), (0,)):
        given = frames(*seeds, style=seeds[0] == 4)
        if seeds[0] == 4:  # who lies
            pose = given[0].pose.copy()
            pose[0] = (np.pi / 2, 0, 0)
            given = [replace(given[0], pose=pose)]
        for new, old in zip(replaying(given), usual(given), strict=True):
            np.testing.assert_allclose(new.body, old.body, atol=1e-6)
            np.testing.assert_allclose(new.skin, old.skin, atol=1e-6)
            assert new.stats.shift.n_moved > 0
            assert abs(new.stats.shift.n_moved - old.stats.shift.n_moved) <= 5
            assert abs(new.stats.shift.n_held - old.stats.shift.n_held) <= 5
            assert new.stats.shift.largest == pytest.approx(old.stats.shift.largest, abs=1e-6)
            assert new.stats.shift.mean == pytest.approx(old.stats.shift.mean, abs=1e-6)
            assert list(new) == list(old) == garments
            for name, mesh in new.items():
                np.testing.assert_allclose(mesh.raw, old[name].raw, atol=2e-5)
                apart = np.linalg.norm(mesh.local - old[name].local, axis=1)
                assert (apart > 5e-4).mean() < 2e-3, "but for vertices for which rounding decides"
                assert mesh.transl is old[name].transl or (mesh.transl == old[name].transl).all()
                counts, wanted = new.stats.garments[name], old.stats.garments[name]
                for what in ("n_inside", "n_pushed", "n_unresolved", "n_layered"):
                    assert abs(getattr(counts, what) - getattr(wanted, what)) <= 4
                assert counts.max_depth == pytest.approx(wanted.max_depth, abs=1e-4)
    assert len(tapes) == 2, "one for each number of persons"
    assert list(new.stats.stage_ms) == ["step"]


def test_what_waits_is_told_from_what_does_not() -> None:
    """Of the test above: what each of these does would make it fail."""
    x = torch.arange(5.0)
    with NoWaiting():
        (x[torch.arange(2)] + x[1:3]).clone().clamp_min(0)
        x.where(x > 2, -x)
    for wait in (
        lambda: float(x.max()),
        lambda: bool((x > 1).any()),
        lambda: torch.equal(x, x),
        lambda: x[x > 2],
        lambda: x.nonzero(),
        lambda: torch.unique(x),
        lambda: torch.tensor([1.0, 2.0]),
    ):
        with pytest.raises(RuntimeError, match="would wait for the device"), NoWaiting():
            wait()


def test_the_step_of_a_cpu_waits() -> None:
    """Lists as long as they are can't be captured."""
    pipeline = GarmentPipeline.load(["tshirt-male"], sdf="hybrid")
    inputs = step_inputs(pipeline, frames(0))
    with pytest.raises(RuntimeError, match="would wait for the device"):
        Tape(lambda: pipeline._steps[0].packed(inputs, (0.004,)), CPU)
    waited_for = pipeline._steps[0].packed(inputs, (0.004,))
    step = as_on_a_gpu(GarmentPipeline.load(["tshirt-male"], sdf="hybrid"))
    torch.testing.assert_close(Tape(lambda: step.packed(inputs, (0.004,)), CPU).output, waited_for, atol=2e-3, rtol=0)


def step_inputs(pipeline: GarmentPipeline, people: list[SmplFrame]) -> dict[str, Tensor]:
    pose = torch.tensor(np.stack([frame.pose for frame in people]))
    return {"pose": pose, **Wearer.together([pipeline._wearer(frame)[0] for frame in people]).tensors()}


class Steps:
    """A step that adds its inputs up, and a capture of it, which count what they are asked for."""

    def __init__(self) -> None:
        self.captures = 0

    def step(self, inputs: Mapping[str, Tensor], numbers: tuple[float, ...]) -> Tensor:
        self.held = inputs
        return inputs["pose"] + inputs["betas"] + sum(numbers)

    def capture(self, run: Callable[[], Tensor], device: torch.device) -> Tape:
        self.captures += 1
        return Tape(run, device)


def given(n: int, *, betas: float = 0.0) -> dict[str, Tensor]:
    return {"pose": torch.rand(n, 3), "betas": torch.full((n, 3), betas)}


def test_graphs_are_captured_for_sizes_and_numbers_and_not_for_contents() -> None:
    steps = Steps()
    graphs = StepGraphs(steps.step, CPU, capture=steps.capture, most=3)
    for n, margin, captures in ((1, 0.5, 1), (1, 0.5, 1), (2, 0.5, 2), (1, 0.5, 2), (1, 0.25, 3), (2, 0.5, 3)):
        inputs = given(n, betas=float(captures))
        np.testing.assert_array_equal(graphs(inputs, (margin,)), inputs["pose"] + inputs["betas"] + margin)
        assert steps.captures == captures
    # The least recently used goes first: that of one person at half a metre.
    for n, margin, captures in ((3, 0.5, 4), (2, 0.5, 4), (1, 0.25, 4), (1, 0.5, 5)):
        graphs(given(n), (margin,))
        assert steps.captures == captures


def test_results_stay_and_inputs_are_nobody_elses() -> None:
    steps = Steps()
    graphs = StepGraphs(steps.step, CPU, capture=steps.capture)
    first = given(1)
    one = graphs(first, (0.0,))
    before = one.copy()
    second = {"pose": torch.rand(1, 3), "betas": first["betas"]}
    two = graphs(second, (0.0,))
    np.testing.assert_array_equal(one, before)
    np.testing.assert_array_equal(two, second["pose"])
    assert all(steps.held[name] is not first[name] and steps.held[name] is not second[name] for name in first)


def test_what_is_given_again_is_not_copied_again() -> None:
    steps = Steps()
    graphs = StepGraphs(steps.step, CPU, capture=steps.capture)
    first, other = given(1, betas=1.0), given(1, betas=2.0)
    graphs(first, (0.0,))
    graphs(first, (0.0,))
    steps.held["betas"].fill_(9.0)
    same = {"pose": torch.zeros(1, 3), "betas": first["betas"]}
    assert graphs(same, (0.0,)).tolist() == [[9.0, 9.0, 9.0]]
    assert graphs({**same, "betas": other["betas"]}, (0.0,)).tolist() == [[2.0, 2.0, 2.0]]


def test_what_cannot_be_captured_is_launched_with_one_warning() -> None:
    def picky(inputs: Mapping[str, Tensor], numbers: tuple[float, ...]) -> Tensor:
        return inputs["pose"][inputs["pose"] > numbers[0]]

    graphs = StepGraphs(picky, CPU, capture=Tape)
    inputs = given(2)
    with pytest.warns(RuntimeWarning, match=r"no CUDA graph could be captured.*would wait for the device") as warned:
        results = [graphs(inputs, (0.5,)) for _ in range(3)]
    assert len(warned) == 1
    for result in results:
        np.testing.assert_array_equal(result, inputs["pose"][inputs["pose"] > 0.5])


def test_a_refused_body_is_no_reason_to_do_without_graphs() -> None:
    pipeline = GarmentPipeline.load(["tshirt-male"], sdf="hybrid")
    pipeline._graphs = StepGraphs(as_on_a_gpu(pipeline).packed, CPU, capture=Tape)
    with pytest.raises(MeshError, match="negative volume"):
        pipeline(SmplFrame(pose=np.zeros((24, 3)), betas=np.full(10, -50.0)))
    assert not pipeline._graphs._has_failed
    assert np.isfinite(pipeline(frames(0)[0])["tshirt-male"].local).all()


def test_packed_and_unpacked() -> None:
    """Without a copy, and refused where it isn't finite."""
    pipeline = GarmentPipeline.load(["tshirt-male", "short-pant-male"], backbone="skinned", sdf="none")
    people = frames(0, 1)
    step = pipeline._steps[0]
    packed = step.packed(step_inputs(pipeline, people), (0.0, 0.0)).numpy()
    for person, old in zip(step.unpacked(packed), pipeline(people), strict=True):
        assert np.shares_memory(person.body.numpy(), packed)
        np.testing.assert_array_equal(person.body, old.body)
        np.testing.assert_array_equal(person.skin, old.skin)
        assert SkinShift.of(person.shift.tolist()) == old.stats.shift
        for name, mesh in old.items():
            worn = person.garments[name]
            np.testing.assert_array_equal(worn.vertices, mesh.local)
            np.testing.assert_array_equal(worn.raw, mesh.raw)
            assert GarmentStats.of(worn.numbers.tolist()) == replace(old.stats.garments[name], ms=0.0)
    packed[1, 7] = np.inf
    with pytest.raises(MeshError, match="of 1 of 2 persons"):
        list(step.unpacked(packed))


def test_steps_share_a_batch() -> None:
    """Each has memory of its own, so a person is dressed as by any other of them: but for what a batch rounds."""
    pipeline = GarmentPipeline.load(["tshirt-male"], threads=3)
    inputs = step_inputs(pipeline, frames(0, 1, 2, 3, 4))
    alone = pipeline._steps[0].packed(inputs, (0.004,))
    for n in (5, 2):
        shared = packed_by(pipeline._steps, {name: one[:n] for name, one in inputs.items()}, (0.004,))
        torch.testing.assert_close(shared, alone[:n], atol=1e-5, rtol=0)


def test_a_cpu_has_no_graphs() -> None:
    assert GarmentPipeline.load(["tshirt-male"], graph=True)._graphs is None


def test_a_capture_warms_up_on_the_stream_that_it_then_captures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Only that: what is noted here is done by nobody, since there needn't be a GPU. `test_on_a_gpu` does it."""
    noted: list[str] = []

    class Stream:
        def __init__(self, device: torch.device) -> None:
            pass

        def wait_stream(self, other: Stream) -> None:
            noted.append(f"{'side waits' if other is usual else 'usual waits'}")

    @contextmanager
    def within(name: str, *given: object, **settings: object) -> Iterator[str]:
        assert all(stream is not usual for stream in (*given, *settings.values()))
        noted.append(f"{name} begins")
        yield name
        noted.append(f"{name} ends")

    class Graph:
        def replay(self) -> None:
            noted.append("replays")

    usual = Stream(CPU)
    inspect.signature(torch.cuda.graph).bind(None, stream=None, capture_error_mode="thread_local")
    monkeypatch.setattr(torch.cuda, "Stream", Stream)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda _: usual)
    monkeypatch.setattr(torch.cuda, "CUDAGraph", Graph)
    monkeypatch.setattr(torch.cuda, "stream", partial(within, "stream"))
    monkeypatch.setattr(torch.cuda, "graph", partial(within, "capture"))
    monkeypatch.setattr("refu_core.realtime._graph.joined_capture", partial(within, "warp"))

    def run() -> Tensor:
        noted.append("runs")
        return torch.zeros(1)

    captured = CudaCapture(run, CPU)
    captured.replay()
    warm_up = ["side waits", "stream begins", "runs", "runs", "stream ends", "usual waits"]
    assert noted == [*warm_up, "capture begins", "warp begins", "runs", "warp ends", "capture ends", "replays"]


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
@pytest.mark.parametrize("sdf", ["hybrid", "accurate"])
def test_on_a_gpu(sdf: str) -> None:
    garments = ["tshirt-male", "short-pant-male"]
    replaying = GarmentPipeline.load(garments, sdf=sdf, device="cuda", threads=2)
    launching, usual = (
        GarmentPipeline.load(garments, sdf=sdf, device=device, graph=False) for device in ("cuda", "cpu")
    )
    for seeds in ((0,), (1, 2), (1, 3), (0,)):
        people = frames(*seeds)
        for outputs in (replaying(people), launching(people)):
            for new, old in zip(outputs, usual(people), strict=True):
                for name, mesh in old.items():
                    np.testing.assert_allclose(new[name].raw, mesh.raw, atol=1e-4)
                    apart = np.linalg.norm(new[name].local - mesh.local, axis=1)
                    assert (apart > 1e-3).mean() < 0.01
    assert replaying._graphs is not None
    assert not replaying._graphs._has_failed
    assert len(replaying._graphs._graphs) == 2
