"""What decoder processes are asked to do for proofs of plans."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from app.planning.proof import ProofTerms, ProofUnit, UnitResult
from app.services.decoder_processes import Task


@dataclass(frozen=True, slots=True)
class ListUnitsTask(Task[list[ProofUnit]]):
    """A proof to divide into units; of one that is only checked, the list is empty."""

    document: bytes
    terms: ProofTerms
    only_check: bool = False


@dataclass(frozen=True, slots=True)
class ProveUnitTask(Task[UnitResult]):
    """A unit of a proof to drive."""

    document: bytes
    terms: ProofTerms
    unit: ProofUnit


@dataclass(frozen=True, slots=True)
class WrittenProof:
    """A finished proof.

    Attributes
    ----------
    report : bytes
        JSON, as `app.planning.proof.documents.report_document` makes it, compressed by zlib.
    table : bytes
        CSV with the markers that were driven over, compressed by zlib.
    summary : dict
        What the plan's document shows, as `ProofFigures`.
    """

    report: bytes
    table: bytes
    summary: dict[str, Any]


@dataclass(frozen=True, slots=True)
class WriteProofTask(Task[WrittenProof]):
    """A proof to report, from the results of all its units."""

    document: bytes
    terms: ProofTerms
    results: list[UnitResult]
