"""The family of fiducial signs: ArUco and AprilTag signs that agencies have in use."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import sqlalchemy as sa

from app.errors import CodeTaken, InvalidParameter
from app.families.family import Family, Registration, map_point
from app.families.fiducial.artwork import FiducialArtwork
from app.families.fiducial.documents import FiducialDocument, fiducial_document
from app.families.fiducial.frames import FiducialFrames
from app.families.fiducial.inputs import FIDUCIAL_EXAMPLES, FiducialIn
from app.families.fiducial.registration import NewFiducial
from app.families.fiducial.rows import fiducial_geometry
from app.families.fiducial.snapshot import FiducialSnapshot
from app.families.fiducial.survey import FiducialSurvey
from app.families.positions import place_input, position_columns
from app.families.rules import is_placed_anew
from app.geodesy import PlacedPosition
from app.markers.fiducial import Mounting
from app.planning.outputs.hd_map import MapMarker
from app.registry import markers as store
from app.registry.marker_rows import MarkerRow


class Fiducials(Family[NewFiducial, PlacedPosition]):
    """The family of fiducial signs."""

    name = "fiducial"
    label = "fiducial sign"
    title = "Fiducial signs"
    schema = FiducialIn
    examples = FIDUCIAL_EXAMPLES
    snapshot = FiducialSnapshot()
    survey = FiducialSurvey()
    artwork = FiducialArtwork()
    frames = FiducialFrames()
    document_type = FiducialDocument
    detail_type = FiducialDocument

    def prepare(self, registration: Registration, new: NewFiducial) -> PlacedPosition:
        """The sign's place in WGS 84."""
        return place_input(new.position, registration.rules.crs_accuracy_m)

    def columns(
        self, connection: sa.Connection, registration: Registration, new: NewFiducial, prepared: PlacedPosition
    ) -> dict[str, Any]:
        """Code, dimensions and place.

        Raises
        ------
        CodeTaken
            Another sign near by carries the code.
        """
        _check_free(connection, registration, new.code.text, prepared.lon_deg, prepared.lat_deg)
        geometry = new.geometry
        return {
            "family": self.name,
            "scheme": new.code.dictionary,
            "digits": new.code.text,
            "heading_deg": new.heading_deg,
            "spec": {
                "side_mm": geometry.side_mm,
                "quiet_mm": geometry.quiet_mm,
                "mounting": str(geometry.mounting),
            },
            **position_columns(new.position, prepared),
        }

    def revise(
        self, connection: sa.Connection, registration: Registration, row: MarkerRow, values: dict[str, Any]
    ) -> dict[str, Any]:
        """Nothing changes but the place, where the code must be free.

        Raises
        ------
        CodeTaken
            At its new place, or back in use, another sign near by carries the code.
        """
        if is_placed_anew(row, values):
            merged = row._replace(**values)
            _check_free(connection, registration, row.digits, merged.lon_deg, merged.lat_deg, row.id)
        return {}

    def feature_members(self, properties: Mapping[str, Any]) -> dict[str, Any]:
        """Refuse a point: its properties do not say how large the sign is."""
        raise InvalidParameter(
            "a sign needs the size of its border, which a point does not have",
            field="properties.family",
            limit="families whose markers are points",
            cure="register signs at /v1/markers",
        )

    def document(self, row: MarkerRow) -> FiducialDocument:
        """A sign."""
        return fiducial_document(row)

    def map_markers(self, row: MarkerRow) -> Sequence[MapMarker]:
        """The square of its border, upright or on the road."""
        geometry = fiducial_geometry(row)
        upright = geometry.mounting is Mounting.UPRIGHT
        return (map_point(row, kind=row.scheme, side_m=geometry.side_mm / 1000, upright=upright),)


FIDUCIAL = Fiducials()


def _check_free(
    connection: sa.Connection,
    registration: Registration,
    text: str,
    lon_deg: float,
    lat_deg: float,
    ignoring: str | None = None,
) -> None:
    """Refuse a code that another sign near by carries: a vehicle between them could not say which one it sees."""
    radius_m = registration.rules.position_code_radius_m
    other = store.find_code_near(
        connection, text, lon_deg, lat_deg, radius_m, mismatched_radius_m=radius_m, ignoring=ignoring
    )
    if other is None:
        return
    own = other.agency_id == registration.agency_id
    raise CodeTaken(
        f"the code {text} is taken by {'marker ' + other.id if own else 'a marker of another agency'}",
        field="code.number",
        limit=f"no two signs with the same code within {radius_m:g} m",
        cure="choose another number, or retire the other sign",
    )
