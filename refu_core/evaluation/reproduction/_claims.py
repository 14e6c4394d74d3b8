"""What the paper says in its tables, as orders of two methods, and whether they hold for our figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from refu_core.evaluation.reproduction._tables import METRICS, Table, format_value, label_of


class Order(NamedTuple):
    """The paper's claim that one method is at least as good as another in a metric."""

    metric: str
    better: str
    worse: str


def findings(table: Table, orders: Sequence[Order], labels: Mapping[str, str]) -> list[str]:
    """A sentence for each order and garment that the table has both figures for, those that hold first."""
    holding, failing = [], []
    garments = list(dict.fromkeys(row.garment for row in table.rows))
    for order in orders:
        agree: list[str] = []
        disagree: list[str] = []
        for garment in garments:
            better = table.value(garment, order.better, order.metric)
            worse = table.value(garment, order.worse, order.metric)
            if better is None or worse is None:
                continue
            shown = f"{garment} {format_value(order.metric, better)} against {format_value(order.metric, worse)}"
            (agree if is_as_good(order.metric, better, worse) else disagree).append(shown)
        claim = f"{label_of(order.metric)}: {labels[order.better]} at least as good as {labels[order.worse]}"
        if agree:
            holding.append(f"{claim}. **Holds** ({', '.join(agree)}).")
        if disagree:
            failing.append(f"{claim}. **Doesn't hold** ({', '.join(disagree)}).")
    return holding + failing


def count_held(table: Table, orders: Sequence[Order]) -> tuple[int, int]:
    """How many of the orders hold over all garments with figures, and how many there are figures for."""
    held = tested = 0
    for order in orders:
        for garment in dict.fromkeys(row.garment for row in table.rows):
            better = table.value(garment, order.better, order.metric)
            worse = table.value(garment, order.worse, order.metric)
            if better is not None and worse is not None:
                tested += 1
                held += is_as_good(order.metric, better, worse)
    return held, tested


def is_as_good(metric: str, better: float, worse: float) -> bool:
    """Whether the first figure is at least as good as the second, both rounded as they are written."""
    better, worse = (round(value, METRICS[metric].digits) for value in (better, worse))
    return better >= worse if METRICS[metric].higher_is_better else better <= worse
