"""The node under load: nothing comes twice, what comes is recorded, and what counts as slower. `load` has the rest."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

pytest.importorskip("rclpy", reason="rclpy isn't installed (extra ros): the node isn't tested")

from tests.ros.load import NodeSoak, soak_node

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.filterwarnings("ignore:module 'sre_:DeprecationWarning")


def test_nothing_comes_twice_and_all_is_recorded(ros: None, tmp_path: Path) -> None:  # noqa: ARG001
    result = soak_node(tmp_path, seconds=2, garments=["tshirt-male"], backbone="skinned", sdf="accurate")
    # On a busy machine a frame may be late and be superseded, but the last one comes, and nothing may come twice.
    assert result.sent == 60
    assert result.received > 0
    wrong = (result.doubled, result.recorded_twice, result.not_recorded, result.nan, result.exit_code)
    assert wrong == (0,) * 5, result
    assert result.recorded >= result.received


@pytest.mark.parametrize(
    ("later", "longer", "machine", "is_slower"),
    [
        (2.0, 2.0, 1.0, True),
        (2.0, 1.0, 1.0, False),  # others want the processor
        (2.0, 2.0, 2.0, False),  # everything takes longer
        (1.04, 2.0, 1.0, False),
        (1.06, 1.06, 1.0, True),
    ],
)
def test_a_node_is_slower_by_the_clock_and_by_its_own_work(
    later: float, longer: float, machine: float, is_slower: bool
) -> None:
    figures = dict.fromkeys(("sent", "received", "recorded"), 20_000)
    figures |= dict.fromkeys(
        ("doubled", "superseded", "replaced", "not_recorded", "recorded_twice", "nan", "exit_code"), 0
    )
    ratios = {"memory_mb": 1.0, "p99_ms": later, "cpu_ms": longer, "yardstick_ms": machine}
    result = NodeSoak(**figures, **{name: (1.0, last) for name, last in ratios.items()})  # type: ignore[arg-type]
    assert (result.is_slower, result.failures) == (is_slower, int(is_slower))
    assert not replace(result, sent=19_999).is_slower
