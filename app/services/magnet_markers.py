"""Magnet markers: which tag, where its magnets go, and that they keep clear of the others."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from datetime import datetime
from typing import Any

import sqlalchemy as sa

from app.encoders.magnet import Site
from app.errors import CodeMismatch, InvalidParameter
from app.markers.magnet import InformationTag, LineStyle, LineTag, Tag, parse_tag
from app.markers.magnet_codebook import Meaning
from app.registry import codebooks
from app.registry.database import Database
from app.registry.ids import new_id
from app.registry.magnets import replace_magnets
from app.registry.markers import Row
from app.services.access import Caller
from app.services.codebook_documents import book_of
from app.services.magnet_layouts import (
    INFORMATION_TAG,
    LINE_TAG,
    GivenLane,
    PlacedLine,
    PlacedTag,
    check_never_broken,
    lane_spec,
    layout_of,
    place_lane,
    resurveyed,
    sheet_of,
    worst_grade,
)
from app.services.magnet_neighbours import find_neighbours
from app.services.marker_documents import magnet_detail, magnet_document
from app.services.marker_rules import PLANNED, MarkerRules, is_back_in_use
from app.services.positions import naming, position_columns


@dataclass(frozen=True, slots=True)
class GivenTag:
    """An information tag as it was asked for: by its text, or by what it means in a codebook."""

    place: PlacedTag
    code: str | None = None
    codebook_id: str | None = None
    meaning: tuple[str, float | str] | None = None


@dataclass(frozen=True, slots=True)
class GivenLine:
    """A line of line tags as it was asked for."""

    place: PlacedLine
    style: LineStyle


@dataclass(frozen=True, slots=True)
class NewMagnets:
    """A tag or a line of magnets to register."""

    lane: GivenLane
    what: GivenTag | GivenLine
    site: dict[str, Any] = field(default_factory=dict)
    status: str = PLANNED
    heading_rmse_deg: float | None = None
    road: str | None = None
    measure_m: float | None = None
    offset_m: float | None = None
    kind: str | None = None
    reason: str | None = None


class Magnets:
    """The family of magnet markers.

    Parameters
    ----------
    database : Database
        Asked for codebooks before a transaction begins; what is in a book never changes.
    rules : MarkerRules
    """

    def __init__(self, database: Database, rules: MarkerRules) -> None:
        self._database = database
        self._rules = rules

    def prepare(self, caller: Caller, new: NewMagnets, now: datetime) -> dict[str, Any]:
        """Columns of a layout that breaks no limit by itself.

        Raises
        ------
        NotFound
            The codebook is not there.
        InvalidParameter, CodeMismatch, ReferenceSystemError
            The tag, the lane or the site cannot be, or magnets would stand too near or too far apart.
        """
        tag, meaning = self._tag(caller, new.what)
        placed = place_lane(new.lane, self._rules.crs_accuracy_m)
        with naming("site"):
            site = asdict(Site(**new.site))
        del site["neighbours"]
        spec: dict[str, Any] = {
            "kind": LINE_TAG if isinstance(tag, LineTag) else INFORMATION_TAG,
            "tag": tag.text,
            "codebook_id": new.what.codebook_id if isinstance(new.what, GivenTag) else None,
            "meaning": None if meaning is None else {"kind": meaning.kind.value, "value": meaning.value},
            "lane": lane_spec(new.lane, placed),
            "place": asdict(new.what.place),
            "site": site,
            "neighbours": [],
        }
        row = {"id": new_id(now), "spec": spec}
        layout, sheet = layout_of(row), sheet_of(row)
        check_never_broken(layout, sheet.checks)
        first = layout.holes[0]
        columns = position_columns(new.lane.provenance, worst_grade(placed))
        given = {name: value for name, value in spec["place"].items() if value is not None}
        return {
            **row,
            "family": "magnet",
            "scheme": spec["kind"],
            "digits": tag.text,
            **columns,
            "lon_deg": first.lon_deg,
            "lat_deg": first.lat_deg,
            "heading_deg": layout.bearing_deg % 360.0,
            "original": {**columns["original"], **given},
        }

    def columns(
        self, connection: sa.Connection, caller: Caller, new: NewMagnets, prepared: dict[str, Any]
    ) -> dict[str, Any]:
        """The columns, with the markers near by.

        Raises
        ------
        Conflict
            Magnets of another marker lie too near.
        """
        return {**prepared, "spec": self._with_neighbours(connection, caller, prepared)}

    def revised(
        self, connection: sa.Connection, caller: Caller, row: Row, values: dict[str, Any], *, moved: bool
    ) -> dict[str, Any]:
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
        revised = dict(row)
        if moved:
            revised["spec"] = resurveyed(row, values["lon_deg"], values["lat_deg"])
        elif not is_back_in_use(row, values):
            return {}
        revised["spec"] = self._with_neighbours(connection, caller, revised)
        return {"spec": revised["spec"], "heading_deg": layout_of(revised).bearing_deg % 360.0}

    def index(self, connection: sa.Connection, caller: Caller, row: Row) -> None:
        """Keep where each magnet lies."""
        holes = [
            {
                "number": hole.number,
                "lon_deg": hole.lon_deg,
                "lat_deg": hole.lat_deg,
                "polarity": hole.polarity.value,
                "phi_deg": hole.orientation.phi_deg,
            }
            for hole in layout_of(row).holes
        ]
        replace_magnets(connection, caller.agency_id, row["id"], holes)

    def document(self, row: Row | dict[str, Any]) -> dict[str, Any]:
        """A magnet marker without its magnets."""
        return magnet_document(row)

    def detail(self, row: Row | dict[str, Any]) -> dict[str, Any]:
        """A magnet marker with its lane, its magnets, what was checked and what it costs."""
        return magnet_detail(row, sheet_of(row))

    def _tag(self, caller: Caller, what: GivenTag | GivenLine) -> tuple[Tag, Meaning | None]:
        if isinstance(what, GivenLine):
            return LineTag.of_style(what.style), None
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
        with self._database.read() as connection:
            book = book_of(codebooks.get_codebook(connection, caller.agency_id, what.codebook_id))
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
        with naming("tag.meaning"):
            meaning = Meaning(*what.meaning)  # type: ignore[arg-type]
        found = book.find_tag(meaning)
        if found is None:
            raise InvalidParameter(
                f"{meaning.text} has no code in the codebook {book.name}",
                field="tag.meaning",
                limit=f"one of its {len(book.entries)} meanings",
                cure="add the meaning to the codebook first",
            )
        return found, meaning

    def _with_neighbours(self, connection: sa.Connection, caller: Caller, row: dict[str, Any]) -> dict[str, Any]:
        neighbours = find_neighbours(connection, caller.agency_id, layout_of(row), ignoring=row["id"])
        return {
            **row["spec"],
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
