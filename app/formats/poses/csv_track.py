"""Tracks as delimited text with a header."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

from app.errors import InvalidParameter
from app.formats.delimited import read_number
from app.formats.log_times import LogClock, has_zone
from app.formats.poses.datum import check_datum
from app.formats.poses.declaration import ALIASES, PoseSource
from app.formats.poses.points import PosePoint
from app.formats.text import clean_text

NEEDED = ("time", "lon", "lat")


def read_csv(source: PoseSource) -> Iterator[PosePoint]:
    """Points of the rows; a row that cannot be read is left out.

    Raises
    ------
    InvalidParameter
        A column is missing.
    ReferenceSystemError
        A row has another datum.
    """
    name, log, report, declaration = source.sample.name, source.sample.log, source.report, source.declaration
    places = log.places(ALIASES, declaration.columns)
    missing = [quantity for quantity in NEEDED if quantity not in places]
    if missing:
        shown = ", ".join(repr(clean_text(c, 40)) for c in log.columns[:24])
        raise InvalidParameter(
            f"{name} has no column of the {missing[0]}; its columns are {shown}",
            field=f"poses.columns.{missing[0]}",
            limit=", ".join(ALIASES[missing[0]]),
            cure="name the columns so, or declare their names",
        )
    datums: set[str] = set()
    zoned = True
    for entry, cells in enumerate(log.rows()):
        report.entries += 1
        if cells is None:
            report.leave_out(entry, "malformed", log.bad_row())
            continue
        try:
            point = _point_of(entry, cells, places, declaration.clock, log.dialect.decimal)
        except (ValueError, OverflowError):
            report.leave_out(entry, "malformed", "the row holds text where numbers are expected")
            continue
        if "crs" in places and cells[places["crs"]] not in datums:
            if not math.isnan(point.lon_deg):
                check_datum(cells[places["crs"]], point.lon_deg, point.lat_deg)
            datums.add(cells[places["crs"]])
        zoned = zoned and (":" not in cells[places["time"]] or has_zone(cells[places["time"]]))
        yield point
    if not zoned and not declaration.clock.utc_offset_s:
        report.warn("times without a zone were taken as UTC; declare the zone's offset if they are local")


def _point_of(entry: int, cells: list[str], places: Mapping[str, int], clock: LogClock, decimal: str) -> PosePoint:
    def figure(quantity: str) -> float:
        place = places.get(quantity)
        return math.nan if place is None else read_number(cells[place], decimal)

    written = cells[places["time"]]
    at_s = clock.read(written.replace(",", ".") if decimal == "," else written)
    return PosePoint(entry, at_s, figure("lon"), figure("lat"), figure("heading"), figure("accuracy"))
