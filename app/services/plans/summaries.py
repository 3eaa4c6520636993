"""Summaries of roads and plans, made where they are computed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import numpy as np

from app.markers.checks import Verdict
from app.planning.alignment import Alignment, Lane
from app.planning.outputs.bill import plan_bill
from app.planning.plan import Plan, PlanFinding
from app.planning.proof import ProofReport, UnitResult
from app.services.documents import document_of
from app.services.plans.documents import (
    EventSummary,
    FindingDocument,
    LaneSummary,
    LeftOutDocument,
    PlanSummary,
    RoadSummary,
)
from app.services.plans.proof_documents import ProofFigures, ProofTermsDocument, ReadRateDocument, WeakMarker

MAX_LISTED = 1000
"""Events, warnings and places left out that a summary lists; all are counted. Source: chosen by hand."""
MAX_WEAK = 100
"""Weak markers that the document of a plan lists; its report has all. Source: chosen by hand."""
_STRAIGHT_PER_M = 1e-5  # [1/m] below it a lane is straight; source: chosen by hand, a radius of 100 km


def road_summary(road: Alignment, format_name: str = "") -> RoadSummary:
    """What a road has."""
    return {
        "format": format_name,
        "lanes": [_lane_summary(lane) for lane in road.lanes],
        "events": [document_of(EventSummary, event) for event in road.events[:MAX_LISTED]],
        "areas": len(road.areas),
        "lane_length_m": road.lane_length_m,
        "extent_deg": extent_deg(road),
        "crs": road.crs,
        "realization": road.realization,
        "surveyed": road.surveyed,
        "localization_grade": str(road.grade),
        "warnings": list(road.warnings[:MAX_LISTED]),
    }


def plan_summary(plan: Plan) -> dict[str, Any]:
    """What a plan has, as `PlanSummary`."""
    bill = plan_bill(plan)
    summary: PlanSummary = {
        "counts": plan.counts,
        "lane_length_m": plan.alignment.lane_length_m,
        "verdict": worst_verdict(plan.findings),
        "findings": [document_of(FindingDocument, finding) for finding in plan.findings],
        "left_out": [document_of(LeftOutDocument, left) for left in plan.left_out[:MAX_LISTED]],
        "left_out_count": len(plan.left_out),
        "cost": bill.total,
        "cost_complete": bill.complete,
        "currency": bill.currency,
        "codebook_entries": len(plan.codebook.entries) if plan.codebook is not None else 0,
    }
    return dict(summary)


def proof_figures(report: ProofReport, results: Sequence[UnitResult]) -> dict[str, Any]:
    """What the plan's document shows of a proof, as `ProofFigures`."""
    figures: ProofFigures = {
        "passed": not report.wrong,
        "units": len(results),
        "rates": [document_of(ReadRateDocument, rate) for rate in report.rates],
        "markers": len(report.markers),
        "weak": len(report.weak),
        "wrong": len(report.wrong),
        "weak_markers": [document_of(WeakMarker, marker) for marker in report.weak[:MAX_WEAK]],
        "terms": cast("ProofTermsDocument", report.terms.model_dump(mode="json")),
    }
    return dict(figures)


def worst_verdict(findings: tuple[PlanFinding, ...]) -> str:
    """The worst verdict of all findings."""
    found = {finding.verdict for finding in findings}
    return str(next((verdict for verdict in (Verdict.FAIL, Verdict.WARN) if verdict in found), Verdict.OK))


def extent_deg(road: Alignment) -> list[float]:
    """West, south, east, north of all lanes; the shorter way round the Earth. [deg]"""
    lon = np.concatenate([lane.lon_deg for lane in road.lanes])
    lat = np.concatenate([lane.lat_deg for lane in road.lanes])
    across = (lon - lon[0] + 180.0) % 360.0 - 180.0
    west, east = ((lon[0] + value + 180.0) % 360.0 - 180.0 for value in (across.min(), across.max()))
    return [float(west), float(lat.min()), float(east), float(lat.max())]


def _lane_summary(lane: Lane) -> LaneSummary:
    sharpest = float(np.abs(lane.curvature_per_m).max())
    speed = lane.design_speed_mps * 3.6
    return {
        "name": lane.name,
        "road": lane.road,
        "length_m": lane.length_m,
        "width_m": [float(lane.width_m.min()), float(lane.width_m.max())],
        "design_speed_kmh": [float(speed.min()), float(speed.max())] if np.isfinite(speed).all() else None,
        "min_radius_m": 1 / sharpest if sharpest > _STRAIGHT_PER_M else None,
        "max_grade": float(np.abs(lane.grade).max()),
        "left_style": str(lane.left_style),
        "right_style": str(lane.right_style),
    }
