"""The proof of a plan: simulated drives through the real encoders, simulation and decoders (`prove`)."""

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
    "ReadRate",
    "UnitKind",
    "UnitResult",
    "summarize",
    "wilson",
]
