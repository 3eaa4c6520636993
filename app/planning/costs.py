"""Bill of materials of a layout, compared with what else could mark the road."""

from __future__ import annotations

from functools import lru_cache

from app.encoders.magnet.bill import PAINT, Bill, CostRow, UnitCost
from app.encoders.magnet.layout import MagnetLayout
from app.markers.magnet import InformationTag
from app.planning.paper_figures import read_figures

_MAGNET = "magnet with shell"
_RFID = "rugged RFID tag"


@lru_cache(maxsize=1)
def unit_costs() -> dict[str, UnitCost]:
    """Unit costs that the METRO paper gives, by item (section 8.1 and table 2)."""
    costs = (
        UnitCost(cost["item"], cost["unit"], float(cost["low"]), float(cost["high"]), cost["source"])
        for cost in read_figures("costs.csv")
    )
    return {cost.item: cost for cost in costs}


def bill_of_materials(layout: MagnetLayout) -> Bill:
    """What a layout costs in materials, beside paint of the same length."""
    costs = unit_costs()
    alternatives = [CostRow(costs[PAINT], round(layout.length_m, 2))]
    if isinstance(layout.tag, InformationTag):
        alternatives.append(CostRow(costs[_RFID], 1))
    return Bill((CostRow(costs[_MAGNET], len(layout.holes)),), tuple(alternatives))
