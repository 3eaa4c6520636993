"""Runs the units of a proof in several processes; finished units are kept in a file, from which a later run goes on."""

from __future__ import annotations

import hashlib
import multiprocessing
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

import orjson

from app.errors import UnreadableUpload
from app.families import rows_of_plan
from app.planning.outputs.plan_document import read_plan
from app.planning.proof import ProofReport, ProofTerms, ProofUnit, UnitResult, summarize
from app.planning.proof.drives import START
from app.planning.proof.prove import Prover
from app.values import JsonObject

Progress = Callable[[int, int], None]
"""Called with the number of finished units and of all."""
_prover: Prover | None = None  # of this worker process


def run_proof(plan_file: Path, terms: ProofTerms, results_file: Path, workers: int, progress: Progress) -> ProofReport:
    """Prove the plan of a file.

    Parameters
    ----------
    plan_file : Path
        As `write_plan` writes it.
    results_file : Path
        One JSON object a line: what is proved, then the results of units. Units that it has already, of the same plan
        and terms, are not computed again; of another plan or other terms it is replaced.
    workers : int
        Processes; 1 computes in this one.

    Raises
    ------
    UnreadableUpload
        The plan's file is no plan.
    """
    data = plan_file.read_bytes()
    prover = _prover_of(data, terms)
    units = prover.list_units()
    header = {"plan": hashlib.sha256(data).hexdigest(), "terms": terms.model_dump(mode="json")}
    results = _finished(results_file, header)
    wanted = [unit for unit in units if unit.key not in results]
    progress(len(results), len(units))
    with results_file.open("ab") as file:
        if file.tell() == 0:
            file.write(orjson.dumps(header) + b"\n")
        for result in _compute(plan_file, prover, wanted, workers):
            results[result["key"]] = result
            file.write(orjson.dumps(result) + b"\n")
            file.flush()
            progress(len(results), len(units))
    return summarize(prover.plan, terms, [results[unit.key] for unit in units])


def _finished(results_file: Path, header: JsonObject) -> dict[str, UnitResult]:
    """Results of an earlier run of the same; the file is left with whole lines of it, or removed."""
    if not results_file.exists():
        return {}
    lines = results_file.read_bytes().split(b"\n")
    whole = lines[:-1]  # what follows the last line's end was cut off
    try:
        if not whole or orjson.loads(whole[0]) != orjson.loads(orjson.dumps(header)):
            results_file.unlink()
            return {}
        results: list[UnitResult] = [orjson.loads(line) for line in whole[1:]]
    except orjson.JSONDecodeError as error:
        raise UnreadableUpload(
            f"{results_file.name} is damaged", field=str(results_file), limit="one JSON object a line",
            cure="remove the file; the proof then starts from the beginning",
        ) from error  # fmt: skip
    if lines[-1]:
        results_file.write_bytes(b"".join(line + b"\n" for line in whole))
    return {result["key"]: result for result in results}


def _compute(plan_file: Path, prover: Prover, units: list[ProofUnit], workers: int) -> Iterator[UnitResult]:
    if workers == 1 or len(units) < 2:
        yield from map(prover.prove_unit, units)
        return
    pool = ProcessPoolExecutor(
        min(workers, len(units)), multiprocessing.get_context("spawn"), _start, (plan_file, prover.terms)
    )
    try:
        for done in as_completed([pool.submit(_work, unit) for unit in units]):
            yield done.result()
    finally:
        pool.shutdown(cancel_futures=True)


def _start(plan_file: Path, terms: ProofTerms) -> None:
    """Prepare a worker process."""
    global _prover
    _prover = _prover_of(plan_file.read_bytes(), terms)


def _prover_of(data: bytes, terms: ProofTerms) -> Prover:
    plan = read_plan(data)
    return Prover(plan, terms, rows_of_plan(plan, START))


def _work(unit: ProofUnit) -> UnitResult:
    assert _prover is not None
    return _prover.prove_unit(unit)
