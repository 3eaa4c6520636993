"""Decoded traces as clients see them."""

from __future__ import annotations

import math
from typing import Literal, NotRequired

import numpy as np
from typing_extensions import TypedDict

from app import __version__
from app.decoders.magnet.identify import ReadTag, ReadTrace, TagFix, TagMatch
from app.decoders.magnet.readings import LineCrossing, MagnetReading, NoiseFinding, TagReading
from app.formats.traces.declaration import LeftOut, TraceGap
from app.services.decodes.context import count_of
from app.services.decodes.trace_tasks import TraceMotion, TraceResult

MAX_NOISE = 500


class TraceGapDocument(TypedDict):
    """A stretch without usable samples: `lost_s` after `t_s`, before the sample with this index."""

    part: str
    sample: int
    t_s: float
    lost_s: float
    skipped_bytes: int


class LeftOutRows(TypedDict):
    """Values or rows of a file that are not in the trace."""

    part: str
    what: str
    count: int
    reason: str


class TraceReportDocument(TypedDict):
    """About reading the files of a recording."""

    formats: dict[str, str]
    samples: int
    rate_hz: float
    duration_s: float
    driven_m: float
    gaps: list[TraceGapDocument]
    gap_count: int
    left_out: list[LeftOutRows]
    clock_offsets_s: dict[str, float]
    speed_coverage: float
    heading_coverage: float
    warnings: list[str]
    load_ms: float
    decode_ms: float


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


class PassedMagnetDocument(TypedDict):
    """A magnet that was passed."""

    t_s: float
    odometer_m: float
    lateral_cm: float
    polarity: str
    phi_deg: int
    clearance_cm: float
    confidence: float
    along_std_m: NotRequired[float | None]  # decodes before matched-4 have none


class CrossingDocument(TypedDict):
    """The bar came over a line: a lane departure unless it was meant."""

    t_s: float
    odometer_m: float
    style: str
    side: str
    lateral_cm: float
    confidence: float


class NoiseDocument(TypedDict):
    """A disturbance that is not taken for a magnet, and why."""

    t_s: float
    odometer_m: float
    lateral_cm: float
    kind: str
    reason: str


class TagFixSigma(TypedDict):
    """Standard deviations of a vehicle's position at a tag."""

    along_m: float
    across_m: float
    heading_deg: float


class TagFixDocument(TypedDict):
    """The vehicle's position at a tag's last magnet; the covariance is of east, north [m] and heading [rad]."""

    t_s: float
    lon_deg: float
    lat_deg: float
    heading_deg: float
    covariance: list[list[float]]
    sigma: TagFixSigma
    across_m: float
    localization_grade: str
    notes: list[str]


class CodeMeaningDocument(TypedDict):
    """The meaning of a code."""

    kind: str
    value: float | str


class TagMatchDocument(TypedDict):
    """The registered tag that was passed."""

    registered: bool
    marker_id: str | None
    status: str | None
    localization_grade: str | None
    meaning: CodeMeaningDocument | None
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
    fix: TagFixDocument | None


class TraceMotionDocument(TypedDict):
    """Speed and heading at even times from the trace's first sample on; null where the recording has none nearby."""

    start_s: float
    step_s: float
    speed_m_s: list[float | None]
    heading_deg: list[float | None]


class TraceResultDocument(TypedDict):
    """The result of decoding a trace."""

    decoder: str
    codebook_tags: int
    summary: TraceSummary
    report: TraceReportDocument
    tags: list[TagDocument]
    crossings: list[CrossingDocument]
    magnets: list[PassedMagnetDocument]
    noise: list[NoiseDocument]
    fix: TagFixDocument | None
    motion: TraceMotionDocument


def trace_document(result: TraceResult, trace: ReadTrace, *, codebook_tags: int) -> TraceResultDocument:
    """What a decode of a trace found, as it is stored."""
    report = result.report
    fixes = [tag.fix for tag in trace.tags if tag.fix is not None]
    return {
        "decoder": f"waymark {__version__} magnet/{result.version}",
        "codebook_tags": codebook_tags,
        "summary": _summary(result, trace),
        "report": {
            "formats": {name: str(kind) for name, kind in report.formats.items()},
            "samples": report.samples,
            "rate_hz": round(report.rate_hz, 3),
            "duration_s": round(report.duration_s, 3),
            "driven_m": round(result.length_m, 2),
            "gaps": [_gap(gap) for gap in report.gaps],
            "gap_count": report.gap_count,
            "left_out": [_left_out(entry) for entry in report.left_out],
            "clock_offsets_s": {name: float(offset) for name, offset in report.clock_offsets_s.items()},
            "speed_coverage": round(report.speed_coverage, 4),
            "heading_coverage": round(report.heading_coverage, 4),
            "warnings": list(report.warnings),
            "load_ms": round(result.load_ms, 1),
            "decode_ms": round(result.decode_ms, 1),
        },
        "tags": [_tag(tag) for tag in trace.tags],
        "crossings": [_crossing(crossing) for crossing in trace.crossings],
        "magnets": [_magnet(magnet) for magnet in trace.magnets],
        "noise": [_noise(finding) for finding in trace.noise[:MAX_NOISE]],
        "fix": tag_fix_document(fixes[-1]) if fixes else None,
        "motion": _motion(result.motion),
    }


def _motion(motion: TraceMotion) -> TraceMotionDocument:
    return {
        "start_s": motion.start_s,
        "step_s": motion.step_s,
        "speed_m_s": [_rounded(value, 3) for value in motion.speed_m_s],
        "heading_deg": [_rounded(value, 2) for value in motion.heading_deg],
    }


