"""What the paper says in its tables, as orders of two methods, and whether they hold for our figures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from refu_core.evaluation.reproduction._tables import METRICS, Table, format_value, label_of


class Order(NamedTuple):
    """The paper's claim that one method is at least as good as another in a metric."""

    metric: str
    better: str
    worse: str


class Gap(NamedTuple):
    """Mean difference of two methods over the same samples, and half of its 95 % interval."""

    mean: float
    margin: float

    @property
    def is_chance(self) -> bool:
        """Whether none at all is within the interval."""
        return abs(self.mean) <= self.margin


def findings(
    table: Table,
    orders: Sequence[Order],
    labels: Mapping[str, str],
    *,
    gap: Callable[[str, Order], Gap | None] | None = None,
) -> list[str]:
    """A sentence for each order and garment that the table has both figures for, those that hold first.

    `gap` of a garment and an order says how sure a difference is; one of which it says so may be chance is told apart.
    """
    found: dict[str, list[str]] = {"Holds": [], "May be chance": [], "Doesn't hold": []}
    garments = list(dict.fromkeys(row.garment for row in table.rows))
    for order in orders:
        shown: dict[str, list[str]] = {verdict: [] for verdict in found}
        for garment in garments:
            better = table.value(garment, order.better, order.metric)
            worse = table.value(garment, order.worse, order.metric)
            if better is None or worse is None:
                continue
            figures = f"{garment} {format_value(order.metric, better)} against {format_value(order.metric, worse)}"
            if is_as_good(order.metric, better, worse):
                shown["Holds"].append(figures)
                continue
            known = None if gap is None else gap(garment, order)
            if known is not None:
                digits = METRICS[order.metric].digits + 1
                figures += f", sample by sample {known.mean:+.{digits}f} ± {known.margin:.{digits}f}"
            shown["May be chance" if known is not None and known.is_chance else "Doesn't hold"].append(figures)
        claim = f"{label_of(order.metric)}: {labels[order.better]} at least as good as {labels[order.worse]}"
        for verdict, cases in shown.items():
            if cases:
                found[verdict].append(f"{claim}. **{verdict}** ({'; '.join(cases)}).")
    return [sentence for sentences in found.values() for sentence in sentences]


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
