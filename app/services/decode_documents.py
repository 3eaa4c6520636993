"""Decodes as clients see them. Built by hand: a long drive has thousands of readings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import sqlalchemy as sa

from app import __version__
from app.decoders.images import ImageHeader
from app.decoders.plate import DECODER_VERSION
from app.errors import WaymarkError
from app.markers.plate import PlateScheme
from app.markers.reading import PlateOutcome, PlateReading
from app.services.fixes import Fix
from app.services.matching import Match

DECODER = f"waymark {__version__} {DECODER_VERSION}"


@dataclass(frozen=True, slots=True)
class ReadPlate:
    """One candidate of a frame with what the registry made of it."""

    reading: PlateReading
    match: Match | None = None
    fix: Fix | None = None


@dataclass(frozen=True, slots=True)
class ReadFrame:
    """One frame: its plates and fix, or why it could not be read."""

    index: int
    name: str | None = None
    header: ImageHeader | None = None
    plates: tuple[ReadPlate, ...] = ()
    fix: Fix | None = None
    error: WaymarkError | None = None
    load_ms: float = 0.0
    decode_ms: float = 0.0


def decode_document(row: Mapping[str, Any] | sa.RowMapping) -> dict[str, Any]:
    """A decode with its result."""
    result = row.get("result") or {}
    head = f"/v1/decodes/{row['id']}"
    return {
        "id": row["id"],
        "state": row["state"],
        "kind": row["kind"],
        "progress": row["progress"],
        "attempts": row["attempts"],
        "created_at": row["created_at"],
        "finished_at": row["finished_at"],
        "context": row["context"],
        "error": row["error"],
        **result,
        "links": {"self": head, **_links(head, row["kind"], result)},
    }


def _links(head: str, kind: str, result: Mapping[str, Any]) -> dict[str, str]:
    if kind == "trace":
        return {"plot": f"{head}/plot.svg"}
    if kind == "packets":
        overlay = {"overlay": f"{head}/overlay.jpg"} if result.get("overlay") else {}
        return {"plot": f"{head}/plot.svg", "lane": f"{head}/lane.geojson", **overlay}
    return {"annotated": f"{head}/annotated.jpg"}


def result_document(frames: Sequence[ReadFrame], *, codebook_plates: int) -> dict[str, Any]:
    """What a decode found, as it is stored."""
    readings = [{"frame": frame.index, **_reading(plate)} for frame in frames for plate in frame.plates]
    return {
        "decoder": DECODER,
        "codebook_plates": codebook_plates,
        "summary": _summary(frames),
        "readings": readings,
        "fix": fix_document(frames[0].fix) if len(frames) == 1 else None,
        "frames": [_frame(frame) for frame in frames],
    }


def error_document(error: WaymarkError) -> dict[str, Any]:
    """An error as part of a result."""
    parts = {"detail": error.message, "field": error.field, "limit": error.limit, "cure": error.cure}
    return {"kind": type(error).__name__, **{name: value for name, value in parts.items() if value is not None}}


def fix_document(fix: Fix | None) -> dict[str, Any] | None:
    """A vehicle's position; the covariance is of east, north, up [m] and heading [rad]."""
    if fix is None:
        return None
    sigma = np.sqrt(np.diag(fix.vehicle.covariance))
    return {
        "lon_deg": float(fix.vehicle.lon_deg),
        "lat_deg": float(fix.vehicle.lat_deg),
        "height_m": float(fix.vehicle.height_m) if fix.has_height else None,
        "heading_deg": float(fix.vehicle.heading_deg),
        "covariance": fix.vehicle.covariance.tolist(),
        "sigma": {
            "east_m": float(sigma[0]),
            "north_m": float(sigma[1]),
            "up_m": float(sigma[2]) if fix.has_height else None,
            "heading_deg": float(np.degrees(sigma[3])),
        },
        "localization_grade": str(fix.grade),
        "notes": list(fix.notes),
        "marker_ids": list(fix.marker_ids),
    }


