"""What else a program has set torch to changes nothing: inference mode, autocast, default type and device."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

import numpy as np
import pytest
import torch
import trimesh

from refu_core import ApproxSdf, ExactSdf, GarmentPipeline, Resolver, SmplFrame, Wearer, dress, load_body
from refu_core.metrics import CollisionChecker, SelfContactDetector
from refu_core.observation import Observer
from refu_core.outputs import Clearance, LimbContacts, PlannerMesh, Sigma
from refu_core.realtime import PipelineOutput
from refu_core.sdf import BandSdf
from refu_core.weights import in_steps
from refu_lab.stress._frames import everyday

Settings = Callable[[], contextlib.AbstractContextManager[object]]


@contextlib.contextmanager
def _default(kind: torch.dtype) -> Iterator[None]:
    torch.set_default_dtype(kind)
    try:
        yield
    finally:
        torch.set_default_dtype(torch.float32)


_SETTINGS = {
    "inference mode": torch.inference_mode,
    "autocast": lambda: torch.autocast("cpu", dtype=torch.bfloat16),
    "fine default type": lambda: _default(torch.float64),
    "coarse default type": lambda: _default(torch.bfloat16),
    "default device": lambda: torch.device("meta"),
}
each_setting = pytest.mark.parametrize("settings", _SETTINGS.values(), ids=_SETTINGS)


def _arrays(out: PipelineOutput) -> list[np.ndarray]:
    return [out.body, out.skin, *(array for mesh in out.values() for array in (mesh.local, mesh.raw))]


def _frames() -> list[SmplFrame]:
    rng = np.random.default_rng(0)
    return [everyday(rng) for _ in range(2)]


def _load() -> GarmentPipeline:
    return GarmentPipeline.load(["tshirt-male", "short-pant-male"], sdf="accurate")


@pytest.fixture(scope="module")
def plain() -> list[list[np.ndarray]]:
    pipeline = _load()
    return [_arrays(pipeline(frame)) for frame in _frames()]


@each_setting
@pytest.mark.parametrize("loads_within", [False, True])
def test_a_pipeline_gives_the_same(settings: Settings, loads_within: bool, plain: list[list[np.ndarray]]) -> None:
    with settings() if loads_within else contextlib.nullcontext():
        pipeline = _load()
    first, second = _frames()
    with settings():
        within = _arrays(pipeline(first))
    for got, wanted in zip([within, _arrays(pipeline(second))], plain, strict=True):
        for one, other in zip(got, wanted, strict=True):
            np.testing.assert_array_equal(one, other)


def test_a_forward_pass_gives_the_same_in_inference_mode_and_nothing_for_nobody() -> None:
    outfit, pose, betas = _load().outfit, 0.1 * torch.ones(2, 24, 3), torch.ones(2, 10)
    wanted = dress(pose, Wearer.of(outfit, betas)).drapes
    with torch.inference_mode():
        got = dress(pose, Wearer.of(outfit, betas.clone())).drapes
    none = dress(pose[:0], Wearer.of(outfit, betas[:0])).drapes
    tracked = dress(pose[:0].clone().requires_grad_(), Wearer.of(outfit, betas[:0])).drapes
    for name, drape in wanted.items():
        assert torch.equal(got[name].vertices, drape.vertices)
        assert none[name].vertices.shape == tracked[name].vertices.shape == (0, *drape.vertices.shape[1:])


@pytest.mark.filterwarnings("ignore:Guards may run slower on Python 3.13.0:RuntimeWarning")
def test_a_forward_pass_can_be_compiled() -> None:
    outfit = GarmentPipeline.load(["tshirt-male"], collider=False).outfit
    pose, betas = 0.1 * torch.ones(2, 24, 3), torch.ones(2, 10)

    def vertices(pose: torch.Tensor) -> list[torch.Tensor]:
        return [drape.vertices for drape in dress(pose, Wearer.of(outfit, betas)).drapes.values()]

    for got, wanted in zip(torch.compile(vertices, backend="eager")(pose), vertices(pose), strict=True):
        torch.testing.assert_close(got, wanted, atol=1e-5, rtol=0)


@pytest.mark.parametrize("settings", [_SETTINGS[name] for name in ("inference mode", "fine default type")])
@pytest.mark.parametrize("kind", [ExactSdf, BandSdf])
def test_a_distance_and_a_resolver_give_the_same(settings: Settings, kind: type[ExactSdf] | type[BandSdf]) -> None:
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
    faces, skin = torch.tensor(ball.faces), torch.tensor(ball.vertices, dtype=torch.float32)

    def resolved(sdf: ExactSdf | BandSdf, resolver: Resolver) -> list[torch.Tensor]:
        sdf.update(skin)
        start = sdf.query(0.99 * skin)
        return [start.distance, start.gradient, resolver(0.99 * skin, sdf, start, margin=0.004).vertices]

    wanted = resolved(kind(faces), Resolver(faces, len(skin)))
    with settings():
        sdf, resolver = kind(faces), Resolver(faces, len(skin))
        within = resolved(sdf, resolver)
    for got in (within, resolved(sdf, resolver)):
        for one, other in zip(got, wanted, strict=True):
            assert one.dtype == torch.float32
            assert torch.equal(one, other)


def test_weights_are_stored_the_same() -> None:
    values = torch.tensor([[1e-3, -2e-3], [0.0, 0.0]])
    wanted = in_steps(values, 1)
    with _default(torch.float16):
        got = in_steps(values, 1)
    assert all(map(torch.equal, got, wanted))
    assert wanted[0].tolist() == [[64, -127], [0, 0]]


Dressed = tuple[GarmentPipeline, SmplFrame, PipelineOutput]


@pytest.fixture(scope="module")
def dressed() -> Dressed:
    pipeline, frame = _load(), _frames()[0]
    return pipeline, frame, pipeline(frame)


def _answers(pipeline: GarmentPipeline, frame: SmplFrame, out: PipelineOutput) -> list[np.ndarray]:
    name, body = "tshirt-male", pipeline.body
    mesh, covariance = out[name], np.tile(1e-3 * np.eye(3), (24, 1, 1))
    checker, detector = CollisionChecker(body.faces), SelfContactDetector(body.faces, body.v_template)
    checker.update(out.body)
    found = checker.check(mesh.raw, mesh.faces)
    return [
        Clearance.of(pipeline)(out)[name],
        np.array([contact.area for contact in LimbContacts.of(pipeline)(out)]),
        Sigma(pipeline)(frame, out, pose_covariance=covariance)[name],
        PlannerMesh(pipeline.garments[name], max_triangles=500).solid(mesh.local),
        Observer(pipeline)(frame, mesh.vertices[::9] + 0.01, eye=[0.5, 0.4, 2])[name].local,
        *(found.pairs, found.inside, found.depth),
        detector.detect(out.skin).faces,
    ]


@pytest.fixture(scope="module")
def answers(dressed: Dressed) -> list[np.ndarray]:
    return _answers(*dressed)


@each_setting
def test_outputs_checks_and_observers_give_the_same(
    settings: Settings, dressed: Dressed, answers: list[np.ndarray]
) -> None:
    with settings():
        got = _answers(*dressed)
    for one, other in zip(got, answers, strict=True):
        np.testing.assert_array_equal(one, other)


@each_setting
def test_bodies_distances_and_derivatives_are_the_same(settings: Settings, dressed: Dressed) -> None:
    pipeline, frame, out = dressed
    pose, betas = torch.tensor(frame.pose)[None].requires_grad_(), torch.tensor(frame.betas)[None]
    points, skin = torch.tensor(out["tshirt-male"].local), torch.tensor(out.body)

    def results() -> list[torch.Tensor]:
        found = [load_body("male")(frame.pose[None], frame.betas[None]).vertices]
        for sdf in (ApproxSdf(pipeline.body), BandSdf(pipeline.body.faces), ExactSdf(pipeline.body.faces)):
            sdf.update(skin)
            found.append(sdf.query(points).distance)
        done = dress(pose, Wearer.of(pipeline.outfit, betas))
        return [*found, done.body, done.drapes["tshirt-male"].vertices]

    def slope(results: list[torch.Tensor]) -> torch.Tensor | None:
        summed = results[-1].sum() + results[-2].sum()
        return torch.autograd.grad(summed, pose)[0] if summed.requires_grad else None

    wanted = results()
    with settings():
        got = results()
    for one, other in zip(got, wanted, strict=True):
        torch.testing.assert_close(one.detach(), other.detach(), rtol=0, atol=1e-6)
    if (along := slope(got)) is not None:  # there is none in inference mode
        torch.testing.assert_close(along, slope(wanted))
