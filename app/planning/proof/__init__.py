"""The proof of a plan: simulated drives through the real encoders, simulation and decoders (`prove`)."""

from app.planning.proof.report import (
    Condition,
    DriveResult,
    MarkerProof,
    ProofReport,
    ProofTerms,
    ProofUnit,
    ReadRate,
    UnitKind,
    UnitResult,
    summarize,
    wilson,
)

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
