"""Report of a plan for people: counts, cost, findings, and what was left out, as Markdown."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from app.markers.checks import Verdict
from app.planning.alignment import format_station
from app.planning.outputs.bill import plan_bill, plan_quantities
from app.planning.plan import Plan, PlanFinding

_MAX_LEFT_OUT = 200
"""Places left out that the report lists. Source: chosen by hand; plan.json has all of them."""

_ZERO = 1e-9  # what is shown as 0; source: chosen by hand, rounding of sums of metres
_COUNTED = {"plate": "plates", "magnet": "magnets", "tag": "information tags", "cerpm": "CERPMs"}


def counts_sentence(plan: Plan) -> str:
    """What is installed, for people."""
    found = plan_quantities(plan)
    parts = [
        f"{found[unit]:g} {name if found[unit] != 1 else name[:-1]}" for unit, name in _COUNTED.items() if found[unit]
    ]
    days = found["day"]
    work = "" if days is None else f"; {days:g} working day{'s' if days != 1 else ''}"
    return ", ".join(part for part in parts if not part.startswith("0 ")) + work


def verdict_counts(plan: Plan) -> dict[Verdict, int]:
    """Findings by verdict."""
    counts = Counter(finding.verdict for finding in plan.findings)
    return {verdict: counts.get(verdict, 0) for verdict in Verdict}


def finding_place(plan: Plan, finding: PlanFinding) -> str:
    """Where a finding is: lane and displayed station; empty for the whole plan."""
    if finding.lane is None and finding.station_m is None:
        return ""
    station = ""
    if finding.station_m is not None:
        station = f" at {format_station(plan.alignment.displayed_station_m(finding.station_m))}"
    return f"lane {finding.lane}{station}" if finding.lane is not None else station.strip()


def finding_figures(finding: PlanFinding) -> tuple[str, str]:
    """Figure and limit of a finding with their unit, for people."""
    unit = f" {finding.unit}" if finding.unit else ""
    figure = 0.0 if abs(finding.figure) < _ZERO else finding.figure
    return f"{figure:.5g}{unit}", f"{finding.relation} {finding.limit:.5g}{unit}"


def write_report(plan: Plan, missing_files: Mapping[str, str] | None = None) -> bytes:
    """The report as Markdown in UTF-8.

    Parameters
    ----------
    plan : Plan
    missing_files : mapping of str to str, optional
        Files that cannot be written of this plan, with the reason.
    """
    road = plan.alignment
    lines = [f"# Plan {_cell(plan.name)}", ""]
    if not road.surveyed:
        lines += ["**PLANNED - POSITIONS NOT SURVEYED**: the road was placed by an origin.", ""]
    length_km = road.lane_length_m / 1000
    lines += [
        f"Road {_cell(road.name)}: {len(road.lanes)} lanes, {length_km:.3f} km of lane, {len(road.events)} events, "
        f"{len(road.areas)} areas to avoid. Positions: grade {road.grade}; {road.crs}.",
        "",
        *(f"- Warning: {_cell(warning)}" for warning in road.warnings),
        *([""] if road.warnings else []),
        "## Markers",
        "",
        "| what | quantity |",
        "|---|---:|",
    ]
    lines += [f"| {name.replace('_', ' ')} | {value:g} |" for name, value in plan_quantities(plan).items() if value]
    bill = plan_bill(plan)
    lines += ["", "## Cost", "", bill.sentence + ".", "", "## Checks", ""]
    if plan.findings:
        lines += ["| check | verdict | figure | limit | where | result | source |", "|---|---|---:|---:|---|---|---|"]
    for finding in plan.findings:
        figure, limit = finding_figures(finding)
        cells = (finding.name, finding.verdict.value, figure, limit, finding_place(plan, finding), finding.sentence,
                 finding.source)  # fmt: skip
        lines.append("| " + " | ".join(_cell(cell) for cell in cells) + " |")
    lines += ["", "## Left out and moved", ""]
    for left in plan.left_out[:_MAX_LEFT_OUT]:
        what = "left out" if left.moved_m is None else f"moved by {left.moved_m:.2f} m"
        lines.append(f"- {left.family}, lane {_cell(left.lane)}, {left.chainage_m:.1f} m: {what}: {_cell(left.reason)}")
    if len(plan.left_out) > _MAX_LEFT_OUT:
        lines.append(f"- and {len(plan.left_out) - _MAX_LEFT_OUT} more, in plan.json")
    if not plan.left_out:
        lines.append("Nothing.")
    if missing_files:
        lines += ["", "## Files that are left out", ""]
        lines += [f"- {name}: {_cell(reason)}" for name, reason in missing_files.items()]
    return ("\n".join(lines) + "\n").encode()


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")
