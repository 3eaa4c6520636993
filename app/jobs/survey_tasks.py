"""A survey, read inside a decoder process."""

from __future__ import annotations

from app.formats.surveys.read import read_survey
from app.formats.surveys.table import SurveyTable
from app.jobs.memory_limit import memory_is_the_limit
from app.services.surveys.imports import SurveyTask


def read_survey_file(task: SurveyTask, _before: None) -> SurveyTable:
    """Read the rows of a survey."""
    with memory_is_the_limit("survey", "cut the survey into smaller ones"):
        return read_survey(task.file.read(), task.declaration, task.code_form)