def _rounded(value: float, places: int) -> float | None:
    return round(value, places) if math.isfinite(value) else None


def _summary(result: TraceResult, trace: ReadTrace) -> TraceSummary:
    matched = sum(tag.match is not None and tag.match.tag is not None for tag in trace.tags)
    wrong_way = sum(tag.reading.wrong_way for tag in trace.tags)
    solid = sum(crossing.style.value == "solid" for crossing in trace.crossings)
    text = f"{count_of(len(trace.magnets), 'magnet')} over {result.length_m:.0f} m: {count_of(len(trace.tags), 'tag')}"
    text += f", {matched} registered" if trace.tags else ""
    text += f"; {count_of(len(trace.crossings), 'line crossing')}, {solid} solid" if trace.crossings else ""
    text += f"; WRONG WAY at {count_of(wrong_way, 'tag')}" if wrong_way else ""
    text += f"; {count_of(len(trace.noise), 'disturbance')} left out" if trace.noise else ""
    kinds: dict[str, int] = {}
    for finding in trace.noise:
        kinds[str(finding.kind)] = kinds.get(str(finding.kind), 0) + 1
    return {
        "text": text,
        "magnets": len(trace.magnets),
        "tags": len(trace.tags),
        "tags_matched": matched,
        "wrong_way": wrong_way,
        "crossings": len(trace.crossings),
        "fixes": sum(tag.fix is not None for tag in trace.tags),
        "noise": kinds,
    }


def _gap(gap: TraceGap) -> TraceGapDocument:
    return {
        "part": gap.part,
        "sample": int(gap.sample),
        "t_s": float(gap.t_s),
        "lost_s": float(gap.lost_s),
        "skipped_bytes": int(gap.skipped_bytes),
    }


def _left_out(rows: LeftOut) -> LeftOutRows:
    return {"part": rows.part, "what": rows.what, "count": int(rows.count), "reason": rows.reason}


def _tag(tag: ReadTag) -> TagDocument:
    reading: TagReading = tag.reading
    return {
        "start_s": round(reading.start_s, 4),
        "end_s": round(reading.end_s, 4),
        "tag": reading.tag.text if reading.tag is not None else None,
        "tuple": reading.tag.tuple_text if reading.tag is not None else None,
        "polarities": "".join(str(polarity) for polarity in reading.polarities),
        "gaps_m": [round(gap, 4) for gap in reading.gaps_m],
        "gap_std_m": [round(gap, 4) for gap in reading.gap_std_m],
        "length_m": round(reading.length_m, 4),
        "ratios": [round(ratio, 5) for ratio in reading.ratios],
        "ratio_std": [round(ratio, 5) for ratio in reading.ratio_std],
        "lateral_cm": round(reading.lateral_cm, 2),
        "direction": "wrong-way" if reading.wrong_way else ("legal" if reading.tag is not None else "unknown"),
        "missing": reading.missing,
        "extra": reading.extra,
        "confidence": float(reading.confidence),
        "match": _match(tag.match),
        "fix": tag_fix_document(tag.fix),
    }


def _match(match: TagMatch | None) -> TagMatchDocument | None:
    if match is None:
        return None
    tag = match.tag
    meaning = tag.meaning if tag is not None else None
    return {
        "registered": tag is not None,
        "marker_id": tag.marker_id if tag is not None else None,
        "status": tag.status if tag is not None else None,
        "localization_grade": tag.grade if tag is not None else None,
        "meaning": {"kind": meaning.kind.value, "value": meaning.value} if meaning is not None else None,
        "ambiguous": bool(match.others),
        "other_marker_ids": list(match.others),
        "note": match.note or None,
    }


def tag_fix_document(fix: TagFix | None) -> TagFixDocument | None:
    """A vehicle's position at a tag; the covariance is of east, north [m] and heading [rad]."""
    if fix is None:
        return None
    return {
        "t_s": round(fix.t_s, 4),
        "lon_deg": fix.lon_deg,
        "lat_deg": fix.lat_deg,
        "heading_deg": fix.heading_deg,
        "covariance": fix.covariance.tolist(),
        "sigma": {
            "along_m": fix.along_std_m,
            "across_m": fix.across_std_m,
            "heading_deg": float(np.degrees(np.sqrt(fix.covariance[2, 2]))),
        },
        "across_m": round(fix.across_m, 4),
        "localization_grade": str(fix.grade),
        "notes": list(fix.notes),
    }


def _crossing(crossing: LineCrossing) -> CrossingDocument:
    return {
        "t_s": round(crossing.t_s, 4),
        "odometer_m": round(crossing.odometer_m, 3),
        "style": str(crossing.style),
        "side": str(crossing.side),
        "lateral_cm": round(crossing.lateral_cm, 2),
        "confidence": float(crossing.confidence),
    }


def _magnet(magnet: MagnetReading) -> PassedMagnetDocument:
    return {
        "t_s": round(magnet.t_s, 4),
        "odometer_m": round(magnet.odometer_m, 3),
        "lateral_cm": round(magnet.lateral_cm, 2),
        "polarity": str(magnet.polarity),
        "phi_deg": magnet.phi_deg,
        "clearance_cm": round(magnet.clearance_cm, 2),
        "confidence": float(magnet.confidence),
        "along_std_m": round(magnet.along_std_m, 4) or None,  # the paper's pipeline has none
    }


def _noise(finding: NoiseFinding) -> NoiseDocument:
    return {
        "t_s": round(finding.t_s, 4),
        "odometer_m": round(finding.odometer_m, 3),
        "lateral_cm": round(finding.lateral_cm, 2),
        "kind": str(finding.kind),
        "reason": finding.reason,
    }
