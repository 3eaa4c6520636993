"""The proof of a plan: simulated drives through the real encoders, simulation and decoders."""

from app.planning.proof.prove import Prover, list_units, prove_plan, prove_unit
from app.planning.proof.report import DriveResult, MarkerProof, ProofReport, ReadRate, summarize, wilson
from app.planning.proof.results import UnitResult
from app.planning.proof.terms import Condition, ProofTerms, ProofUnit, UnitKind

__all__ = [
    "Condition",
    "DriveResult",
    "MarkerProof",
    "ProofReport",
    "ProofTerms",
    "ProofUnit",
    "Prover",
    "ReadRate",
    "UnitKind",
    "UnitResult",
    "list_units",
    "prove_plan",
    "prove_unit",
    "summarize",
    "wilson",
]
