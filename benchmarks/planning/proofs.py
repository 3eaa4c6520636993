"""Proofs of plans by the example rules of docs/plans on roads from OpenDRIVE files, and of the demo's plan."""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

from app.formats.alignments.geometry import AlignmentDeclaration
from app.formats.alignments.read import read_alignment
from app.planning.build_alignment import build_alignment
from app.planning.plan import Plan
from app.planning.planner import make_plan
from app.planning.proof import ProofReport, ProofTerms, summarize
from app.planning.proof.report import LanePath
from app.planning.rules import read_rules
from benchmarks.planning.roads import prover_of
from benchmarks.planning.tables import Section, table

SEED = 31
"""Of the drives; nothing was chosen by them."""
PATH_GOAL_M = 0.05
"""[m] RMS of every path from the centre line. Source: `max_path_error_m` of the rules."""
_ROOT = Path(__file__).resolve().parents[2]
_ORIGIN_DEG = (12.0, 57.6)


class Example(NamedTuple):
    """A road and rules, as `waymark plan` takes them."""

    name: str
    road: str
    rules: str


_ROADS, _RULES = "tests/data/opendrive", "docs/plans"
EXAMPLES = (
    Example("motorway, six lanes", f"{_ROADS}/e6mini.xodr", f"{_RULES}/rules-lanes-cerpms.yaml"),
    Example("two lanes, bends and grades", f"{_ROADS}/curves_elevation.xodr", f"{_RULES}/rules-lanes-cerpms.yaml"),
    Example("lanes that begin and end", f"{_ROADS}/two_plus_one.xodr", f"{_RULES}/rules-lanes-cerpms.yaml"),
    Example("side road at a junction", f"{_ROADS}/jolengatan.xodr", f"{_RULES}/rules-lanes-cerpms.yaml"),
    Example("two lanes, work zone", f"{_ROADS}/curves_elevation.xodr", f"{_RULES}/rules-work-zone-cerpms.yaml"),
    Example("two lanes, plates", f"{_ROADS}/curves_elevation.xodr", f"{_RULES}/rules-rural-plates.yaml"),
    Example("city street, magnets", f"{_ROADS}/fabriksgatan.xodr", f"{_RULES}/rules-city-magnets.yaml"),
    Example("the demo's motorway", "app/demo/data/e6.xodr", "app/demo/data/e6-rules.yaml"),
)


def measure_proofs(short: bool) -> Section:
    """One row an example: what its vehicles read."""
    terms = ProofTerms(drives=1, seed=SEED, max_markers_per_drive=4, max_sections_per_drive=1 if short else 40)
    rows, met, refused = [], True, []
    for example in EXAMPLES[:2] if short else EXAMPLES:
        plan = _plan_of(example)
        prover = prover_of(plan, terms)
        results = [prover.prove_unit(unit) for unit in prover.list_units()]
        report = summarize(plan, terms, results)
        paths = [result["path"] for result in results if result["path"] is not None]
        good = [path for path in paths if path["refusal"] is None]
        worst = max(good, key=_rms_m, default=None)
        met &= not report.wrong and len(good) == len(paths) and all(_rms_m(path) <= PATH_GOAL_M for path in good)
        refused += [f"{example.name}: {path['refusal']}" for path in paths if path["refusal"] is not None]
        rows.append((
            example.name, len(plan.alignment.lanes), len(plan.markers), _failed(plan), _read(report), _fixes(report),
            f"{len(good)} of {len(paths)}" if paths else "-",
            _heard(paths), _cm(_rms_all(good)), _cm(None if worst is None else _rms_m(worst)), len(report.wrong),
        ))  # fmt: skip
    head = (
        "plan", "lanes", "markers", "failed checks", "read of passed", "fix RMS [cm]", "stretches with a path",
        "CERPMs received", "path RMS [cm]", "worst stretch [cm]", "wrong readings",
    )  # fmt: skip
    text = (
        "Plans by the example rules on roads from OpenDRIVE files (`tests/data/opendrive`), and the demo's plan. Each "
        "simulated drive is decoded as an upload: files, context and rows of the registry after commit and survey, "
        "RTK receiver, all lanes' markers within radio range. Up to four plates and tags, 40 stretches of line magnets "
        f"and all stretches of lanes with CERPMs (500 m each); seed {SEED}.\n\n{table(head, rows)}\n\n"
        f"Goals: no wrong reading, a path on every stretch, at most {100 * PATH_GOAL_M:.0f} cm RMS."
    )
    if refused:
        text += "\n\nStretches without a path:\n\n" + "\n".join(f"- {line}" for line in refused)
    return Section("planning-proofs", text, met)


def _plan_of(example: Example) -> Plan:
    rules = read_rules((_ROOT / example.rules).read_bytes())
    path = _ROOT / example.road
    declaration = AlignmentDeclaration(origin=_ORIGIN_DEG, ignore_heights=True)
    file = read_alignment(path.read_bytes(), path.name, declaration=declaration)
    road = build_alignment(file, rules.road, declaration, name=path.stem)
    return make_plan(road, rules, name=example.name)


def _failed(plan: Plan) -> str:
    return ", ".join(sorted({found.name for found in plan.findings if found.verdict == "fail"})) or "-"


def _read(report: ProofReport) -> str:
    found = [f"{rate.kind} {rate.read} of {rate.passes}" for rate in report.rates if rate.condition == "all"]
    return ", ".join(found) or "-"


def _fixes(report: ProofReport) -> str:
    errors = [marker.fix_rms_m for marker in report.markers if marker.fix_rms_m is not None]
    return _cm(math.sqrt(sum(error**2 for error in errors) / len(errors)) if errors else None)


def _heard(paths: list[LanePath]) -> str:
    count = sum(path["markers"] for path in paths)
    return f"{sum(path['received'] for path in paths) / count:.0%}" if count else "-"


def _rms_m(path: LanePath) -> float:
    return math.sqrt(path["square_sum_m2"] / max(path["covered"], 1))


def _rms_all(paths: list[LanePath]) -> float | None:
    covered = sum(path["covered"] for path in paths)
    return math.sqrt(sum(path["square_sum_m2"] for path in paths) / covered) if covered else None


def _cm(value_m: float | None) -> str:
    return "-" if value_m is None else f"{100 * value_m:.1f}"
