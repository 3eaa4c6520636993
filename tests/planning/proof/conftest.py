"""Small plans for proofs: a marker or two of each family on a short road."""

from __future__ import annotations

import pytest

from app.families import rows_of_plan
from app.formats.alignments.geometry import EventKind
from app.planning.alignment import Lane, RoadEvent
from app.planning.placement import place_plan
from app.planning.plan import Plan
from app.planning.proof import ProofReport, ProofTerms
from app.planning.proof.drives import START
from app.planning.proof.prove import Prover, prove_plan
from app.planning.rules import PlanRules
from tests.planning.roads import bend, opposite, road, straight


def plan_on(*lanes: Lane, events: tuple[RoadEvent, ...] = (), **rules: object) -> Plan:
    """A plan of lanes by rules."""
    checked = PlanRules.model_validate({"version": 1, **rules})
    return place_plan(road(*lanes, events=events), checked, name="proof")


def prover_of(plan: Plan, terms: ProofTerms) -> Prover:
    """The prover of a plan, with the rows that its commit stores."""
    return Prover(plan, terms, rows_of_plan(plan, START))


def prove(plan: Plan, terms: ProofTerms) -> ProofReport:
    """The whole proof of a plan."""
    return prove_plan(plan, terms, rows_of_plan(plan, START))


@pytest.fixture(scope="session")
def plates() -> Plan:
    """Two plates on 200 m at 50 km/h."""
    return plan_on(straight(200, speed_kmh=50.0), plates={"spacing_m": 100})


@pytest.fixture(scope="session")
def magnets() -> Plan:
    """One tag ahead of a stop line, and line magnets on both sides of a lane that bends."""
    stop = RoadEvent(EventKind.STOP_LINE, "1", 160.0)
    return plan_on(bend(150.0, 60, 40.0, speed_kmh=40.0), events=(stop,), tags={}, lines={})


@pytest.fixture(scope="session")
def cerpms() -> Plan:
    """CERPMs along both lanes of a road with a bend."""
    lane = bend(150.0, 60, 40.0, speed_kmh=50.0)
    return plan_on(lane, opposite(lane, "2"), cerpm={})
