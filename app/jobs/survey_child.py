"""A survey, read inside a decoder process."""

from __future__ import annotations

from dataclasses import dataclass

from app.jobs.memory import memory_is_the_limit
from app.registry.exchange.read import read_survey
from app.registry.exchange.table import SurveyTable
from app.services.imports import SurveyTask


def read_survey_file(task: SurveyTask, _before: None) -> SurveyTable:
    """Read the rows of a survey."""
    with memory_is_the_limit("survey", "cut the survey into smaller ones"):
        return read_survey(task.data, task.declaration)


@dataclass(frozen=True, slots=True)
class ReadSurvey:
    """A survey that has been read already."""

    table: SurveyTable

    def result(self) -> SurveyTable:
        """The survey."""
        return self.table


class SurveysHere:
    """Reads surveys in this process: the operator's own files need no child with limits."""

    def start_survey(self, task: SurveyTask, *, wait_s: float = 0.0) -> ReadSurvey:
        """Read a survey."""
        return ReadSurvey(read_survey(task.data, task.declaration))
