"""What is drawn from decodes that are stored: frames with outlines, lanes over frames, GeoJSON and plots."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import AbstractContextManager
from typing import Literal

from typing_extensions import TypedDict

from app.decoding.declarations import DecodeContext
from app.errors import NotFound
from app.formats.format import SpooledFile, read_member
from app.formats.text import TableWriter
from app.lanes.types import LeftOutReason
from app.markers.reading import Certainty
from app.plots.annotated_frame import Outline
from app.registry import decodes as store
from app.registry.database import Database
from app.registry.decodes import DecodeRow, StoredResult
from app.services.access.access import Caller
from app.services.decodes.context import DecodeKind, DecodeRules, DecodeTimes, clock_of, stamp
from app.services.decodes.frame_poses import TrackGeometry
from app.services.decodes.frame_tasks import FramePicture, annotate_frame
from app.services.decodes.lane_documents import LaneCollection, lane_geojson
from app.services.decodes.packet_tasks import draw_overlay
from app.services.decodes.video_handler import video_of
from app.services.decodes.video_tasks import draw_video_frame
from app.services.ports import Blobs, DecoderProcesses

# === Readings of a decode as one list in the order of their times, whatever was uploaded; as CSV and GeoJSON.


CSV_COLUMNS = (
    "time", "time_s", "frame", "family", "outcome", "code", "confidence", "reason", "marker_id", "registered",
    "distance_m", "lon_deg", "lat_deg",
)  # fmt: skip


class ReadingRow(TypedDict):
    """One reading of any family.

    `time` is UTC, `time_s` seconds since 1970 where the clock is `utc`, else of the recording. `outcome` is that of the
    reading: of a plate or sign whether it was read, or `unchecked`, that is read without a check or a registered plate
    that confirms the digits; of a tag its direction; of a CERPM `received` or `left-out`.
    The place is that of the marker: of the registered one, else of what was read.
    """

    time: str | None
    time_s: float | None
    frame: int | None
    family: str
    outcome: str
    code: str | None
    confidence: float | None
    reason: str | None
    marker_id: str | None
    registered: bool
    distance_m: float | None
    lon_deg: float | None
    lat_deg: float | None


class ReadingFeature(TypedDict):
    """A reading at its marker's place; without a geometry where that is not known."""

    type: Literal["Feature"]
    geometry: TrackGeometry | None
    properties: ReadingRow


class ReadingCollection(TypedDict):
    """Readings, RFC 7946."""

    type: Literal["FeatureCollection"]
    features: list[ReadingFeature]


def reading_rows(row: DecodeRow) -> list[ReadingRow]:
    """The readings of a decode that has a result; those without a time come last."""
    result, clock = row.result or {}, clock_of(row)
    if row.kind == DecodeKind.TRACE:
        rows = [_tag(tag, clock) for tag in result.get("tags", ())]
    elif row.kind == DecodeKind.PACKETS:
        rows = [_cerpm(marker) for marker in result.get("markers", ())]
    else:
        rows = list(_frame_readings(result, clock))
    return sorted(rows, key=lambda found: (found["time_s"] is None, found["time_s"] or 0.0))


def readings_csv(row: DecodeRow) -> str:
    """One row for each reading."""
    out = io.StringIO()
    table = TableWriter(out)
    table.write_row(CSV_COLUMNS)
    for found in reading_rows(row):
        cells: dict[str, object] = {**found}
        table.write_row(_cell(cells[name]) for name in CSV_COLUMNS)
    return out.getvalue()


def readings_geojson(row: DecodeRow) -> ReadingCollection:
    """One feature for each reading."""
    return {"type": "FeatureCollection", "features": [_feature(found) for found in reading_rows(row)]}


def _feature(found: ReadingRow) -> ReadingFeature:
    lon_deg, lat_deg = found["lon_deg"], found["lat_deg"]
    place: TrackGeometry | None = None
    if lon_deg is not None and lat_deg is not None:
        place = {"type": "Point", "coordinates": [lon_deg, lat_deg]}
    return {"type": "Feature", "geometry": place, "properties": found}