def _summary(frames: Sequence[ReadFrame]) -> dict[str, Any]:
    plates = [plate for frame in frames for plate in frame.plates]
    read = [plate for plate in plates if plate.reading.outcome is PlateOutcome.READ]
    matched = [plate for plate in read if plate.match is not None and plate.match.row is not None]
    failed = sum(frame.error is not None for frame in frames)
    outcomes: dict[str, int] = {}
    for plate in plates:
        outcome = str(plate.reading.outcome)
        outcomes[outcome] = outcomes.get(outcome, 0) + 1
    refused = len(plates) - len(read)
    text = f"{count_of(len(read), 'plate')} read" if read else "no plate read"
    text += f" in {count_of(len(frames), 'frame')}, {len(matched)} of them registered" if read else ""
    text += f"; {count_of(refused, 'candidate')} refused" if refused else ""
    text += f"; {count_of(failed, 'frame')} could not be decoded" if failed else ""
    return {
        "text": text,
        "frames": len(frames),
        "frames_failed": failed,
        "plates_read": len(read),
        "plates_matched": len(matched),
        "fixes": sum(frame.fix is not None for frame in frames),
        "outcomes": outcomes,
    }


def count_of(number: int, what: str) -> str:
    """So many of something, in words."""
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def _frame(frame: ReadFrame) -> dict[str, Any]:
    header = frame.header
    return {
        "frame": frame.index,
        "name": frame.name,
        "error": error_document(frame.error) if frame.error else None,
        "width_px": header.width_px if header else None,
        "height_px": header.height_px if header else None,
        "format": str(header.kind) if header else None,
        "orientation": header.orientation if header else None,
        "ignored_trailing_bytes": header.trailing_bytes if header else 0,
        "load_ms": round(frame.load_ms, 3),
        "decode_ms": round(frame.decode_ms, 3),
        "readings": len(frame.plates),
        "fix": fix_document(frame.fix),
    }


def _reading(plate: ReadPlate) -> dict[str, Any]:
    reading, code, geometry = plate.reading, plate.reading.code, plate.reading.geometry
    grade, pose = reading.grade, reading.pose
    return {
        "outcome": str(reading.outcome),
        "reason": reading.reason or None,
        "digits": reading.digits,
        "scheme": str(code.scheme) if code else None,
        "registry_number": code.registry_number if code and code.scheme is PlateScheme.ID else None,
        "confidence": float(reading.confidence),
        "cell_confidence": [round(float(value), 6) for value in reading.cell_confidence],
        "corrected_cells": [int(cell) for cell in reading.corrected_cells],
        "from_codebook": bool(reading.from_codebook),
        "corners_px": _rounded(reading.corners_px, 3),
        "corner_sigma_px": _corner_sigma_px(reading.corners_covariance_px2),
        "height_px": round(float(reading.height_px), 2),
        "width_px": round(float(reading.width_px), 2),
        "geometry": {"n": geometry.n, "unit_mm": geometry.unit_mm, "gap_mm": geometry.gap_mm} if geometry else None,
        "grade": {
            "letter": grade.letter,
            "overall": float(grade.overall),
            "contrast": float(grade.contrast),
            "modulation": float(grade.modulation),
            "fixed_pattern": float(grade.fixed_pattern),
            "axial_nonuniformity": float(grade.axial_nonuniformity),
            "grid_nonuniformity": float(grade.grid_nonuniformity),
            "unused_correction": float(grade.unused_correction),
        }
        if grade
        else None,
        "pose": {
            "rotation": pose.rotation.tolist(),
            "translation_m": pose.translation_m.tolist(),
            "covariance": pose.covariance.tolist(),
            "reprojection_rms_px": float(pose.reprojection_rms_px),
        }
        if pose
        else None,
        "match": _match(plate.match),
        "fix": fix_document(plate.fix),
    }


def _match(match: Match | None) -> dict[str, Any] | None:
    if match is None:
        return None
    row = match.row
    return {
        "registered": row is not None,
        "marker_id": row["id"] if row is not None else None,
        "status": row["status"] if row is not None else None,
        "localization_grade": row["localization_grade"] if row is not None else None,
        "lon_deg": match.lon_deg,
        "lat_deg": match.lat_deg,
        "distance_m": round(match.distance_m, 3) if match.distance_m is not None else None,
        "plausible": match.plausible,
        "ambiguous": match.ambiguous,
        "other_marker_ids": list(match.others),
        "note": match.note or None,
    }


def _rounded(values: npt.NDArray[np.float64] | None, places: int) -> list[list[float]] | None:
    return None if values is None else np.round(values, places).tolist()


def _corner_sigma_px(covariance: npt.NDArray[np.float64] | None) -> float | None:
    return None if covariance is None else float(np.sqrt(np.trace(covariance) / len(covariance)))
