"""One frame of an upload: through a decoder process, then held against the registry."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import sqlalchemy as sa

from app.decoders.archives import Member
from app.decoders.images import ImageLimits, inspect_image
from app.markers.plate import PlateGeometry
from app.sensors.camera import Camera
from app.services.decode_context import DecodeContext
from app.services.decode_documents import ReadFrame, ReadPlate
from app.services.fixes import fix_from_match, fuse_fixes
from app.services.frames import FrameDecoder, FrameResult, FrameTask, PendingFrame, PlateSearch, distinct_geometries
from app.services.matching import Match, NearbyPlates, match_reading
from app.services.plate_markers import plate_geometry

DEFAULT_GEOMETRIES = tuple(PlateGeometry(n=n) for n in (8, 10, 12))


@dataclass(frozen=True, slots=True)
class StartedFrame:
    """A frame in a decoder process, which loads it and then waits to be told what to look for."""

    camera: Camera | None
    pending: PendingFrame
    _search: Future[PlateSearch]

    def look_for(self, nearby: NearbyPlates) -> None:
        """Say what the registry has near by."""
        geometries = distinct_geometries([*DEFAULT_GEOMETRIES, *(plate_geometry(row) for row in nearby.rows)])
        self._search.set_result(PlateSearch(self.camera, nearby.codebook, geometries))


def start_frame(
    decoder: FrameDecoder, data: bytes, context: DecodeContext, limits: ImageLimits, *, wait_s: float = 0.0
) -> StartedFrame:
    """Hand a frame to a decoder process, after checking what its header says against the limits and the camera.

    Raises
    ------
    UnreadableUpload, InvalidParameter
        The frame is refused, or it is not this camera's.
    Unavailable
        The decoder processes are busy.
    """
    header = inspect_image(data, limits, thermal=context.thermal)
    camera = context.camera.camera_for(header) if context.camera else None
    search: Future[PlateSearch] = Future()
    pending = decoder.start(FrameTask(data, context.thermal, context.thermal_range, limits), search, wait_s=wait_s)
    return StartedFrame(camera, pending, search)


def read_frame(
    connection: sa.Connection,
    agency_id: str,
    member: Member,
    result: FrameResult,
    context: DecodeContext,
    nearby: NearbyPlates,
) -> ReadFrame:
    """Match a frame's readings and compute the vehicle's position from them."""
    camera = context.camera.camera_for(result.header) if context.camera else None
    plates = []
    for reading in result.readings:
        match = match_reading(connection, agency_id, reading, context.coarse_position, nearby)
        fix = None
        if match is not None and camera is not None and reading.pose is not None:
            fix = fix_from_match(reading.pose, camera, match, context.heading_deg)
        plates.append(ReadPlate(reading, match, fix))
    return ReadFrame(
        index=member.index,
        name=member.name or None,
        header=result.header,
        plates=tuple(plates),
        fix=fuse_fixes([plate.fix for plate in plates if plate.fix is not None]),
        load_ms=result.load_ms,
        decode_ms=result.decode_ms,
    )


def observations_of(decode_id: str, frames: Sequence[ReadFrame], seen_at: datetime) -> list[dict[str, Any]]:
    """One row a plate and frame; of a plate that a frame shows twice the surer reading counts."""
    rows: dict[tuple[int, str], dict[str, Any]] = {}
    for frame in frames:
        for plate in sorted(frame.plates, key=lambda plate: -plate.reading.confidence):
            if plate.match is None or plate.match.row is None:
                continue
            marker_id = str(plate.match.row["id"])
            row = {
                "decode_id": decode_id,
                "marker_id": marker_id,
                "frame": frame.index,
                "at": seen_at,
                "what": _what(plate.match),
                "detail": {
                    "confidence": float(plate.reading.confidence),
                    "grade": plate.reading.grade.letter if plate.reading.grade else None,
                    "corrected_cells": len(plate.reading.corrected_cells),
                    "from_codebook": bool(plate.reading.from_codebook),
                },
            }
            rows.setdefault((frame.index, marker_id), row)
    return list(rows.values())


def _what(match: Match) -> str:
    if not match.plausible:
        return "out-of-place"
    return "ambiguous" if match.ambiguous else "seen"