def _cell(value: object) -> object:
    return str(value).lower() if isinstance(value, bool) else value


def _frame_readings(result: StoredResult, clock: DecodeTimes) -> Iterator[ReadingRow]:
    times = {frame["frame"]: clock.frame_s(frame) for frame in result.get("frames", ())}
    for reading in result.get("readings", ()):
        match, time_s = reading.get("match") or {}, times.get(reading["frame"])
        yield {
            "time": stamp(time_s, clock),
            "time_s": time_s,
            "frame": reading["frame"],
            "family": reading.get("family", "plate"),
            "outcome": _shown_outcome(reading),
            "code": reading.get("digits") or reading.get("likely_digits"),
            "confidence": reading.get("confidence"),
            "reason": reading.get("reason") or match.get("note"),
            "marker_id": match.get("marker_id"),
            "registered": bool(match.get("registered")),
            "distance_m": match.get("distance_m"),
            "lon_deg": match.get("lon_deg"),
            "lat_deg": match.get("lat_deg"),
        }


def _shown_outcome(reading: StoredResult) -> str:
    """That of a reading; of digits that nothing confirms, that."""
    unchecked = Certainty.UNCHECKED.value
    return unchecked if reading.get("certainty") == unchecked else str(reading["outcome"])


def _tag(tag: StoredResult, clock: DecodeTimes) -> ReadingRow:
    match, fix = tag.get("match") or {}, tag.get("fix") or {}
    time_s = clock.trace_s(tag["end_s"])
    return {
        "time": stamp(time_s, clock),
        "time_s": time_s,
        "frame": None,
        "family": "magnet",
        "outcome": tag["direction"],
        "code": tag.get("tag") or tag.get("polarities"),
        "confidence": tag.get("confidence"),
        "reason": match.get("note"),
        "marker_id": match.get("marker_id"),
        "registered": bool(match.get("registered")),
        "distance_m": None,
        "lon_deg": fix.get("lon_deg"),
        "lat_deg": fix.get("lat_deg"),
    }


def _cerpm(marker: StoredResult) -> ReadingRow:
    return {
        "time": None,
        "time_s": None,
        "frame": None,
        "family": "cerpm",
        "outcome": "received" if marker.get("left_out") in (None, LeftOutReason.OTHER_LANE.text) else "left-out",
        "code": str(marker["number"]),
        "confidence": None,
        "reason": marker.get("left_out") or "; ".join(marker.get("notes", ())) or None,
        "marker_id": marker.get("marker_id"),
        "registered": bool(marker.get("registered")),
        "distance_m": marker.get("off_registered_m"),
        "lon_deg": marker.get("lon_deg"),
        "lat_deg": marker.get("lat_deg"),
    }


# === What is drawn from decodes that are stored.


