"""What else a program has set torch to changes nothing: inference mode, autocast, default type and device."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

import numpy as np
import pytest
import torch
import trimesh

from refu_core import ExactSdf, GarmentPipeline, Resolver, SmplFrame
from refu_core.realtime import PipelineOutput
from refu_core.sdf import BandSdf
from refu_lab.stress._frames import everyday

Settings = Callable[[], contextlib.AbstractContextManager[object]]


@contextlib.contextmanager
def _float64() -> Iterator[None]:
    torch.set_default_dtype(torch.float64)
    try:
        yield
    finally:
        torch.set_default_dtype(torch.float32)


_SETTINGS = {
    "inference mode": torch.inference_mode,
    "autocast": lambda: torch.autocast("cpu", dtype=torch.bfloat16),
    "default type": _float64,
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


@pytest.mark.parametrize("settings", [torch.inference_mode, _float64])
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
