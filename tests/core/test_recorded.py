"""Launches that are recorded once and repeated, as Warp packs their arguments and as this project does."""

from __future__ import annotations

import pytest
import torch
import warp as wp

from refu_core import _warp
from refu_core._warp import Recorded, Repeated, as_warp, memory


@wp.struct
class _Scale:
    factor: wp.float32
    shift: wp.array[wp.vec3]


@wp.kernel(enable_backward=False)
def _scale_kernel(times: int, scale: _Scale, given: wp.array[wp.vec3], found: wp.array[wp.vec3]) -> None:
    i = wp.tid()
    found[i] = float(times) * scale.factor * given[i] + scale.shift[0]


@pytest.fixture(params=["packed once", "packed by Warp"])
def _who_packs(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    assert _warp._packs_once(), "this release is a known one"
    if request.param == "packed by Warp":
        monkeypatch.setattr(_warp, "_packs_once", lambda: False)


@pytest.mark.usefixtures("_who_packs")
def test_a_launch_is_repeated_on_what_its_arrays_hold_by_then() -> None:
    given, found, shift = memory(5, 3), memory(5, 3), memory(1, 3)
    scale = _Scale()
    scale.factor, scale.shift = 0.5, as_warp(shift, wp.vec3)
    command = Recorded(_scale_kernel, 5, [2, scale, as_warp(given, wp.vec3), as_warp(found, wp.vec3)], "cpu")
    for times in (2, 3, 7):
        given.normal_()
        shift.normal_()
        command.set_argument(0, times)
        command.launch()
        torch.testing.assert_close(found, 0.5 * times * given + shift)


@pytest.mark.usefixtures("_who_packs")
def test_a_kernel_is_repeated_on_other_arrays() -> None:
    shift = memory(1, 3).normal_()
    scale = _Scale()
    scale.factor, scale.shift = 2.0, as_warp(shift, wp.vec3)
    repeated = Repeated(_scale_kernel, (wp.vec3, wp.vec3), [1, scale])
    for n in (4, 6, 4, 0, 6):
        given, found = torch.randn(n, 3), torch.full((n, 3), torch.nan)
        repeated((n,), given, found)
        torch.testing.assert_close(found, 2 * given + shift)