class DecodeOutputs:
    """Use cases on the pictures and files of a decode.

    Parameters
    ----------
    blobs : Blobs
        Where uploads and plots are stored.
    """

    def __init__(
        self, database: Database, *, blobs: Blobs, processes: DecoderProcesses, rules: DecodeRules | None = None
    ) -> None:
        self._database, self._blobs, self._processes = database, blobs, processes
        self._rules = rules or DecodeRules()

    def annotated(
        self, caller: Caller, decode_id: str, suffix: Literal["png", "jpg"], frame: int = 0, *, outlined: bool = True
    ) -> bytes:
        """A frame, with its readings drawn over it or without, encoded as ``png`` or ``jpg``.

        Raises
        ------
        NotFound
            There is no such decode or frame, or it is not done.
        """
        row, result = self._result(caller, decode_id)
        shown = next((entry for entry in result.get("frames", ()) if entry["frame"] == frame), None)
        if shown is None or shown["error"] is not None:
            raise NotFound(
                f"decode {decode_id} has no readable frame {frame}",
                field="frame",
                cure="`frames` of the decode lists them; of a video, those in which something was found",
            )
        context = DecodeContext.model_validate(row.context)
        readings = result["readings"] if outlined else ()
        outlines = tuple(_outline(reading) for reading in readings if reading["frame"] == frame)
        with self._upload(row) as file:
            if row.kind == DecodeKind.VIDEO:
                video = video_of(context, file, self._rules.archives)
                rate_hz = context.frames.rate_hz if context.frames is not None else None
                limits = self._rules.videos
                return self._processes.run(draw_video_frame, video, frame, outlines, suffix, limits, rate_hz)
            if row.kind == DecodeKind.ARCHIVE:
                file = SpooledFile.of(read_member(file, frame, self._rules.archives).data)
            picture = FramePicture(file, context.is_thermal, context.thermal_range, self._rules.images)
            return self._processes.run(annotate_frame, picture, outlines, suffix)

    def overlay(self, caller: Caller, decode_id: str, suffix: str) -> bytes:
        """The camera frame of a drive with its lane drawn over it, encoded as ``png`` or ``jpg``.

        Raises
        ------
        NotFound
            There is no such decode, or no overlay in it.
        """
        row, result = self._result(caller, decode_id)
        overlay = result.get("overlay")
        if not overlay:
            raise NotFound(
                f"decode {decode_id} has no overlay",
                field="decode_id",
                limit="a packet log with a camera frame, a camera and the vehicle's pose",
                cure="report.warnings lists what was missing",
            )
        with self._upload(row) as file:
            return self._processes.run(draw_overlay, file, overlay, suffix, self._rules.images)

    def lane(self, caller: Caller, decode_id: str) -> LaneCollection:
        """Path, boundaries and markers of a drive as GeoJSON.

        Raises
        ------
        NotFound
            There is no such decode, or it is not of a packet log.
        """
        _row, result = self._result(caller, decode_id)
        if "lane" not in result:
            raise NotFound(
                f"decode {decode_id} is of no packet log", field="decode_id", limit="packet logs have a lane"
            )
        return lane_geojson(result["lane"], result["markers"])

    def plot(self, caller: Caller, decode_id: str) -> bytes:
        """Plot of a trace or a lane with what was found, SVG.

        Raises
        ------
        NotFound
            There is no such decode, it is of frames, or it is not done.
        """
        row = self._get(caller, decode_id)
        if row.picture_key is None:
            has_plot = row.kind in (DecodeKind.TRACE, DecodeKind.PACKETS)
            raise NotFound(
                f"decode {decode_id} has no plot: it is {row.state}, of kind {row.kind}",
                field="decode_id",
                cure="wait until it is done" if has_plot else "frames have annotated.png and annotated.jpg",
            )
        return self._blobs.get(row.picture_key)

    def _get(self, caller: Caller, decode_id: str) -> DecodeRow:
        with self._database.read() as connection:
            return store.get_decode(connection, caller.agency_id, decode_id, holder_id=caller.own_key_id)

    def _result(self, caller: Caller, decode_id: str) -> tuple[DecodeRow, StoredResult]:
        row = self._get(caller, decode_id)
        if row.result is None:
            raise NotFound(
                f"decode {decode_id} has no result: it is {row.state}",
                field="decode_id",
                cure="wait until it is done",
            )
        return row, row.result

    def _upload(self, row: DecodeRow) -> AbstractContextManager[SpooledFile]:
        assert row.upload_key is not None
        return self._blobs.opened(row.upload_key)


def _outline(reading: StoredResult) -> Outline:
    corners = tuple((float(x), float(y)) for x, y in reading["corners_px"] or ())
    label = f"{reading['digits']} {reading['confidence']:.1%}" if reading["digits"] else reading["outcome"]
    return Outline(corners, _shown_outcome(reading), label)
