"""The result of one design check: its figure, the limit and the limit's source."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Literal


@dataclass(frozen=True, slots=True)
class ComparedFigure:
    """A figure beside its limit.

    Attributes
    ----------
    name : str
        Which check, e.g. ``magnet-spacing`` or ``dwell-time``.
    figure : float
        What the layout or the plan has, in `unit`.
    relation : ">=" or "<="
        How the figure must compare with the limit.
    limit : float
    unit : str
    source : str
        Where the limit comes from.
    """

    name: str
    figure: float
    relation: Literal[">=", "<="]
    limit: float
    unit: str
    source: str


@dataclass(frozen=True, slots=True)
class Check(ComparedFigure):
    """One check of a magnet layout; `note` describes the figure for people."""

    passed: bool
    note: str


class Verdict(StrEnum):
    """How a check ended."""

    OK = "ok"
    WARN = "warn"
    FAIL = "fail"


@dataclass(frozen=True, slots=True)
class RadioFinding(ComparedFigure):
    """One check of a radio plan, which may end between passed and failed; `sentence` gives the result for people."""

    verdict: Verdict
    sentence: str

    @property
    def passed(self) -> bool:
        """Whether nothing is wrong."""
        return self.verdict is Verdict.OK


def at_most(
    name: str, figure: float, limit: float, unit: str, source: str, sentence: str, *, worst: Verdict = Verdict.FAIL
) -> RadioFinding:
    """A finding that is well where the figure is no more than the limit, else `worst`."""
    met = figure <= limit * (1 + 1e-9)
    return RadioFinding(name, figure, "<=", limit, unit, source, Verdict.OK if met else worst, sentence)


def at_least(
    name: str, figure: float, limit: float, unit: str, source: str, sentence: str, *, worst: Verdict = Verdict.FAIL
) -> RadioFinding:
    """A finding that is well where the figure is no less than the limit, else `worst`."""
    met = figure >= limit - 1e-9 * abs(limit)
    return RadioFinding(name, figure, ">=", limit, unit, source, Verdict.OK if met else worst, sentence)
