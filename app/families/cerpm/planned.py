"""Planned CERPMs as rows of the registry."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict

from app.families.cerpm.message import speed_limit_document
from app.families.planned import Commitment, PlannedMarkers, PlannedRow
from app.planning.plan import PlannedCerpm, PlannedMarker
from app.registry.marker_rows import CodeRow


class PlannedCerpms(PlannedMarkers):
    """Number, side, speed limit and radio."""

    def taken_numbers(self, agency_id: str, known: Iterable[CodeRow]) -> set[int]:
        """A number names one CERPM of its agency."""
        return {int(row.digits) for row in known if row.agency_id == agency_id}

    def rows(self, commitment: Commitment, markers: Sequence[PlannedMarker]) -> Iterator[PlannedRow]:
        """One row for each CERPM."""
        radio = asdict(commitment.radio)
        for marker in markers:
            detail = marker.detail
            assert isinstance(detail, PlannedCerpm)
            spec = {
                "side": detail.side.name.lower(),
                "speed_limit": speed_limit_document(detail.speed_limit),
                "dev_eui": None,
                "radio": radio,
            }
            columns = {
                **commitment.position(marker),
                "scheme": "cerpm",
                "digits": str(detail.number),
                "spec": spec,
            }
            yield PlannedRow(marker.number, columns)
