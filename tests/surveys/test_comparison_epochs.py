"""Comparisons of surveys with markers whose positions are of another epoch."""

from __future__ import annotations

import numpy as np
import pytest

from app.formats.surveys.declaration import ImportDeclaration
from app.formats.surveys.table import SurveyTable
from app.geodesy import move_to_epoch
from app.surveys.comparison import compare_survey
from app.surveys.georeference import georeference_survey


@pytest.mark.parametrize(("epoch", "residual_m"), [(2015.0, 0.0), (np.nan, 0.275)])
def test_markers_are_compared_where_they_were_when_they_were_surveyed(epoch: float, residual_m: float) -> None:
    """Eleven years of plate motion in Karlsruhe are no residuals, unless the markers have no epoch."""
    lon, lat = 8.4 + np.arange(4) * 1e-4, np.full(4, 49.0)
    now = move_to_epoch(lon, lat, 2015.0, 2026.0)
    table = SurveyTable("csv", now.lon_deg, now.lat_deg, None, False, "EPSG:7912", "deg", "m")
    survey = georeference_survey(table, ImportDeclaration(epoch=2026.0), 0.1)
    found = compare_survey(survey, lon, lat, np.full(4, np.nan), None, np.full(4, epoch))
    assert found.horizontal_m == pytest.approx(np.full(4, residual_m), abs=0.003)
