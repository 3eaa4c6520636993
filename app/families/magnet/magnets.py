"""The family of magnet markers: which tag, where its magnets go, and that they keep clear of the others."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from datetime import datetime
from typing import Any

import numpy as np
import scipy
import sqlalchemy as sa

from app.encoders.magnet import MagnetLayout, SheetFormat, write_sheet
from app.errors import CodeMismatch, Conflict, InvalidParameter, naming
from app.families.documents import position_columns
from app.families.family import Family, Registration
from app.families.magnet.documents import MagnetDetailDocument, MagnetDocument, magnet_detail, magnet_document
from app.families.magnet.layouts import (
    LINE_TAG,
    MAGNET_EXAMPLES,
    MAX_MAGNETS,
    LaneIn,
    LineIn,
    LineStringIn,
    MagnetIn,
    TagIn,
    check_never_broken,
    lane_spec,
    layout_of,
    place_lane,
    resurveyed,
    sheet_of,
    worst_grade,
)
from app.families.surveys import PLAN_METHOD, ColumnValues, Commitment, MarkerRules, PlannedRow, is_placed_again
from app.markers.magnet import MIN_GAP_M, InformationTag, LineStyle, LineTag, Orientation, Tag, parse_tag
from app.markers.magnet_design import INFORMATION_TAG, MagnetSpec, Meaning
from app.markers.reading import MarkerRow
from app.planning.magnet_checks import HALF_BAR_M, Neighbour
from app.planning.magnet_stretches import even_stretches, lane_around, spacing_of
from app.planning.outputs.hd_map import MapMarker
from app.planning.plan import PlannedLineMagnet, PlannedMarker, PlannedTag
from app.registry.column_types import new_id
from app.registry.lines import MagnetLines
from app.registry.marker_rows import markers
from app.registry.markers import CODEBOOKS, MagnetRow, book_of, list_magnets_in, replace_magnets
from app.registry.spatial import Box, box_around
from app.roads.lane_line import LaneLine, bearing_deg

# === Magnets of other markers near a layout: too near is a conflict, near is a check's warning.


NEAR_M = HALF_BAR_M + MIN_GAP_M
"""Beyond it no check of a layout asks. [m]"""
_TOLERANCE_M = 0.0005
_HOLES_IN_A_BOX = 20
_STRANGER = "a marker of another agency"


def find_neighbours(
    connection: sa.Connection, agency_id: str, layout: MagnetLayout, *, ignoring: str
) -> tuple[Neighbour, ...]:
    """The nearest magnet nearby of each orientation; names of other agencies' markers are kept back.

    Raises
    ------
    Conflict
        It is so near that the fields of both would be read as one.
    """
    rows = _list_near(connection, layout, ignoring)
    if not rows:
        return ()
    holes = scipy.spatial.cKDTree([hole.point_enu_m[:2] for hole in layout.holes])
    points = [layout.lane.from_position(row.lon_deg, row.lat_deg)[:2] for row in rows]
    distances_m = np.asarray(holes.query(np.array(points))[0], dtype=np.float64)
    nearest: dict[int, tuple[float, MagnetRow]] = {}
    for distance_m, row in zip(distances_m.tolist(), rows, strict=True):
        if distance_m < nearest.get(row.phi_deg, (NEAR_M, row))[0]:
            nearest[row.phi_deg] = (distance_m, row)
    for distance_m, row in nearest.values():
        if distance_m < MIN_GAP_M - _TOLERANCE_M:
            raise Conflict(
                f"a magnet would lie {distance_m:.3f} m from one of {_name(row, agency_id)}",
                field="lane",
                limit=f"{MIN_GAP_M:g} m between magnets: METRO figure 17a",
                cure="choose another chainage or offset, or retire the other marker",
            )
    return tuple(
        Neighbour(_name(row, agency_id), row.lon_deg, row.lat_deg, Orientation(row.phi_deg))
        for _, (_, row) in sorted(nearest.items())
    )


def _name(row: MagnetRow, agency_id: str) -> str:
    return f"marker {row.marker_id}" if row.agency_id == agency_id else _STRANGER


def _list_near(connection: sa.Connection, layout: MagnetLayout, ignoring: str) -> list[MagnetRow]:
    """Magnets in boxes around a few holes each: one box around a long line would hold a town."""
    found: dict[int, MagnetRow] = {}
    for start in range(0, len(layout.holes), _HOLES_IN_A_BOX):
        holes = layout.holes[start : start + _HOLES_IN_A_BOX]
        for row in list_magnets_in(
            connection, _box(holes[0].lon_deg, [(h.lon_deg, h.lat_deg) for h in holes]), ignoring=ignoring
        ):
            found[row.row] = row
    return list(found.values())


def _box(around_deg: float, places: list[tuple[float, float]]) -> Box:
    """Box around a few places near each other, over the antimeridian too."""
    boxes = [box_around(lon, lat, NEAR_M) for lon, lat in places]
    south, north = min(box.south_deg for box in boxes), max(box.north_deg for box in boxes)
    if any(box.east_deg - box.west_deg == 360.0 for box in boxes):  # at a pole
        return Box(-180.0, south, 180.0, north)

    def turned(lon_deg: float) -> float:
        return (lon_deg - around_deg + 180.0) % 360.0 - 180.0

    west = min(turned(box.west_deg) for box in boxes) + around_deg
    east = max(turned(box.east_deg) for box in boxes) + around_deg
    wrapped = [(lon + 180.0) % 360.0 - 180.0 for lon in (west, east)]
    return Box(wrapped[0], south, wrapped[1], north)


# === Magnets in HD maps: each magnet of a tag or of a line is one point.


def magnets_of_map(row: MarkerRow) -> list[MapMarker]:
    """The magnets of a marker; the height that was surveyed is that of the first one, and holds for a tag only."""
    layout = layout_of(row.id, row.spec)
    is_line = isinstance(layout.tag, LineTag)
    kind, height_m = ("line", None) if is_line else ("information", row.height_m)
    found = []
    for hole in layout.holes:
        bearing = bearing_deg(layout.lane.direction_at(hole.chainage_m)) if is_line else layout.bearing_deg % 360.0
        place, name = (hole.lon_deg, hole.lat_deg, height_m, bearing), f"{row.id}.{hole.number}"
        found.append(MapMarker(name, row.family, row.digits, *place, kind, vertical_datum=row.vertical_datum))
    return found


# === Columns of a marker that is a tag or a line of magnets.


def magnet_columns(new: MagnetIn, tag: Tag, meaning: Meaning | None, rules: MarkerRules, now: datetime) -> ColumnValues:
    """Columns of a tag or a line of magnets that breaks no limit by itself.

    Raises
    ------
    InvalidParameter, ReferenceSystemError
        The lane or the site cannot be, or magnets would stand too near or too far apart.
    """
    placed = place_lane(new.lane, rules.crs_accuracy_m)
    marker_id = new_id(now)
    spec: MagnetSpec = {
        "kind": LINE_TAG if isinstance(tag, LineTag) else INFORMATION_TAG,
        "tag": tag.text,
        "codebook_id": None if new.tag is None else new.tag.codebook_id,
        "meaning": None if meaning is None else {"kind": meaning.kind.value, "value": meaning.value},
        "lane": lane_spec(new.lane, placed),
        "place": new.place,
        "site": asdict(new.site),
        "neighbours": [],
        "installation": asdict(new.installation),
    }
    layout, sheet = layout_of(marker_id, spec), sheet_of(marker_id, spec)
    check_never_broken(layout, sheet.checks)
    first = layout.holes[0]
    columns = position_columns(new.lane, worst_grade(placed))
    placed_at = {name: value for name, value in spec["place"].items() if value is not None}
    return {
        "id": marker_id,
        "spec": spec,
        "family": "magnet",
        "scheme": spec["kind"],
        "digits": tag.text,
        **columns,
        "lon_deg": first.lon_deg,
        "lat_deg": first.lat_deg,
        "heading_deg": layout.bearing_deg % 360.0,
        "original": {**columns["original"], **placed_at},
    }


# === Planned magnets as rows of the registry: a tag is a marker, and so is a line of magnets at even distances.


def _planned_tag(commitment: Commitment, marker: PlannedMarker, detail: PlannedTag) -> PlannedRow:
    lon, lat, along_m = lane_around(commitment.alignment.lane(marker.lane), marker)
    tag = TagIn(code=detail.tag.text, codebook_id=commitment.codebook_id, chainage_m=along_m, offset_m=marker.offset_m)
    lane = _planned_lane(commitment, np.column_stack([lon, lat]).tolist(), marker.height_m)
    new = MagnetIn(family="magnet", lane=lane, tag=tag, installation=commitment.installation)
    columns = magnet_columns(new, detail.tag, detail.meaning, commitment.rules, commitment.now)
    return PlannedRow(marker.number, columns | commitment.on_road(marker) | {"original": commitment.original(marker)})


def _planned_line(commitment: Commitment, stretch: Sequence[PlannedMarker]) -> PlannedRow:
    detail, height_m = stretch[0].detail, stretch[0].height_m
    assert isinstance(detail, PlannedLineMagnet)
    points = [[marker.lon_deg, marker.lat_deg] for marker in stretch]
    spacing_m = spacing_of(LaneLine.from_lon_lat(points, height_m or 0.0))
    style = LineStyle.SOLID if detail.tag.style is LineStyle.SOLID else LineStyle.DASHED
    lane, line = _planned_lane(commitment, points, height_m), LineIn(spacing_m=spacing_m, style=style)
    new = MagnetIn(family="magnet", lane=lane, line=line, installation=commitment.installation)
    columns = magnet_columns(new, detail.tag, None, commitment.rules, commitment.now)
    columns |= commitment.on_road(stretch[0]) | {"original": commitment.original(stretch[0])}
    return PlannedRow(stretch[0].number, columns, len(stretch))


def _planned_lane(commitment: Commitment, points_deg: list[list[float]], height_m: float | None) -> LaneIn:
    road = commitment.alignment
    return LaneIn(
        geometry=LineStringIn(type="LineString", coordinates=points_deg),
        height_m=height_m,
        realization=road.realization,
        epoch=road.epoch,
        vertical_datum=road.vertical_datum if height_m is not None else None,
        survey_method=PLAN_METHOD,
    )


# === The family of magnet markers.


class Magnets(Family[MagnetIn, ColumnValues]):
    """The family of magnet markers."""

    name = "magnet"
    label = "magnet marker"
    title = "Magnets"
    schema = MagnetIn
    examples = MAGNET_EXAMPLES
    has_index = True
    sheet_version = 2
    lines = MagnetLines()
    document_type = MagnetDocument
    detail_type = MagnetDetailDocument

    def prepare(self, registration: Registration, new: MagnetIn) -> ColumnValues:
        """Columns of a layout that breaks no limit by itself.

        Raises
        ------
        NotFound
            The codebook is not there.
        InvalidParameter, CodeMismatch, ReferenceSystemError
            The tag, the lane or the site cannot be, or magnets would stand too near or too far apart.
        """
        tag, meaning = _find_tag(registration, new)
        return magnet_columns(new, tag, meaning, registration.rules, registration.now)

    def columns(
        self, connection: sa.Connection, registration: Registration, new: MagnetIn, prepared: ColumnValues
    ) -> ColumnValues:
        """The columns, with the markers nearby.

        Raises
        ------
        Conflict
            Magnets of another marker lie too near.
        """
        return {
            **prepared,
            "spec": _with_neighbours(connection, registration.agency_id, prepared["id"], prepared["spec"]),
        }

    def revise(
        self, connection: sa.Connection, registration: Registration, row: MarkerRow, values: ColumnValues
    ) -> ColumnValues:
        """Columns of the layout after the survey of a tag, or back in use.

        Raises
        ------
        InvalidParameter
            The heading is to be changed, or the place of a line, or a tag was found too far from its layout.
        Conflict
            Magnets of another marker lie too near.
        """
        if "heading_deg" in values:
            raise InvalidParameter(
                "the heading of magnets follows from their lane",
                field="heading_deg",
                limit="no heading",
                cure="leave heading_deg out",
            )
        if not is_placed_again(row, values):
            return {}
        spec = resurveyed(row, values["lon_deg"], values["lat_deg"]) if "lon_deg" in values else row.spec
        spec = _with_neighbours(connection, registration.agency_id, row.id, spec)
        return {"spec": spec, "heading_deg": layout_of(row.id, spec).bearing_deg % 360.0}

    def index(self, connection: sa.Connection, agency_id: str, row: MarkerRow) -> None:
        """Store where each magnet lies."""
        holes = [
            {
                "number": hole.number,
                "lon_deg": hole.lon_deg,
                "lat_deg": hole.lat_deg,
                "polarity": hole.polarity.value,
                "phi_deg": hole.orientation.phi_deg,
            }
            for hole in layout_of(row.id, row.spec).holes
        ]
        replace_magnets(connection, agency_id, row.id, holes)

    def feature_members(self, properties: Mapping[str, object]) -> dict[str, object]:
        """Refuse a point: magnets are placed along a lane."""
        raise InvalidParameter(
            "magnets need a lane, which a point does not have",
            field="properties.family",
            limit="families whose markers are points",
            cure="register magnets at /v1/markers",
        )

    def document(self, row: MarkerRow) -> MagnetDocument:
        """A magnet marker without its magnets."""
        return magnet_document(row)

    def detail(self, row: MarkerRow) -> MagnetDetailDocument:
        """A magnet marker with its lane, its magnets, its checks and its costs."""
        return magnet_detail(row, sheet_of(row.id, row.spec))

    def map_markers(self, row: MarkerRow) -> Sequence[MapMarker]:
        """Each magnet."""
        return magnets_of_map(row)

    def write_sheet(self, row: MarkerRow, form: SheetFormat) -> bytes:
        """Where the magnets of a layout go."""
        return write_sheet(sheet_of(row.id, row.spec), form)

    def planned_rows(self, commitment: Commitment, markers: Sequence[PlannedMarker]) -> Iterator[PlannedRow]:
        """One row for each tag, and one for each stretch of a line."""
        for marker in markers:
            if isinstance(marker.detail, PlannedTag):
                yield _planned_tag(commitment, marker, marker.detail)
        for stretch in even_stretches(markers, MAX_MAGNETS):
            yield _planned_line(commitment, stretch)

    def snapshot_columns(self) -> tuple[sa.ColumnElement[Any], ...]:
        """Where the lane begins, and the meaning."""
        spec = markers.c.spec
        lane_start = spec["lane"]["points_deg"][0]
        return (
            lane_start[0].as_float().label("lane_lon_deg"),
            lane_start[1].as_float().label("lane_lat_deg"),
            spec["meaning"].label("meaning"),
        )

    def snapshot_kind(self, row: MarkerRow) -> dict[str, object]:
        """Scheme and meaning."""
        return {"scheme": row.scheme, "meaning": row.spec["meaning"]}


MAGNET = Magnets()


def _find_tag(registration: Registration, new: MagnetIn) -> tuple[Tag, Meaning | None]:
    if new.line is not None:
        return LineTag.of_style(new.line.style), None
    what = new.tag
    assert what is not None
    if (what.code is None) == (what.meaning is None) or (what.meaning is not None and what.codebook_id is None):
        raise InvalidParameter(
            "a tag is named by its code, or by a meaning in a codebook",
            field="tag",
            limit="code, or codebook_id and meaning",
            cure="send one of the two; a code may also name the codebook that it must be in",
        )
    code = _information_tag(what.code) if what.code is not None else None
    if what.codebook_id is None:
        assert code is not None
        return code, None
    with registration.database.read() as connection:
        book = book_of(CODEBOOKS.get(connection, registration.agency_id, what.codebook_id))
    if code is not None:
        meaning = book.find_meaning(code)
        if meaning is None:
            raise CodeMismatch(
                f"{code.text} is not in the codebook {book.name}",
                field="tag.code",
                limit=f"one of its {len(book.entries)} codes",
                cure="leave codebook_id out, or choose a code of the book",
            )
        return code, meaning
    assert what.meaning is not None
    found = book.find_tag(what.meaning)
    if found is None:
        raise InvalidParameter(
            f"{what.meaning.text} has no code in the codebook {book.name}",
            field="tag.meaning",
            limit=f"one of its {len(book.entries)} meanings",
            cure="add the meaning to the codebook first",
        )
    return found, what.meaning


def _with_neighbours(connection: sa.Connection, agency_id: str, marker_id: str, spec: MagnetSpec) -> MagnetSpec:
    """The spec of a marker with the markers nearby."""
    neighbours = find_neighbours(connection, agency_id, layout_of(marker_id, spec), ignoring=marker_id)
    return {
        **spec,
        "neighbours": [
            {"name": n.name, "lon_deg": n.lon_deg, "lat_deg": n.lat_deg, "phi_deg": n.orientation.phi_deg}
            for n in neighbours
        ],
    }


def _information_tag(text: str) -> InformationTag:
    with naming("tag"):
        tag = parse_tag(text)
    if isinstance(tag, LineTag):
        raise InvalidParameter(
            f"{tag.text} is a line tag",
            field="tag.code",
            limit="an information tag",
            cure="send line with its style instead of tag",
        )
    return tag
