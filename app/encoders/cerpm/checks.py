"""One check of a radio plan: its figure, the limit, where the limit comes from, and what follows."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Literal


class Verdict(StrEnum):
    """How a check ended."""

    OK = "ok"
    WARN = "warn"
    FAIL = "fail"


@dataclass(frozen=True, slots=True)
class RadioFinding:
    """One check, as magnet layouts have them, with a verdict between passed and failed.

    Attributes
    ----------
    name : str
        Which check, e.g. ``dwell-time``.
    figure : float
        What the plan has, in `unit`.
    relation : ">=" or "<="
        How the figure must stand to the limit.
    limit : float
    unit : str
    source : str
        Where the limit comes from.
    verdict : Verdict
    sentence : str
        What the figure is and what follows, for people.
    """

    name: str
    figure: float
    relation: Literal[">=", "<="]
    limit: float
    unit: str
    source: str
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
