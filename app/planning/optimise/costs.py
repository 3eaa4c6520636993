"""Costs of sites by the agency's unit costs."""

from __future__ import annotations

from collections import defaultdict

from app.errors import InvalidParameter
from app.planning.rules import PlanRules


def site_costs(rules: PlanRules) -> dict[str, float]:
    """Cost of one site of each family that the rules place, from the agency's unit costs: a tag with its magnets and
    holes, a pair of CERPMs; days by the rate.

    Raises
    ------
    InvalidParameter
        A family has no unit cost.
    """
    price = list_prices(rules)
    each = price["marker"] + (price["day"] / rules.costs.markers_per_day if rules.costs.markers_per_day else 0.0)
    costs = {}
    if rules.plates is not None:
        costs["plate"] = price["plate"] + each
    if rules.tags is not None:
        costs["magnet"] = price["tag"] + rules.tags.magnets * (price["magnet"] + price["hole"]) + each
    if rules.cerpm is not None:
        sides = 2 if rules.cerpm.sides == "both" else 1
        costs["cerpm"] = sides * (price["cerpm"] + each)
    for family, cost in costs.items():
        if cost <= 0:
            raise InvalidParameter(
                f"there is no unit cost for the family {family}",
                field="costs.items",
                limit="a positive cost of each family that the rules place",
                cure=f"add a price per {'magnet or tag' if family == 'magnet' else family}, or per marker",
            )
    return costs


def list_prices(rules: PlanRules) -> dict[str, float]:
    """Sum of the agency's prices by what they are per."""
    prices: defaultdict[str, float] = defaultdict(float)
    for item in rules.costs.items:
        prices[item.per] += item.price
    return prices
