"""A survey, read inside a decoder process."""

from __future__ import annotations

from app.jobs.memory import memory_is_the_limit
from app.registry.exchange.read import read_survey
from app.registry.exchange.table import SurveyTable
from app.services.imports import SurveyTask


def read_survey_file(task: SurveyTask, _before: None) -> SurveyTable:
    """Read the rows of a survey."""
    with memory_is_the_limit("survey", "cut the survey into smaller ones"):
        return read_survey(task.data, task.declaration)
