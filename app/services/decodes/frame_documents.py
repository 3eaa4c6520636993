"""Decoded frames as clients see them. Built by hand: a long drive has thousands of readings."""

from __future__ import annotations

import types
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from typing import TYPE_CHECKING, Any

import numpy as np
from typing_extensions import TypedDict

from app import __version__
from app.decoders.plate import DECODER_VERSION, PAPER_VERSION
from app.decoding.frames import Fix, Match
from app.errors import WaymarkError
from app.families import get_family, union_of_documents
from app.families.family import FrameReading
from app.families.plate.plates import PLATE
from app.formats.images import ImageHeader
from app.formats.text import count_of
from app.geodesy import LocalizationGrade
from app.markers.reading import PlateOutcome
from app.services.decodes.frame_poses import FramePose, GapDocument, ReceiverPositions
from app.services.decodes.matching import FRAME_READERS
from app.services.documents import ErrorDocument, document_of, error_document, rounded
from app.services.health.record import FrameHealth

if TYPE_CHECKING:  # it loads numba
    from app.decoders.plate.video_search import FoundPlate

_PLACES = {"lon_deg": 9, "lat_deg": 9, "speed_m_s": 3}


@dataclass(frozen=True, slots=True)
class ReadMarker:
    """One candidate of a frame with its match in the registry and the vehicle's position by it."""

    reading: FrameReading
    match: Match | None = None
    fix: Fix | None = None


@dataclass(frozen=True, slots=True)
class ReadFrame:
    """One frame: its markers and fix, or why it could not be read."""

    index: int
    name: str | None = None
    header: ImageHeader | None = None
    markers: tuple[ReadMarker, ...] = ()
    fix: Fix | None = None
    error: WaymarkError | None = None
    load_ms: float = 0.0
    decode_ms: float = 0.0
    captured_at: datetime | None = None
    pose: FramePose | None = None
    time_s: float | None = None
    health: FrameHealth = field(default_factory=FrameHealth)


class SeenPlateDocument(TypedDict):
    """A plate that passed by in several frames, and what all of them show together.

    `frames_alone` counts the frames that were read by themselves; without any, only the sum of the evidence was enough.
    """

    outcome: str
    reason: str | None
    digits: str | None
    confidence: float
    marker_id: str | None
    frames: list[int]
    frames_alone: int
    speed_m_s: float | None


@dataclass(frozen=True, slots=True)
class DriveNotes:
    """What is to be known about the frames of a drive as a whole."""

    # `warnings`, `gaps`, `plates`: as in `FramesResult`
    warnings: Sequence[str] = ()
    gaps: Sequence[GapDocument] = ()
    plates: Sequence[SeenPlateDocument] = ()
    searched: int | None = None  # frames of a video, of which only those with readings are listed
    receiver: ReceiverPositions | None = None


class FramePoseDocument(TypedDict):
    """Where the vehicle was when the frame was taken, by anything but the frame.

    The source is `list` (frames.csv or frames.json), `track` (a track beside the frames) or `context` (the coarse
    position of the upload).
    """

    source: str
    lon_deg: float
    lat_deg: float
    heading_deg: float | None
    accuracy_m: float | None
    speed_m_s: float | None


class SigmaDocument(TypedDict):
    """Standard deviations of a position."""

    east_m: float
    north_m: float
    up_m: float | None
    heading_deg: float


class FixDocument(TypedDict):
    """The vehicle's position; the covariance is of east, north, up [m] and heading [rad]."""

    lon_deg: float
    lat_deg: float
    height_m: float | None
    heading_deg: float
    covariance: list[list[float]]
    sigma: SigmaDocument
    localization_grade: LocalizationGrade
    epoch: float | None
    notes: list[str]
    marker_ids: list[str]


class MatchDocument(TypedDict):
    """The registered marker of a reading, or where an unregistered one would be by its digits."""

    registered: bool
    marker_id: str | None
    status: str | None
    localization_grade: str | None
    lon_deg: float | None
    lat_deg: float | None
    distance_m: float | None
    plausible: bool
    ambiguous: bool
    other_marker_ids: list[str]
    note: str | None


class ReadingPlace(TypedDict):
    """What every reading has besides what its family reads: its frame, its match and the vehicle's position by it."""

    frame: int
    match: MatchDocument | None
    fix: FixDocument | None


def _in_frame(document: Any) -> object:
    return types.new_class(f"{document.__name__}InFrame", (ReadingPlace, document))


AnyReading: Any = union_of_documents(_in_frame(reader.document_type) for reader in FRAME_READERS.values())
"""One candidate marker of any family; digits only where the outcome is `read`."""


class FrameDocument(TypedDict):
    """One frame of the upload."""

    frame: int
    name: str | None
    captured_at: str | None
    time_s: float | None
    pose: FramePoseDocument | None
    error: ErrorDocument | None
    width_px: int | None
    height_px: int | None
    format: str | None
    orientation: int | None
    ignored_trailing_bytes: int
    load_ms: float
    decode_ms: float
    readings: int
    fix: FixDocument | None


class FrameSummary(TypedDict):
    """Frames and plates in numbers, and in one sentence."""

    text: str
    frames: int
    frames_failed: int
    plates_read: int
    plates_matched: int
    fixes: int
    outcomes: dict[str, int]


