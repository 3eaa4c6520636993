"""Who sees and cancels jobs of each kind, and where their results are: the rules of the resources that they make."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from app.registry.jobs import JobKind, JobRow
from app.services.access.access import AGENCY_SCOPES, Caller, Scope
from app.services.surveys.imports import SETTLED

_EVERYBODY = frozenset(AGENCY_SCOPES)
_READERS = _EVERYBODY - {Scope.VEHICLE}
_SURVEYORS = _READERS - {Scope.VIEWER}
_PLANNERS = frozenset({Scope.PLANNER, Scope.ADMIN})


@dataclass(frozen=True, slots=True)
class JobRules:
    """What holds for the jobs of one kind.

    Attributes
    ----------
    readers, cancellers : frozenset of Scope
        Scopes of keys that may read them, and that may cancel those of others of the agency.
    result_path : callable
        Path of the result of a job that is done; None if it has none.
    too_late_progress : float
        A job beyond this progress cannot be cancelled any more; over 1: it always can.
    """

    readers: frozenset[Scope]
    cancellers: frozenset[Scope]
    result_path: Callable[[JobRow], str | None]
    too_late_progress: float = 2.0


def _about_plan(end: str) -> Callable[[JobRow], str | None]:
    return lambda job: f"/v1/plans/{job.subject_id}{end}" if job.subject_id is not None else None


RULES: dict[str, JobRules] = {
    JobKind.DECODE: JobRules(
        _EVERYBODY, _EVERYBODY - {Scope.VIEWER}, lambda job: f"/v1/decodes/{job.id}"
    ),
    JobKind.IMPORT: JobRules(_SURVEYORS, _SURVEYORS, lambda job: f"/v1/imports/{job.id}", SETTLED),
    JobKind.PLAN: JobRules(_READERS, _PLANNERS, _about_plan("")),
    JobKind.PROOF: JobRules(_READERS, _PLANNERS, _about_plan("/proof")),
    JobKind.PACKAGE: JobRules(_READERS, _PLANNERS, _about_plan("/package")),
    JobKind.ARTWORK: JobRules(_READERS, _PLANNERS, lambda job: f"/v1/jobs/{job.id}/result"),
    JobKind.EXPORT: JobRules(_READERS, _PLANNERS, lambda job: f"/v1/jobs/{job.id}/result"),
    JobKind.REPROCESS: JobRules(
        frozenset({Scope.ADMIN}), frozenset({Scope.ADMIN}), lambda job: f"/v1/reprocessings/{job.subject_id}"
    ),
    JobKind.DRIVE: JobRules(
        _EVERYBODY, _EVERYBODY - {Scope.VIEWER}, lambda job: f"/v1/drives/{job.id}"
    ),
    JobKind.AUDIT: JobRules(
        frozenset({Scope.ADMIN}), frozenset({Scope.ADMIN}), lambda job: f"/v1/audit/verifications/{job.id}"
    ),
}  # fmt: skip
_OTHERS = JobRules(frozenset({Scope.ADMIN}), frozenset({Scope.ADMIN}), lambda _job: None)


def rules_of(kind: str) -> JobRules:
    """The rules of a kind; one that is not listed is for administrators."""
    return RULES.get(kind, _OTHERS)


def visible_kinds(caller: Caller) -> list[JobKind]:
    """Kinds of jobs that a caller may read."""
    return [kind for kind in JobKind if caller.scope in rules_of(kind).readers]


def may_cancel(caller: Caller, job: JobRow) -> bool:
    """Whether a caller may cancel a job that it sees: its own, or any of its agency by its scope."""
    return job.holder_id == caller.key_id or caller.scope in rules_of(job.kind).cancellers
