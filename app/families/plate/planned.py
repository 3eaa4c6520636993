"""Planned plates as rows of the registry."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from app.families.planned import Commitment, PlannedMarkers, PlannedRow
from app.markers.plate import PlateCode, PlateScheme
from app.planning.plan import PlannedMarker, PlannedPlate
from app.registry.marker_rows import CodeRow


class PlannedPlates(PlannedMarkers):
    """Scheme, digits and dimensions."""

    def taken_numbers(self, agency_id: str, known: Iterable[CodeRow]) -> set[int]:
        """A registry number names one plate of the whole server."""
        ids = [row for row in known if row.scheme == PlateScheme.ID]
        return {PlateCode(row.digits, PlateScheme.ID, row.n).registry_number for row in ids}

    def rows(self, commitment: Commitment, markers: Sequence[PlannedMarker]) -> Iterator[PlannedRow]:
        """One row for each plate."""
        for marker in markers:
            detail = marker.detail
            assert isinstance(detail, PlannedPlate)
            code, geometry = detail.code, detail.geometry
            checks = code.check_digits if code.scheme is PlateScheme.POSITION_CHECK else None
            columns = {
                **commitment.position(marker),
                "scheme": str(code.scheme),
                "digits": code.digits,
                "check_digits": checks,
                "digits_match_position": None if code.scheme is PlateScheme.ID else True,
                "n": geometry.n,
                "unit_mm": geometry.unit_mm,
                "gap_mm": geometry.gap_mm,
                "thickness_mm": geometry.thickness_mm,
            }
            yield PlannedRow(marker.number, columns)
