"""What a caller makes of a prediction is checked before kernels read it."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from refu_core import GarmentPipeline, RefuError, SmplFrame
from refu_core.realtime import Dressed

WORN = "short-pant-male"
FRAME = SmplFrame(np.zeros((24, 3)))


@functools.cache
def pipeline() -> GarmentPipeline:
    return GarmentPipeline.load([WORN])


def with_nan(values: Tensor) -> Tensor:
    values = values.clone()
    values[0, 5] = torch.nan
    return values


def drape(**change: Callable[[Tensor], Any]) -> Callable[[Dressed], Dressed]:
    """An adjustment of some fields of the garment."""

    def adjust(dressed: Dressed) -> Dressed:
        one = dressed.drapes[WORN]
        one = one._replace(**{field: make(getattr(one, field)) for field, make in change.items()})
        return dressed._replace(drapes={WORN: one})

    return adjust


@pytest.mark.parametrize(
    ("adjust", "said"),
    [
        (lambda dressed: dressed._replace(drapes={}), f"all garments back .*{WORN}.*, got none"),
        (lambda dressed: dressed._replace(drapes=None), "garments by name from what adjusts them, got NoneType"),
        (lambda dressed: dressed._replace(drapes={WORN: 3}), f"wanted a Drape of {WORN} .*, got int"),
        (lambda dressed: dressed._replace(drapes={**dressed.drapes, "hat": 3}), f"got {WORN}, hat"),
        (lambda dressed: dressed._replace(turns=[]), "turns of 1 persons back, got 0"),
        (lambda dressed: dressed._replace(skin=dressed.skin[:, :9]), r"Dressed's skin: .*shape \(1, 9, 3\)"),
        (lambda dressed: dressed._replace(aside=with_nan(dressed.aside)), "Dressed's aside must be finite"),
        (drape(vertices=lambda own: own[:, :100]), rf"{WORN}'s vertices: .* shape \(1, 100, 3\)"),
        (drape(vertices=lambda own: own[0]), f"{WORN}'s vertices: wanted .*, got"),
        (drape(vertices=lambda own: own.double()), "got torch.float64"),
        (drape(vertices=lambda own: own.numpy()), "vertices must be a floating-point torch.Tensor, got ndarray"),
        (drape(vertices=with_nan), "vertices must be finite, got 1 of"),
        (drape(on_mean=with_nan), "on_mean must be finite, got 1 of"),
        (drape(on_mean=lambda own: own[:, 1:]), f"{WORN}'s on_mean: wanted"),
    ],
)
def test_what_is_not_a_prediction_any_more_is_refused(adjust: Callable[[Dressed], Dressed], said: str) -> None:
    """A dropped garment was a KeyError, vertices without a batch were spread over the garment, and others crashed."""
    with pytest.raises(RefuError, match=said):
        pipeline().adjusted(FRAME, adjust)


def test_what_is_left_as_it_was_or_moved_is_dressed() -> None:
    plain = pipeline()(FRAME)[WORN].vertices
    for adjust in (
        lambda dressed: dressed,
        drape(feature=lambda _: None),  # then α is 1
        drape(vertices=lambda own: own.mT.contiguous().mT),
    ):
        assert np.abs(pipeline().adjusted(FRAME, adjust)[WORN].vertices - plain).max() < 1e-3
