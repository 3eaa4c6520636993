"""Decodes as clients see them."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Literal, NotRequired, cast

from pydantic import Discriminator, Field, JsonValue
from typing_extensions import TypeAliasType, TypedDict

from app.registry.decodes import DecodeRow, StoredResult
from app.registry.jobs import JobState
from app.services.decodes.context import DecodeKind
from app.services.decodes.frame_documents import FramesResult
from app.services.decodes.packet_documents import PacketsResult
from app.services.decodes.trace_documents import TraceResult
from app.services.documents import ErrorDocument


class DecodeLinks(TypedDict):
    """Paths of the decode and of what can be drawn from it."""

    self: str
    annotated: NotRequired[str]
    samples: NotRequired[str]
    packets: NotRequired[str]
    track: NotRequired[str]
    readings: NotRequired[str]
    plot: NotRequired[str]
    lane: NotRequired[str]
    overlay: NotRequired[str]


class _Decode(TypedDict):
    id: str
    state: JobState
    progress: Annotated[float, Field(description="0 to 1.")]
    attempts: int
    created_at: datetime
    finished_at: datetime | None
    context: Annotated[dict[str, JsonValue], Field(description="What was declared of the upload.")]
    file_name: Annotated[str | None, Field(description="Of the uploaded file, if it had one.")]
    upload_bytes: Annotated[int | None, Field(description="Size of the upload; null of those of older versions.")]
    error: ErrorDocument | None
    links: DecodeLinks


class DecodeHead(_Decode):
    """A decode without its result."""

    kind: DecodeKind


class FramesDecode(_Decode, FramesResult):
    """A decode of frames; while it is decoded, `partial` is true and the result covers the frames so far."""

    kind: Literal[DecodeKind.FRAME, DecodeKind.ARCHIVE, DecodeKind.VIDEO]
    partial: NotRequired[Annotated[bool, Field(description="The decode goes on; this is its result so far.")]]


class TraceDecode(_Decode, TraceResult):
    """A decode of a magnetometer trace. `decoder` and what follows it are there once it is done."""

    kind: Literal[DecodeKind.TRACE]


class PacketsDecode(_Decode, PacketsResult):
    """A decode of a packet log. `decoder` and what follows it are there once it is done."""

    kind: Literal[DecodeKind.PACKETS]


DecodeDocument = TypeAliasType(
    "DecodeDocument", Annotated[FramesDecode | TraceDecode | PacketsDecode, Discriminator("kind")]
)
"""A decode with its result, which has one of three shapes by its `kind`."""


class DecodePage(TypedDict):
    """A page of decodes without their results, newest first; the Link header leads to the next one."""

    items: list[DecodeHead]


def decode_document(row: DecodeRow) -> DecodeDocument:
    """A decode with its result, once there is one."""
    so_far = {"partial": True} if row.state == "running" and row.result else {}
    return cast("DecodeDocument", {**decode_head(row), **so_far, **(row.result or {})})


def decode_head(row: DecodeRow) -> DecodeHead:
    """A decode without its result."""
    return {
        "id": row.id,
        "state": row.state,
        "kind": DecodeKind(row.kind),
        "progress": row.progress,
        "attempts": row.attempts,
        "created_at": row.created_at,
        "finished_at": row.finished_at,
        "context": {name: value for name, value in row.context.items() if name != "file_name"},
        "file_name": row.context.get("file_name"),
        "upload_bytes": row.upload_bytes,
        "error": cast("ErrorDocument | None", row.error),
        "links": _links(f"/v1/decodes/{row.id}", row.kind, row.result or {}),
    }


def _links(path: str, kind: str, result: StoredResult) -> DecodeLinks:
    links: DecodeLinks = {"self": path}
    frames = [frame["frame"] for frame in result.get("frames", ()) if frame["error"] is None]
    if kind in (DecodeKind.FRAME, DecodeKind.ARCHIVE):
        links["annotated"] = f"{path}/annotated.jpg"
    elif kind == DecodeKind.VIDEO and frames:
        links["annotated"] = f"{path}/annotated.jpg?frame={frames[0]}"
    elif kind != DecodeKind.VIDEO:
        links["plot"] = f"{path}/plot.svg"
    if kind == DecodeKind.TRACE:
        links["samples"] = f"{path}/samples"
    if kind == DecodeKind.PACKETS:
        links["lane"] = f"{path}/lane.geojson"
        links["packets"] = f"{path}/packets"
        if result.get("overlay"):
            links["overlay"] = f"{path}/overlay.jpg"
    if result:
        links["track"], links["readings"] = f"{path}/track.geojson", f"{path}/readings.geojson"
    return links
