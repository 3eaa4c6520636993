"""Proofs of plans, inside a decoder process."""

from __future__ import annotations

import zlib
from functools import lru_cache

import orjson

from app.jobs.memory_limit import memory_is_the_limit
from app.planning.outputs.plan_document import read_plan
from app.planning.proof import ProofTerms, ProofUnit, UnitResult, summarize
from app.planning.proof.documents import markers_csv, report_document
from app.planning.proof.prove import Prover
from app.services.plans.proof_tasks import ListUnitsTask, ProveUnitTask, WriteProofTask, WrittenProof
from app.services.plans.summaries import proof_figures

_CURE = "cut the road into sections"


def list_proof_units(task: ListUnitsTask, _before: None) -> list[ProofUnit]:
    """Divide a proof into units."""
    with memory_is_the_limit("plan", _CURE):
        prover = _prover(task.document, task.terms)
        prover.check_size()
        return [] if task.only_check else prover.list_units()


def prove_unit(task: ProveUnitTask, _before: None) -> UnitResult:
    """Drive a unit of a proof."""
    with memory_is_the_limit("plan", _CURE):
        return _prover(task.document, task.terms).prove_unit(task.unit)


def write_proof(task: WriteProofTask, _before: None) -> WrittenProof:
    """Write the report of a proof."""
    with memory_is_the_limit("plan", _CURE):
        report = summarize(_prover(task.document, task.terms).plan, task.terms, task.results)
        document = orjson.dumps(report_document(report), option=orjson.OPT_SERIALIZE_NUMPY)
        table = markers_csv(report).encode()
        return WrittenProof(zlib.compress(document, 6), zlib.compress(table, 6), proof_figures(report, task.results))


@lru_cache(maxsize=1)
def _prover(document: bytes, terms: ProofTerms) -> Prover:
    """A plan with what its units share: one a process, kept until another plan is proved."""
    return Prover(read_plan(zlib.decompress(document)), terms)
