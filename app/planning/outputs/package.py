"""All files of a plan, the sheets of its magnets and the artwork of its plates, in parts that are written one by one.

The same plan and options give the same files in the same order, whichever process writes which part.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import cache, cached_property, partial
from typing import Annotated

import orjson
from pydantic import Field, JsonValue, with_config

from app.encoders.magnet import MagnetLayout, SheetFormat, place_line, place_tag, write_sheet
from app.encoders.plate import (
    ArtworkFormat,
    ArtworkOptions,
    PlateOrder,
    PlateReader,
    encode_plate,
    prove_plate,
    quality_sheets,
    write_artwork,
    write_pdf,
)
from app.encoders.plate.bundle import quality_csv
from app.encoders.plate.face import reference_text
from app.errors import InvalidParameter, NotFound
from app.formats.surveys.declaration import Unit
from app.geodesy import UNFIT_TEXT, LocalizationGrade
from app.inputs import INPUT, Flag, Number, Text, Whole
from app.markers.magnet import LineStyle
from app.planning.magnet_checks import Site, drilling_sheet
from app.planning.magnet_stretches import even_stretches, lane_around, spacing_of
from app.planning.outputs.bill import plan_bill, write_bill_csv, write_report, write_schedule_csv, write_trade_off_csv
from app.planning.outputs.drawing_sheet import TitleBlock
from app.planning.outputs.hd_lanelet2 import write_lanelet2
from app.planning.outputs.hd_map import map_of_plan
from app.planning.outputs.hd_opendrive import OpenDriveMap
from app.planning.outputs.plan_document import (
    plan_programs,
    write_plan,
    write_plan_geojson,
    write_plan_programs_csv,
    write_plan_programs_json,
)
from app.planning.outputs.stakeout import Stakeout, StakeoutFormat, plan_stakeout, write_stakeout
from app.planning.outputs.strip_map import Drawings
from app.planning.plan import Optimum, Plan, PlannedLineMagnet, PlannedMarker, PlannedPlate, PlannedTag, TradeOffPoint
from app.roads.lane_line import LaneLine

# === The files of a plan, each written when it is asked for.


DrawTradeOff = Callable[[Sequence[TradeOffPoint], str], str]
"""Points of a trade-off and the currency to an SVG picture."""


@with_config(INPUT)
@dataclass(frozen=True, slots=True)
class OutputOptions:
    """How the files of a plan are written."""

    crs: Annotated[Text | None, Field(max_length=64, description="Projected CRS of the stakeout.")] = None
    unit: Annotated[Unit | None, Field(description="Of the stakeout.")] = None
    realization: Annotated[
        Text | None, Field(max_length=64, description="Of that CRS; that of the road if left out.")
    ] = None
    epoch: Annotated[
        Number | None, Field(ge=1950, le=2200, description="Of the stakeout; that of the road if left out.")
    ] = None
    scale: Annotated[
        Whole | None, Field(ge=1, le=100_000, description="Of the drawings: 250, 500, 1000, 2000 or 5000.")
    ] = None
    title_block: TitleBlock = field(default_factory=TitleBlock)

    def stakeout(self, plan: Plan) -> Stakeout:
        """The stakeout of a plan; raises as `plan_stakeout`."""
        return plan_stakeout(plan, self.crs, self.unit, self.realization, self.epoch)


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


def write_plan_file(
    plan: Plan, name: str, options: OutputOptions | None = None, draw_trade_off: DrawTradeOff | None = None
) -> bytes:
    """One file of a plan.

    Raises
    ------
    NotFound
        The plan has no such file.
    InvalidParameter, ReferenceSystemError
        As `plan_files`.
    """
    names = []
    for file in plan_files(plan, options, draw_trade_off):
        if file.name == name:
            return file.write()
        names.append(file.name)
    raise NotFound(
        f"the plan has no file {name[:60]!r}", field="name", limit=", ".join(names), cure="ask for one of these"
    )


def plan_files(
    plan: Plan, options: OutputOptions | None = None, draw_trade_off: DrawTradeOff | None = None
) -> Iterator[OutputFile]:
    """Files of a plan in the order in which they are written; without markers, those that need none.

    A map in OpenDRIVE is left out where a marker lies beside no lane; the report then has the reason.

    Parameters
    ----------
    draw_trade_off : callable, optional
        Draws the trade-off of an optimised plan as SVG; without, there is no picture of it.

    Raises
    ------
    InvalidParameter, ReferenceSystemError
        The options do not fit the plan; raised before the first file.
    """
    options = options or OutputOptions()
    stakeout = options.stakeout(plan) if plan.markers else None
    drawings = Drawings(plan, options.title_block, options.scale) if plan.markers else None
    yield OutputFile("plan.json", lambda: write_plan(plan))
    yield OutputFile("plan.geojson", lambda: write_plan_geojson(plan))
    opendrive = cache(lambda: _opendrive(plan))
    yield OutputFile("report.md", lambda: write_report(plan, _left_out(opendrive())))
    yield OutputFile("bill.csv", lambda: write_bill_csv(plan_bill(plan)))
    if plan.optimum is not None:
        yield from _trade_off_files(plan.optimum, plan.rules.costs.currency, draw_trade_off)
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


def _trade_off_files(optimum: Optimum, currency: str, draw: DrawTradeOff | None) -> Iterator[OutputFile]:
    yield OutputFile("trade-off.csv", lambda: write_trade_off_csv(optimum, currency))
    if draw is not None:
        yield OutputFile("trade-off.svg", lambda: draw(optimum.table, currency).encode())


# === All files of a plan, the sheets of its magnets and the artwork of its plates, in parts that are written one by
# one.


PACKAGE_FORMAT = "waymark-package/1"
MANIFEST = "manifest.json"
PLATES_A_PART, SHEETS_A_PART, QUALITY_A_PART = 20, 20, 300
"""Plates, drilling sheets and rows of a quality sheet that are written at a time. A second or two of work and some
megabytes; a quality sheet of 101 pages."""
MAX_SHEET_MAGNETS = 1000
"""Magnets of a line on one drilling sheet. Source: those of one marker, `app.families.magnet.layouts.MAX_MAGNETS`."""


_EXAMPLES: list[JsonValue] = [
    {
        "crs": "EPSG:25832",
        "scale": 500,
        "title_block": {"owner": "Example Road Agency", "date": "2026-11-22"},
        "formats": ["pdf", "dxf"],
    },
    {},
]


class PartKind(StrEnum):
    """What a part has."""

    FILE = "file"
    PLATES = "plates"
    QUALITY = "quality"
    TAGS = "tags"
    LINES = "lines"


@dataclass(frozen=True, slots=True)
class PackagePart:
    """Some files: one of `plan_files` by its name, or those of the markers from `start` until `stop` of their kind."""

    kind: PartKind
    name: str = ""
    start: int = 0
    stop: int = 0


@with_config(INPUT | {"json_schema_extra": {"examples": _EXAMPLES}})
@dataclass(frozen=True, slots=True)
class PackageOptions(OutputOptions):
    """How a plan is handed out; every member may be left out."""

    formats: Annotated[tuple[ArtworkFormat, ...], Field(min_length=1, max_length=4, description="Of each plate.")] = (
        ArtworkFormat.PDF,
        ArtworkFormat.SVG,
    )
    heaters: Annotated[Flag, Field(description="Heating tracks under dark units.")] = False
    leds: Annotated[Flag, Field(description="Light sources under light units.")] = False


class Package:
    """A plan and options, with what parts share; one a process. `draw_trade_off` is as of `plan_files`."""

    def __init__(self, plan: Plan, options: PackageOptions, draw_trade_off: DrawTradeOff | None = None) -> None:
        self.plan, self.options, self._draw_trade_off = plan, options, draw_trade_off

    def check(self) -> None:
        """Check the options without writing a file.

        Raises
        ------
        InvalidParameter, ReferenceSystemError
            They do not fit the plan.
        """
        if self.plan.markers:
            options = self.options
            try:
                options.stakeout(replace(self.plan, markers=self.plan.markers[:1]))
            except InvalidParameter as error:
                error.field = (error.field or "crs").removeprefix("position.")
                raise
            Drawings(self.plan, options.title_block, options.scale)

    def parts(self) -> list[PackagePart]:
        """All parts in the order of their files; the manifest comes last and is none of them."""
        parts = [PackagePart(PartKind.FILE, file.name) for file in self._files]
        for kind, count, size in (
            (PartKind.TAGS, len(self._tags), SHEETS_A_PART),
            (PartKind.LINES, len(self._lines), SHEETS_A_PART),
            (PartKind.PLATES, len(self._plates), PLATES_A_PART),
            (PartKind.QUALITY, len(self._plates), QUALITY_A_PART),
        ):
            parts += [PackagePart(kind, start=start, stop=min(start + size, count)) for start in range(0, count, size)]
        return parts

    def write(self, part: PackagePart, read: PlateReader) -> list[tuple[str, bytes]]:
        """Names and contents of a part's files; every plate is read back first.

        Raises
        ------
        ProofFailed
            A plate did not read back as its own code.
        """
        chosen = slice(part.start, part.stop)
        match part.kind:
            case PartKind.FILE:
                return [(file.name, file.write()) for file in self._files if file.name == part.name]
            case PartKind.TAGS:
                return [file for marker in self._tags[chosen] for file in self._tag_sheets(marker)]
            case PartKind.LINES:
                return [file for stretch in self._lines[chosen] for file in self._line_sheets(stretch)]
            case PartKind.PLATES:
                return [file for marker in self._plates[chosen] for file in self._artwork(marker, read)]
            case PartKind.QUALITY:
                return self._quality(part)

    def manifest(self, entries: list[dict[str, object]]) -> bytes:
        """The manifest: what was packed, with the name, size and SHA-256 of each file."""
        document = {
            "format": PACKAGE_FORMAT,
            "plan": self.plan.name,
            "counts": self.plan.counts,
            "read_back": len(self._plates),
            "options": self.options,
            "files": entries,
        }
        return orjson.dumps(document, option=orjson.OPT_INDENT_2)

    # --- what there is ----------------------------------------------------------------------------------------------

    @cached_property
    def _files(self) -> list[OutputFile]:
        return list(plan_files(self.plan, self.options, self._draw_trade_off))

    @cached_property
    def _plates(self) -> list[PlannedMarker]:
        return [marker for marker in self.plan.markers if isinstance(marker.detail, PlannedPlate)]

    @cached_property
    def _tags(self) -> list[PlannedMarker]:
        return [marker for marker in self.plan.markers if isinstance(marker.detail, PlannedTag)]

    @cached_property
    def _lines(self) -> list[list[PlannedMarker]]:
        return sorted(even_stretches(self.plan.markers, MAX_SHEET_MAGNETS), key=lambda stretch: stretch[0].number)

    # --- plates -----------------------------------------------------------------------------------------------------

    def _order(self, marker: PlannedMarker) -> PlateOrder:
        """A plate as the workshop is asked to make it; it has a record to point to when the plan is committed."""
        assert isinstance(marker.detail, PlannedPlate)
        road = self.plan.alignment
        warning = UNFIT_TEXT if road.grade is LocalizationGrade.UNFIT else None
        return PlateOrder(
            plate_id=f"plate-{marker.number:05d}",
            code=marker.detail.code,
            geometry=marker.detail.geometry,
            lon_deg=marker.lon_deg,
            lat_deg=marker.lat_deg,
            crs=reference_text(road.realization, road.epoch, warning),
        )

    def _artwork(self, marker: PlannedMarker, read: PlateReader) -> Iterator[tuple[str, bytes]]:
        order = self._order(marker)
        drawing = encode_plate(order, ArtworkOptions(self.options.heaters, self.options.leds))
        prove_plate(drawing, order.code, order.geometry, read)
        for form in dict.fromkeys(self.options.formats):
            yield f"artwork/{order.plate_id}.{form}", write_artwork(drawing, form, compress=False).content

    def _quality(self, part: PackagePart) -> list[tuple[str, bytes]]:
        orders = [self._order(marker) for marker in self._plates[part.start : part.stop]]
        name = "quality"
        if len(self._plates) > QUALITY_A_PART:
            name += f"-{part.start // QUALITY_A_PART + 1}"
        pages = write_pdf(quality_sheets(orders), compress=False)
        return [(f"artwork/{name}.pdf", pages), (f"artwork/{name}.csv", quality_csv(orders))]

    # --- magnets ----------------------------------------------------------------------------------------------------

    def _tag_sheets(self, marker: PlannedMarker) -> Iterator[tuple[str, bytes]]:
        detail = marker.detail
        assert isinstance(detail, PlannedTag)
        lon, lat, along_m = lane_around(self.plan.alignment.lane(marker.lane), marker)
        line = LaneLine.from_lon_lat(list(zip(lon.tolist(), lat.tolist(), strict=True)), marker.height_m or 0.0)
        name = f"tag-{marker.number:05d}"
        layout = place_tag(
            line,
            detail.tag,
            along_m,
            name=name,
            offset_m=marker.offset_m,
            meaning=detail.meaning,
            installation=self.plan.rules.installation,
        )
        return self._sheets(layout, marker)

    def _line_sheets(self, stretch: Sequence[PlannedMarker]) -> Iterator[tuple[str, bytes]]:
        first = stretch[0]
        assert isinstance(first.detail, PlannedLineMagnet)
        points = [(marker.lon_deg, marker.lat_deg) for marker in stretch]
        line = LaneLine.from_lon_lat(points, first.height_m or 0.0)
        style = LineStyle.SOLID if first.detail.tag.style is LineStyle.SOLID else LineStyle.DASHED
        layout = place_line(
            line,
            style,
            name=f"line-{first.number:05d}",
            spacing_m=spacing_of(line),
            installation=self.plan.rules.installation,
        )
        return self._sheets(layout, first)

    def _sheets(self, layout: MagnetLayout, marker: PlannedMarker) -> Iterator[tuple[str, bytes]]:
        lane = self.plan.alignment.lane(marker.lane)
        site = Site(
            design_speed_m_s=float(lane.value_at(lane.design_speed_m_s, marker.chainage_m)),
            wheel_circumference_m=self.plan.rules.vehicles.wheel_circumference_m,
        )
        sheet = drilling_sheet(layout, site)
        folder = "surface" if layout.installation.on_surface else "drilling"
        for form in (SheetFormat.PDF, SheetFormat.CSV):
            yield f"{folder}/{layout.name}.{form}", write_sheet(sheet, form)
