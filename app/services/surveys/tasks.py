"""A survey in a decoder process."""

from __future__ import annotations

from app.formats.format import SpooledFile
from app.formats.surveys.declaration import ImportDeclaration
from app.formats.surveys.read import read_survey
from app.formats.surveys.roles import CodeForm
from app.formats.surveys.table import SurveyTable
from app.services.decoder_tasks import decoder_task


@decoder_task("survey", "cut the survey into smaller ones")
def read_survey_file(file: SpooledFile, declaration: ImportDeclaration, code_form: CodeForm) -> SurveyTable:
    """Read the rows of a survey."""
    return read_survey(file.read(), declaration, code_form)
