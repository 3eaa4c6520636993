"""What is drawn from decodes that are stored: frames with outlines, lanes over frames, GeoJSON and plots."""

from __future__ import annotations

from contextlib import AbstractContextManager
from typing import Any, Literal

from app.errors import NotFound
from app.formats.archives import read_member
from app.formats.spooled_file import SpooledFile
from app.plots.annotated_frame import Outline
from app.registry import decodes as store
from app.registry.database import Database
from app.registry.decodes import DecodeRow
from app.services.access.access import Caller
from app.services.decoder_processes import DecoderProcesses
from app.services.decodes.context import context_from_document
from app.services.decodes.frame_task import AnnotationTask
from app.services.decodes.frame_terms import frame_terms
from app.services.decodes.kinds import DecodeKind
from app.services.decodes.lane_documents import LaneCollection, lane_geojson, overlay_from_document
from app.services.decodes.packet_task import OverlayTask
from app.services.decodes.rules import DecodeRules
from app.services.decodes.sample_task import VideoFrameTask
from app.services.decodes.video_handler import video_of
from app.services.ports import Blobs


class DecodeOutputs:
    """Use cases on the pictures and files of a decode.

    Parameters
    ----------
    database : Database
    blobs : Blobs
        Where uploads and plots are stored.
    processes : DecoderProcesses
    rules : DecodeRules, optional
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
        context = context_from_document(row.context)
        readings = result["readings"] if outlined else ()
        outlines = tuple(_outline(reading) for reading in readings if reading["frame"] == frame)
        with self._upload(row) as file:
            if row.kind == DecodeKind.VIDEO:
                video = video_of(context, file, self._rules.archives)
                rate_hz = frame_terms(context.frames or {}).rate_hz
                video_task = VideoFrameTask(video, frame, outlines, suffix, self._rules.videos, rate_hz)
                return self._processes.submit(video_task).result()
            if row.kind == DecodeKind.ARCHIVE:
                file = SpooledFile.of(read_member(file, frame, self._rules.archives).data)
            task = AnnotationTask(
                file, outlines, suffix, context.thermal, context.thermal_range, limits=self._rules.images
            )
            return self._processes.submit(task).result()

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
        shown = overlay_from_document(overlay)
        with self._upload(row) as file:
            task = OverlayTask(file, overlay["frame"], shown, suffix, self._rules.images)
            return self._processes.submit(task).result()

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

    def _result(self, caller: Caller, decode_id: str) -> tuple[DecodeRow, dict[str, Any]]:
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


def _outline(reading: dict[str, Any]) -> Outline:
    corners = tuple((float(x), float(y)) for x, y in reading["corners_px"] or ())
    label = f"{reading['digits']} {reading['confidence']:.1%}" if reading["digits"] else reading["outcome"]
    return Outline(corners, reading["outcome"], label)