class FramesResult(TypedDict, total=False):
    """The result of decoding frames."""

    decoder: str
    codebook_plates: int
    summary: FrameSummary
    readings: list[AnyReading]
    fix: FixDocument | None
    frames: list[FrameDocument]
    plates: list[SeenPlateDocument]
    gaps: list[GapDocument]
    receiver: ReceiverPositions | None
    warnings: list[str]


def frames_result(
    frames: Sequence[ReadFrame], *, codebook_plates: int, notes: DriveNotes | None = None, is_paper: bool = False
) -> FramesResult:
    """The result of decoding frames, as it is stored."""
    notes = notes or DriveNotes()
    readings = [{"frame": frame.index, **_reading(marker)} for frame in frames for marker in frame.markers]
    return {
        "decoder": f"waymark {__version__} {PAPER_VERSION if is_paper else DECODER_VERSION}",
        "codebook_plates": codebook_plates,
        "summary": _summary(frames, notes.searched),
        "readings": readings,
        "fix": fix_document(frames[0].fix) if len(frames) == 1 else None,
        "frames": [_frame(frame) for frame in frames],
        "plates": list(notes.plates),
        "gaps": list(notes.gaps),
        "receiver": notes.receiver,
        "warnings": list(notes.warnings),
    }


def fix_document(fix: Fix | None) -> FixDocument | None:
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
        "localization_grade": fix.grade,
        "epoch": fix.epoch,
        "notes": list(fix.notes),
        "marker_ids": list(fix.marker_ids),
    }


def seen_plate_document(plate: FoundPlate, frames: Mapping[int, ReadFrame]) -> SeenPlateDocument:
    """A plate of a video as clients see it; its frames were matched."""
    reading = plate.reading
    matched = (
        marker.match.row.id
        for seen in plate.seen
        for marker in frames[seen.frame].markers
        if marker.reading.family == PLATE.name
        and marker.match is not None
        and marker.match.row is not None
        and getattr(marker.reading, "digits", None) == reading.digits
    )
    return {
        "outcome": str(reading.outcome),
        "reason": reading.reason or None,
        "digits": reading.digits,
        "confidence": float(reading.confidence),
        "marker_id": next(matched, None) if reading.digits else None,
        "frames": [seen.frame for seen in plate.seen],
        "frames_alone": len(plate.alone),
        "speed_m_s": None if plate.speed_m_s is None else round(plate.speed_m_s, 3),
    }


def _summary(frames: Sequence[ReadFrame], searched: int | None) -> FrameSummary:
    total = len(frames) if searched is None else searched
    markers = [marker for frame in frames for marker in frame.markers]
    read = [marker for marker in markers if marker.reading.outcome == PlateOutcome.READ]
    matched = [marker for marker in read if marker.match is not None and marker.match.row is not None]
    failed = sum(frame.error is not None for frame in frames)
    refused = len(markers) - len(read)
    text = f"{_counts(read)} read" if read else "no plate read"
    text += f" in {count_of(total, 'frame')}, {len(matched)} of them registered" if read else ""
    text += f"; {count_of(refused, 'candidate')} refused" if refused else ""
    text += f"; {count_of(failed, 'frame')} could not be decoded" if failed else ""
    return {
        "text": text,
        "frames": total,
        "frames_failed": failed,
        "plates_read": sum(marker.reading.family == PLATE.name for marker in read),
        "plates_matched": sum(marker.reading.family == PLATE.name for marker in matched),
        "fixes": sum(frame.fix is not None for frame in frames),
        "outcomes": Counter(str(marker.reading.outcome) for marker in markers),
    }


def _counts(read: Sequence[ReadMarker]) -> str:
    """How many markers of each family were read, in words."""
    numbers = Counter(marker.reading.family for marker in read)
    return " and ".join(count_of(number, get_family(name).label) for name, number in numbers.items())


def _frame(frame: ReadFrame) -> FrameDocument:
    header = frame.header
    return {
        "frame": frame.index,
        "name": frame.name,
        "captured_at": frame.captured_at.isoformat().replace("+00:00", "Z") if frame.captured_at else None,
        "time_s": None if frame.time_s is None else round(frame.time_s, 6),
        "pose": document_of(FramePoseDocument, rounded(frame.pose, _PLACES)) if frame.pose is not None else None,
        "error": error_document(frame.error) if frame.error else None,
        "width_px": header.width_px if header else None,
        "height_px": header.height_px if header else None,
        "format": str(header.kind) if header else None,
        "orientation": header.orientation if header else None,
        "ignored_trailing_bytes": header.trailing_bytes if header else 0,
        "load_ms": round(frame.load_ms, 3),
        "decode_ms": round(frame.decode_ms, 3),
        "readings": len(frame.markers),
        "fix": fix_document(frame.fix),
    }


def _reading(marker: ReadMarker) -> dict[str, object]:
    reading = marker.reading
    return {
        **FRAME_READERS[reading.family].document(reading),
        "match": _match(marker.match),
        "fix": fix_document(marker.fix),
    }


def _match(match: Match | None) -> MatchDocument | None:
    if match is None:
        return None
    row = match.row
    return {
        "registered": row is not None,
        "marker_id": row.id if row is not None else None,
        "status": row.status if row is not None else None,
        "localization_grade": row.localization_grade if row is not None else None,
        "lon_deg": match.lon_deg,
        "lat_deg": match.lat_deg,
        "distance_m": round(match.distance_m, 3) if match.distance_m is not None else None,
        "plausible": match.plausible,
        "ambiguous": match.ambiguous,
        "other_marker_ids": list(match.others),
        "note": match.note or None,
    }
