"""Decoded traces as clients see them."""

from __future__ import annotations

from collections import Counter
from typing import Literal

from typing_extensions import TypedDict

from app import __version__
from app.decoders.magnet.identify import ReadTag, ReadTrace, TagFix, TagMatch
from app.decoders.magnet.readings import LineCrossing, MagnetReading, NoiseFinding
from app.formats.text import count_of
from app.formats.traces.declaration import TraceReport
from app.markers.magnet_design import Meaning
from app.services.decodes.trace_tasks import DecodedTrace, TraceMotion
from app.services.documents import document_of, rounded

MAX_NOISE = 500
_PLACES = {
    "t_s": 4, "start_s": 4, "end_s": 4, "odometer_m": 3, "lateral_cm": 2, "clearance_cm": 2, "moment_am2": 3,
    "along_std_m": 4, "relative_std_m": 4, "snr": 1, "gaps_m": 4, "gap_std_m": 4, "length_m": 4, "ratios": 5,
    "ratio_std": 5, "across_m": 4, "rate_hz": 3, "duration_s": 3, "driven_m": 2, "speed_coverage": 4,
    "heading_coverage": 4, "load_ms": 1, "decode_ms": 1,
}  # fmt: skip
"""Decimal places of values, by the names of their fields."""


class TraceSummary(TypedDict):
    """Magnets, tags and line crossings in numbers, and in one sentence."""

    text: str
    magnets: int
    tags: int
    tags_matched: int
    wrong_way: int
    crossings: int
    fixes: int
    noise: dict[str, int]


class TagMatchDocument(TypedDict):
    """The registered tag that was passed."""

    registered: bool
    marker_id: str | None
    status: str | None
    localization_grade: str | None
    meaning: Meaning | None
    ambiguous: bool
    other_marker_ids: list[str]
    note: str | None


class TagDocument(TypedDict):
    """An information tag that was passed."""

    start_s: float
    end_s: float
    tag: str | None
    tuple: str | None
    polarities: str
    gaps_m: list[float]
    gap_std_m: list[float]
    length_m: float
    ratios: list[float]
    ratio_std: list[float]
    lateral_cm: float
    direction: Literal["legal", "wrong-way", "unknown"]
    missing: int
    extra: int
    confidence: float
    match: TagMatchDocument | None
    fix: TagFix | None


class TraceResult(TypedDict, total=False):
    """The result of decoding a trace."""

    decoder: str
    codebook_tags: int
    summary: TraceSummary
    report: TraceReport
    tags: list[TagDocument]
    crossings: list[LineCrossing]
    magnets: list[MagnetReading]
    noise: list[NoiseFinding]
    fix: TagFix | None
    motion: TraceMotion


def trace_result(decoded: DecodedTrace, trace: ReadTrace, *, codebook_tags: int) -> TraceResult:
    """What a decode of a trace found, as it is stored."""
    tags = [_tag(tag) for tag in trace.tags]
    return {
        "decoder": f"waymark {__version__} magnet/{decoded.version}",
        "codebook_tags": codebook_tags,
        "summary": _summary(decoded.report.driven_m, trace),
        "report": rounded(decoded.report, _PLACES),
        "tags": tags,
        "crossings": [rounded(crossing, _PLACES) for crossing in trace.crossings],
        "magnets": [rounded(magnet, _PLACES) for magnet in trace.magnets],
        "noise": [rounded(finding, _PLACES) for finding in trace.noise[:MAX_NOISE]],
        "fix": next((tag["fix"] for tag in reversed(tags) if tag["fix"] is not None), None),
        "motion": decoded.motion,
    }


def _summary(driven_m: float, trace: ReadTrace) -> TraceSummary:
    matched = sum(tag.match is not None and tag.match.tag is not None for tag in trace.tags)
    wrong_way = sum(tag.reading.wrong_way for tag in trace.tags)
    solid = sum(crossing.style.value == "solid" for crossing in trace.crossings)
    text = f"{count_of(len(trace.magnets), 'magnet')} over {driven_m:.0f} m: {count_of(len(trace.tags), 'tag')}"
    text += f", {matched} registered" if trace.tags else ""
    text += f"; {count_of(len(trace.crossings), 'line crossing')}, {solid} solid" if trace.crossings else ""
    text += f"; WRONG WAY at {count_of(wrong_way, 'tag')}" if wrong_way else ""
    text += f"; {count_of(len(trace.noise), 'disturbance')} left out" if trace.noise else ""
    return {
        "text": text,
        "magnets": len(trace.magnets),
        "tags": len(trace.tags),
        "tags_matched": matched,
        "wrong_way": wrong_way,
        "crossings": len(trace.crossings),
        "fixes": sum(tag.fix is not None for tag in trace.tags),
        "noise": Counter(finding.kind.value for finding in trace.noise),
    }


def _tag(tag: ReadTag) -> TagDocument:
    known = tag.reading.tag
    return document_of(
        TagDocument,
        rounded(tag.reading, _PLACES),
        tag=known.text if known is not None else None,
        tuple=known.tuple_text if known is not None else None,
        polarities="".join(tag.reading.polarities),
        direction="wrong-way" if tag.reading.wrong_way else "legal" if known is not None else "unknown",
        match=_match(tag.match) if tag.match is not None else None,
        fix=rounded(tag.fix, _PLACES) if tag.fix is not None else None,
    )


def _match(match: TagMatch) -> TagMatchDocument:
    tag = match.tag
    return {
        "registered": tag is not None,
        "marker_id": tag.marker_id if tag is not None else None,
        "status": tag.status if tag is not None else None,
        "localization_grade": tag.grade if tag is not None else None,
        "meaning": tag.meaning if tag is not None else None,
        "ambiguous": bool(match.others),
        "other_marker_ids": list(match.others),
        "note": match.note or None,
    }
