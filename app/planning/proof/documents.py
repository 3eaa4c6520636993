"""The report of a proof as a JSON document and as a table of markers."""

from __future__ import annotations

import io
from dataclasses import asdict, fields
from typing import Any

from app.formats.spreadsheet import TableWriter
from app.planning.proof.report import MarkerProof, ProofReport

PROOF_FORMAT = "waymark-proof/1"
NOTE = (
    "Simulated drives: rates are of passes, weighted by strata where markers are sampled; intervals are Wilson's of "
    "95 %, which take passes as independent. Light, wear and dirt are drawn from the ranges of "
    "app/simulation/conditions.py."
)
"""What the figures are, in every document."""


def report_document(report: ProofReport) -> dict[str, Any]:
    """The report as JSON values."""
    return {
        "format": PROOF_FORMAT,
        "plan": report.plan,
        "terms": report.terms.model_dump(mode="json"),
        "complete": report.complete,
        "note": NOTE,
        "rates": [asdict(rate) for rate in report.rates],
        "drives": [asdict(drive) for drive in report.drives],
        "weak": [marker.number for marker in report.weak],
        "wrong": [{"drive": drive, "marker": marker, "text": text} for drive, marker, text in report.wrong],
        "markers": [asdict(marker) for marker in report.markers],
    }


def markers_csv(report: ProofReport) -> str:
    """One row a marker that was driven over; empty where a figure is unknown."""
    stream = io.StringIO()
    writer = TableWriter(stream, "\n")
    names = [field.name for field in fields(MarkerProof)]
    writer.write_row(names)
    for marker in report.markers:
        writer.write_row(getattr(marker, name) for name in names)
    return stream.getvalue()
