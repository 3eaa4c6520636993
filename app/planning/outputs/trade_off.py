"""The trade-off of an optimised plan as a table and a sentence."""

from __future__ import annotations

import io

from app.formats.spreadsheet import TableWriter
from app.planning.trade_off import Optimum

COLUMNS = (
    "fix_every_m", "path_error_m", "cost", "bound", "even_cost", "share_of_even", "currency", "markers", "required",
)  # fmt: skip


def write_trade_off_csv(optimum: Optimum, currency: str) -> bytes:
    """Requirements with the cheapest cost found, its bound, and the cost of even spacing, as CSV in UTF-8."""
    stream = io.StringIO()
    writer = TableWriter(stream)
    writer.write_row(COLUMNS)
    required = optimum.quality
    for point in optimum.table:
        even = point.even_cost
        is_required = (point.fix_every_m, point.path_error_m) == (required.fix_every_m, required.path_error_m)
        writer.write_row(
            [
                f"{point.fix_every_m:.10g}", "" if point.path_error_m is None else f"{point.path_error_m:.10g}",
                f"{point.cost:.2f}", f"{point.bound:.2f}", "" if even is None else f"{even:.2f}",
                "" if even is None else f"{point.cost / even:.3f}", currency,
                "; ".join(f"{count} {family}" for family, count in point.counts), "yes" if is_required else "no",
            ]
        )  # fmt: skip
    return stream.getvalue().encode()


def optimum_sentence(optimum: Optimum, currency: str) -> str:
    """The optimum for people."""
    asked = f"a fix every {optimum.quality.fix_every_m:g} m"
    if optimum.quality.path_error_m is not None:
        asked += f", path error {optimum.quality.path_error_m:g} m"
    sentence = f"cheapest plan found for {asked}: {optimum.cost:,.2f} {currency}, bound {optimum.bound:,.2f}"
    even = optimum.table[0].even_cost if optimum.table else None
    return sentence + ("" if even is None else f"; even spacing of equal quality: {even:,.2f}")
