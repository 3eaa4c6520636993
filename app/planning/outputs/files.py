"""The files of a plan, each written when it is asked for."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache, partial

from app.errors import InvalidParameter, NotFound
from app.planning.outputs.bill import plan_bill, write_bill_csv
from app.planning.outputs.cerpm_programs import plan_programs, write_plan_programs_csv, write_plan_programs_json
from app.planning.outputs.hd_lanelet2 import write_lanelet2
from app.planning.outputs.hd_map import map_of_plan
from app.planning.outputs.hd_opendrive import OpenDriveMap
from app.planning.outputs.plan_document import write_plan
from app.planning.outputs.plan_geojson import write_plan_geojson
from app.planning.outputs.report import write_report
from app.planning.outputs.schedule import write_schedule_csv
from app.planning.outputs.stakeout import StakeoutFormat, write_stakeout
from app.planning.outputs.stakeout_points import plan_stakeout
from app.planning.outputs.strip_map import DrawingOptions, Drawings
from app.planning.outputs.trade_off import write_trade_off_csv
from app.planning.plan import Plan
from app.planning.trade_off import Optimum, TradeOffPoint

DrawTradeOff = Callable[[Sequence[TradeOffPoint], str], str]
"""Points of a trade-off and the currency to an SVG picture."""


@dataclass(frozen=True, slots=True)
class OutputOptions:
    """How a plan is handed out.

    Attributes
    ----------
    crs, unit : str, optional
        Of the stakeout; see `plan_stakeout`.
    drawings : DrawingOptions
    draw_trade_off : callable, optional
        Draws the trade-off of an optimised plan as SVG; without, there is no picture of it.
    """

    crs: str | None = None
    unit: str | None = None
    drawings: DrawingOptions = field(default_factory=DrawingOptions)
    draw_trade_off: DrawTradeOff | None = None


@dataclass(frozen=True, slots=True)
class OutputFile:
    """A file of a plan; `write` makes its bytes, the same ones every time."""

    name: str
    write: Callable[[], bytes]


MEDIA_TYPES = {
    "csv": "text/csv", "dxf": "image/vnd.dxf", "geojson": "application/geo+json", "json": "application/json",
    "gpkg": "application/geopackage+sqlite3", "md": "text/markdown", "osm": "application/xml",
    "pdf": "application/pdf", "svg": "image/svg+xml", "txt": "text/plain", "xml": "application/xml",
    "xodr": "application/xml", "zip": "application/zip",
}  # fmt: skip
"""Media types of the files by the ends of their names."""


def write_plan_file(plan: Plan, name: str, options: OutputOptions | None = None) -> bytes:
    """One file of a plan.

    Raises
    ------
    NotFound
        The plan has no such file.
    InvalidParameter, ReferenceSystemError
        As `plan_files`.
    """
    names = []
    for file in plan_files(plan, options):
        if file.name == name:
            return file.write()
        names.append(file.name)
    raise NotFound(
        f"the plan has no file {name[:60]!r}", field="name", limit=", ".join(names), cure="ask for one of these"
    )


def plan_files(plan: Plan, options: OutputOptions | None = None) -> Iterator[OutputFile]:
    """Files of a plan in the order in which they are written; without markers, those that need none.

    A map in OpenDRIVE is left out where a marker lies beside no lane; the report then has the reason.

    Raises
    ------
    InvalidParameter, ReferenceSystemError
        The options do not fit the plan; raised before the first file.
    """
    options = options or OutputOptions()
    stakeout = plan_stakeout(plan, options.crs, options.unit) if plan.markers else None
    drawings = Drawings(plan, options.drawings) if plan.markers else None
    yield OutputFile("plan.json", lambda: write_plan(plan))
    yield OutputFile("plan.geojson", lambda: write_plan_geojson(plan))
    opendrive = cache(lambda: _opendrive(plan))
    yield OutputFile("report.md", lambda: write_report(plan, _left_out(opendrive())))
    yield OutputFile("bill.csv", lambda: write_bill_csv(plan_bill(plan)))
    if plan.optimum is not None:
        yield from _trade_off_files(plan.optimum, plan.rules.costs.currency, options)
    yield OutputFile("schedule.csv", lambda: write_schedule_csv(plan))
    if drawings is not None:
        for name in drawings.names:
            yield OutputFile(name, partial(drawings.write, name))
    if stakeout is not None:
        for form in StakeoutFormat:
            yield OutputFile(form.value, partial(write_stakeout, stakeout, form))
    if plan.counts.get("cerpm"):
        programs = cache(lambda: plan_programs(plan))  # two files need them, and the radio's settings take seconds
        yield OutputFile("cerpm-programs.csv", lambda: write_plan_programs_csv(programs()))
        yield OutputFile("cerpm-programs.json", lambda: write_plan_programs_json(plan, programs()))
    yield OutputFile("map.osm", lambda: write_lanelet2(map_of_plan(plan)))
    road_map = opendrive()
    if isinstance(road_map, OpenDriveMap):
        yield OutputFile("map.xodr", road_map.write)


def _opendrive(plan: Plan) -> OpenDriveMap | InvalidParameter:
    """The map in OpenDRIVE, or why there is none."""
    try:
        return OpenDriveMap(map_of_plan(plan))
    except InvalidParameter as error:
        return error


def _left_out(road_map: OpenDriveMap | InvalidParameter) -> dict[str, str]:
    """Files that a plan does not have, with the reason."""
    return {"map.xodr": road_map.message} if isinstance(road_map, InvalidParameter) else {}


def _trade_off_files(optimum: Optimum, currency: str, options: OutputOptions) -> Iterator[OutputFile]:
    draw = options.draw_trade_off
    yield OutputFile("trade-off.csv", lambda: write_trade_off_csv(optimum, currency))
    if draw is not None:
        yield OutputFile("trade-off.svg", lambda: draw(optimum.table, currency).encode())
