"""Queries on finished units of proofs, from which an interrupted proof goes on."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import sqlalchemy as sa

from app.registry.jobs import UNFINISHED
from app.registry.tables import jobs, proof_units


def add_unit(connection: sa.Connection, agency_id: str, job_id: str, number: int, result: Mapping[str, Any]) -> None:
    """Store the result of a unit that is not stored yet."""
    values = {"job_id": job_id, "number": number, "agency_id": agency_id, "result": dict(result)}
    connection.execute(sa.insert(proof_units).values(values))


def list_units(connection: sa.Connection, agency_id: str, job_id: str) -> dict[int, dict[str, Any]]:
    """Results of the finished units of a job, by the units' numbers."""
    c = proof_units.c
    query = sa.select(c.number, c.result).where(c.job_id == job_id, c.agency_id == agency_id)
    return {row.number: row.result for row in connection.execute(query)}


def delete_units(connection: sa.Connection, agency_id: str) -> None:
    """Remove the units of all jobs of an agency that have ended."""
    ended = sa.select(jobs.c.id).where(jobs.c.agency_id == agency_id, jobs.c.state.not_in(UNFINISHED))
    c = proof_units.c
    connection.execute(sa.delete(proof_units).where(c.agency_id == agency_id, c.job_id.in_(ended)))
