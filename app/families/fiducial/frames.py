"""Fiducial signs in camera frames: what is looked for, which registered sign a reading is of, and its document."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import sqlalchemy as sa
from typing_extensions import TypedDict

from app.decoders.fiducial import FiducialReading, decode_fiducials
from app.families.fiducial.rows import fiducial_code, known_fiducial
from app.families.frame_documents import PoseDocument, pose_document, rounded
from app.families.frames import ApproximatePosition, FrameReader, Match, Nearby, Pixels, nearest_match
from app.markers.fiducial import KnownFiducial
from app.sensors.camera import Camera


@dataclass(frozen=True, slots=True)
class FiducialSearch:
    """What to look for in a frame: the signs that the registry has near by, with the camera."""

    known: tuple[KnownFiducial, ...]
    camera: Camera | None = None


class FiducialReadingDocument(TypedDict):
    """A candidate sign in a frame and what was read from it."""

    outcome: str
    reason: str | None
    digits: str | None
    scheme: str | None
    confidence: float
    bit_errors: int
    contrast: float
    corners_px: list[list[float]]
    side_px: float
    pose: PoseDocument | None


class FiducialFrames(FrameReader[FiducialReading, FiducialSearch]):
    """Reads fiducial signs in frames, where the registry has some near by."""

    document_type = FiducialReadingDocument

    def search(self, nearby: Nearby, camera: Camera | None) -> FiducialSearch | None:
        """The signs near by; None without any: looking for them takes as long as looking for plates."""
        known = tuple(dict.fromkeys(known_fiducial(row) for row in nearby.rows))
        return FiducialSearch(known, camera) if known else None

    def read(self, pixels: Pixels, search: FiducialSearch, *, thermal: bool) -> Sequence[FiducialReading]:
        """Decode the signs of a frame; thermal frames show none."""
        return [] if thermal else decode_fiducials(pixels, known=search.known, camera=search.camera)

    def match(
        self,
        connection: sa.Connection,
        agency_id: str,
        reading: FiducialReading,
        position: ApproximatePosition | None,
        nearby: Nearby,
    ) -> Match | None:
        """The registered sign with the code that was read, nearest to the approximate position."""
        code = reading.code
        if code is None or position is None:
            return None
        rows = [row for row in nearby.rows if fiducial_code(row).text == code.text]
        if rows:
            return nearest_match(rows, position, "fiducial sign")
        return Match(None, note="no sign of this agency near by carries this code")

    def document(self, reading: FiducialReading) -> FiducialReadingDocument:
        """A reading as clients see it."""
        code = reading.code
        return {
            "outcome": str(reading.outcome),
            "reason": reading.reason or None,
            "digits": code.text if code else None,
            "scheme": code.dictionary if code else None,
            "confidence": float(reading.confidence),
            "bit_errors": int(reading.bit_errors),
            "contrast": round(float(reading.contrast), 1),
            "corners_px": rounded(reading.corners_px, 3) or [],
            "side_px": round(float(reading.side_px), 2),
            "pose": pose_document(reading.pose),
        }

    def observation(self, reading: FiducialReading) -> dict[str, Any]:
        """Confidence and errors."""
        return {"confidence": float(reading.confidence), "bit_errors": int(reading.bit_errors)}
