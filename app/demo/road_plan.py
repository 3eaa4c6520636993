"""The demo's plan: a stretch of motorway gets markers of three families, which are checked, costed and proved."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path

import httpx

from app.demo.server import checked
from app.demo.table import draw_rows
from app.errors import WaymarkError
from app.planning.rules import read_rules
from app.values import JsonObject

ROAD, RULES = "e6.xodr", "e6-rules.yaml"
ORIGIN_DEG = (12.0, 57.6)  # near the E6 in Sweden; the file's own system cannot be used
TERMS = {"drives": 2, "seed": 7, "conditions": ["day", "wear"], "max_markers_per_drive": 4, "max_sections_per_drive": 1}
FILES = ("report.md", "bill.csv", "schedule.csv", "drawings.pdf", "stakeout.gpkg", "plan.geojson", "cerpm-programs.csv")
PATH_WITHIN_M = 0.1
"""Largest RMS error of a path in the proof that counts as right. [m]"""
_POLL_S, _PATIENCE_S = 0.2, 600.0
_FAMILIES = {"plate": "plates", "magnet": "line magnets", "cerpm": "CERPMs"}
_HEAD = ("condition", "read", "passes", "read", "share", "95 % interval")


@dataclass(slots=True)
class PlanResult:
    """A plan that was placed, checked, costed and proved."""

    plan: dict[str, object]  # as the server has it
    proof: JsonObject = field(default_factory=dict)  # its report

    @property
    def path_rms_m(self) -> list[float]:
        """Of every drive that has a path. [m]"""
        return [drive["path_rms_m"] for drive in self.proof["drives"] if drive["path_rms_m"] is not None]

    @property
    def is_good(self) -> bool:
        """Whether no check failed, no reading was wrong, and every path follows its lane."""
        paths = self.path_rms_m
        right = not self.proof["wrong"] and bool(paths) and max(paths) < PATH_WITHIN_M
        return self.plan["verdict"] != "fail" and right


def plan_road(client: httpx.Client, folder: Path) -> PlanResult:
    """Upload the road, make the plan, and fetch its files."""
    folder.mkdir(parents=True, exist_ok=True)
    data = files("app.demo") / "data"
    declaration = {"name": "E6", "origin": ORIGIN_DEG, "ignore_heights": True}
    parts: JsonObject = {
        "file": (ROAD, data.joinpath(ROAD).read_bytes(), "application/xml"),
        "declaration": (None, json.dumps(declaration)),
    }
    road = checked(client.post("/v1/alignments", files=parts)).json()
    rules = read_rules(data.joinpath(RULES).read_bytes()).model_dump(mode="json", exclude_unset=True, by_alias=True)
    wanted = {"name": "E6, three families", "alignment_id": road["id"], "rules": rules}
    plan = checked(client.post("/v1/plans", json=wanted)).json()
    for name in FILES:
        (folder / name).write_bytes(checked(client.get(f"/v1/plans/{plan['id']}/files/{name}")).content)
    return PlanResult(plan)


def prove_road(client: httpx.Client, made: PlanResult, folder: Path) -> None:
    """Let the server drive over the plan in simulation, and fetch the report."""
    path = f"/v1/plans/{made.plan['id']}"
    job = checked(client.post(f"{path}/proof", json=TERMS, headers={"If-Match": f'"{made.plan["version"]}"'}))
    patience = time.monotonic() + _PATIENCE_S
    while (state := checked(client.get(job.headers["Location"])).json())["state"] not in ("done", "failed"):
        if time.monotonic() > patience:
            raise WaymarkError("the proof of the plan did not end")
        time.sleep(_POLL_S)
    if state["state"] == "failed":
        raise WaymarkError(f"the proof of the plan failed: {state['error']}")
    report = checked(client.get(f"{path}/proof"))
    (folder / "proof.json").write_bytes(report.content)
    made.proof = report.json()
    made.plan = checked(client.get(path)).json()


def describe_plan(plan: JsonObject) -> list[str]:
    """What was placed, what it costs, and what the checks found."""
    counts = ", ".join(f"{plan['counts'][family]} {label}" for family, label in _FAMILIES.items())
    verdicts = [finding["verdict"] for finding in plan["findings"]]
    lines = [
        f"Placed {counts} on {plan['lane_length_m'] / 1000:.2f} km of lane of the E6 in Sweden: "
        f"{plan['cost']:,.0f} {plan['currency']} at",
        f"the unit costs of the rules. Checks: {verdicts.count('ok')} ok, {verdicts.count('warn')} warnings, "
        f"{verdicts.count('fail')} failed.",
    ]
    return lines + [f"  {f['verdict']}: {f['name']}: {f['sentence']}" for f in plan["findings"] if f["verdict"] != "ok"]


def draw_plan_table(made: PlanResult) -> str:
    """Table of what the simulated drives read."""
    rows: list[Sequence[str]] = [
        (
            rate["condition"],
            {"line": "line magnets"}.get(rate["kind"], rate["kind"]),
            str(rate["passes"]),
            str(rate["read"]),
            f"{100 * rate['rate']:.0f} %",
            f"{100 * rate['low']:.0f} to {100 * rate['high']:.0f} %",
        )
        for rate in made.proof["rates"]
    ]
    return draw_rows(_HEAD, rows, left=2)


def describe_proof(made: PlanResult) -> list[str]:
    """Paths, fixes and wrong readings of the drives."""
    fixes = [drive["fix_rms_m"] for drive in made.proof["drives"] if drive["fix_rms_m"] is not None]
    return [
        f"Paths from CERPMs: {100 * min(made.path_rms_m):.1f} to {100 * max(made.path_rms_m):.1f} cm RMS from the "
        "lane's centre line;",
        f"fixes at plates: {100 * max(fixes, default=0.0):.1f} cm RMS or less.",
        f"Wrong readings: {len(made.proof['wrong'])}. The plan is {made.plan['status']}.",
    ]
