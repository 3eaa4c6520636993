"""The family of magnet markers: which tag, where its magnets go, and that they keep clear of the others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import sqlalchemy as sa

from app.encoders.magnet import write_sheet
from app.errors import CodeMismatch, InvalidParameter, naming
from app.families.family import Family, Registration
from app.families.files import MarkerSheet
from app.families.magnet.columns import magnet_columns
from app.families.magnet.documents import MagnetDetailDocument, MagnetDocument, magnet_detail, magnet_document
from app.families.magnet.inputs import MAGNET_EXAMPLES, MagnetIn
from app.families.magnet.layouts import (
    layout_of,
    resurveyed,
    sheet_of,
)
from app.families.magnet.map_markers import magnets_of_map
from app.families.magnet.neighbours import find_neighbours
from app.families.magnet.planned import PlannedMagnets
from app.families.magnet.registration import LineInput, NewMagnets, TagInput
from app.families.magnet.snapshot import MagnetSnapshot
from app.families.magnet.spec import MagnetSpec
from app.families.rules import is_placed_anew
from app.markers.magnet import InformationTag, LineTag, Tag, parse_tag
from app.markers.magnet_codebook import Meaning
from app.planning.outputs.hd_map import MapMarker
from app.registry.codebooks import CODEBOOKS, book_of
from app.registry.magnet_lines import MagnetLines
from app.registry.magnets import replace_magnets
from app.registry.marker_rows import MarkerRow


class Magnets(Family[NewMagnets, dict[str, Any]]):
    """The family of magnet markers."""

    name = "magnet"
    label = "magnet marker"
    title = "Magnets"
    schema = MagnetIn
    examples = MAGNET_EXAMPLES
    snapshot = MagnetSnapshot()
    lines = MagnetLines()
    planned = PlannedMagnets()
    sheet = MarkerSheet(1, lambda row, form: write_sheet(sheet_of(row.id, row.spec), form))
    document_type = MagnetDocument
    detail_type = MagnetDetailDocument

    def prepare(self, registration: Registration, new: NewMagnets) -> dict[str, Any]:
        """Columns of a layout that breaks no limit by itself.

        Raises
        ------
        NotFound
            The codebook is not there.
        InvalidParameter, CodeMismatch, ReferenceSystemError
            The tag, the lane or the site cannot be, or magnets would stand too near or too far apart.
        """
        tag, meaning = _find_tag(registration, new.what)
        return magnet_columns(new, tag, meaning, registration.rules, registration.now)

    def columns(
        self, connection: sa.Connection, registration: Registration, new: NewMagnets, prepared: dict[str, Any]
    ) -> dict[str, Any]:
        """The columns, with the markers near by.

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
        self, connection: sa.Connection, registration: Registration, row: MarkerRow, values: dict[str, Any]
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
        if not is_placed_anew(row, values):
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

    def feature_members(self, properties: Mapping[str, Any]) -> dict[str, Any]:
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


MAGNET = Magnets()


def _find_tag(registration: Registration, what: TagInput | LineInput) -> tuple[Tag, Meaning | None]:
    if isinstance(what, LineInput):
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


def _with_neighbours(connection: sa.Connection, agency_id: str, marker_id: str, spec: MagnetSpec) -> MagnetSpec:
    """The spec of a marker with the markers near by."""
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
