"""Schedule of work: which stretch of which lane is built when, and what a crew carries there."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from app.encoders.magnet.sheet_csv import fixed
from app.formats.spreadsheet import TableWriter
from app.planning.alignment import format_station
from app.planning.plan import Plan, PlannedLineMagnet, PlannedMarker, PlannedTag

SECTION_M = 1000.0
"""Length of a section where no daily rate is given. [m] Source: chosen by hand, from one kilometre post to the next."""
COLUMNS = (
    "order", "day", "lane", "from_station", "to_station", "from_chainage_m", "to_chainage_m", "first_marker",
    "last_marker", "markers", "plates", "line_magnets", "information_tags", "holes", "cerpms",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Section:
    """One stretch of a lane that is built without a break, in the direction of travel.

    Attributes
    ----------
    order : int
        From 1, in the order of installation.
    day : int or None
        Working day from 1; None without a daily rate.
    lane : str
    markers : tuple of PlannedMarker
        By number.
    """

    order: int
    day: int | None
    lane: str
    markers: tuple[PlannedMarker, ...]

    def count(self, family: str) -> int:
        """Markers of a family."""
        return sum(marker.family == family for marker in self.markers)

    @property
    def line_magnets(self) -> int:
        """Magnets of painted lines."""
        return sum(isinstance(marker.detail, PlannedLineMagnet) for marker in self.markers)

    @property
    def tags(self) -> tuple[PlannedTag, ...]:
        """Information tags."""
        return tuple(marker.detail for marker in self.markers if isinstance(marker.detail, PlannedTag))

    @property
    def holes(self) -> int:
        """Holes to drill: one a magnet."""
        return self.line_magnets + sum(tag.tag.magnet_count for tag in self.tags)


def plan_schedule(plan: Plan) -> tuple[Section, ...]:
    """Sections in the order of installation: lane by lane, in the direction of travel.

    Notes
    -----
    With `costs.markers_per_day` a day holds as many markers as the crew installs, and a section ends with the day or
    with the lane. Without, a section is a kilometre of a lane.
    """
    rate = plan.rules.costs.markers_per_day
    sections: list[Section] = []
    done = 0
    for markers in _by_lane(plan.markers):
        start = 0
        while start < len(markers):
            if rate is None:
                day, end = None, _end_of_kilometre(markers, start)
            else:
                day = math.floor(done / rate + 1e-9) + 1
                end = start + max(math.floor(day * rate + 1e-9) - done, 1)
            part = tuple(markers[start:end])
            sections.append(Section(len(sections) + 1, day, part[0].lane, part))
            start, done = start + len(part), done + len(part)
    return tuple(sections)


def _by_lane(markers: Sequence[PlannedMarker]) -> Iterator[list[PlannedMarker]]:
    lanes: dict[str, list[PlannedMarker]] = {}
    for marker in markers:
        lanes.setdefault(marker.lane, []).append(marker)
    yield from lanes.values()


def _end_of_kilometre(markers: Sequence[PlannedMarker], start: int) -> int:
    kilometre = markers[start].chainage_m // SECTION_M
    return next(
        (k for k in range(start, len(markers)) if markers[k].chainage_m // SECTION_M != kilometre), len(markers)
    )


def write_schedule_csv(plan: Plan) -> bytes:
    """The schedule as CSV in UTF-8, one row a section; stations are displayed ones."""
    stream = io.StringIO()
    writer = TableWriter(stream)
    writer.write_row(COLUMNS)
    for section in plan_schedule(plan):
        first, last = section.markers[0], section.markers[-1]
        stations = [format_station(plan.alignment.displayed_station_m(m.station_m)) for m in (first, last)]
        writer.write_row(
            [
                section.order, section.day or "", section.lane, *stations,
                fixed(first.chainage_m, 2), fixed(last.chainage_m, 2), first.number, last.number,
                len(section.markers), section.count("plate"), section.line_magnets, len(section.tags), section.holes,
                section.count("cerpm"),
            ]
        )  # fmt: skip
    return stream.getvalue().encode()
