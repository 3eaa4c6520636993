"""Cost against quality: a table of requirements, with what they cost and what even spacing costs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from app.planning.rules import Quality


@dataclass(frozen=True, slots=True)
class TradeOffPoint:
    """One requirement and the cheapest plan found for it.

    Attributes
    ----------
    fix_every_m : float
        [m]
    path_error_m : float or None
        Greatest path error; None where none is required. [m]
    cost : float
        Of the whole plan, in the currency of the rules.
    bound : float
        No plan that has the same pairs along the path is cheaper.
    even_cost : float or None
        With even spacing at equal quality; None where no even spacing has it.
    counts : tuple of (str, int)
        Markers by family.
    """

    fix_every_m: float
    path_error_m: float | None
    cost: float
    bound: float
    even_cost: float | None
    counts: tuple[tuple[str, int], ...]

    def is_better(self, other: TradeOffPoint) -> bool:
        """Whether it is at least as good in all and better in one of cost, fixes and path error."""
        mine, others = (self._figures(), other._figures())
        return all(a <= b for a, b in zip(mine, others, strict=True)) and mine != others

    def _figures(self) -> tuple[float, float, float]:
        return self.cost, self.fix_every_m, self.path_error_m or 0.0


@dataclass(frozen=True, slots=True)
class Optimum:
    """How a plan was optimised.

    Attributes
    ----------
    quality : Quality
        As required; `fix_every_m` is the best that the budget buys, where there is one.
    cost : float
        Of the whole plan, in the currency of the rules; working days are not rounded, and there is one more.
    bound : float
        No plan with the same pairs along the path and the same markers ahead of events is cheaper.
    table : tuple of TradeOffPoint
        The required quality first.
    """

    quality: Quality
    cost: float
    bound: float
    table: tuple[TradeOffPoint, ...]


def pareto_points(points: Sequence[TradeOffPoint]) -> tuple[TradeOffPoint, ...]:
    """Points that no other point is better than, by cost."""
    best = [point for point in points if not any(other.is_better(point) for other in points)]
    return tuple(sorted(best, key=lambda point: point.cost))
