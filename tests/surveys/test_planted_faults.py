"""A sample of the planted faults: what is warned or refused does not get less, and clean surveys pass."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import numpy as np
import pytest

from benchmarks.imports.faults import KINDS, plant_faults
from benchmarks.imports.judge import STANDING, Judge, open_judge
from benchmarks.imports.surveys import EVIDENCE, LANES, make_survey

SEED = 1000


@pytest.fixture(scope="module")
def judge() -> Iterator[Judge]:
    """A judge over an empty registry."""
    with open_judge() as opened:
        yield opened


@pytest.mark.slow
def test_every_kind_of_fault_is_warned_or_refused(judge: Judge) -> None:
    verdicts: Counter[str] = Counter()
    for planted in plant_faults(SEED, len(KINDS)):
        judged = judge.judge(planted)
        assert judged.verdict != "missed" or judged.moved_m < 10, (planted.kind, planted.survey.lane, judged)
        verdicts[judged.verdict] += 1
    assert verdicts["missed"] <= 1
    assert verdicts["refused"] + verdicts["warned"] >= 0.85 * len(KINDS)


def test_clean_surveys_are_never_refused_and_seldom_warned(judge: Judge) -> None:
    rng = np.random.default_rng(SEED)
    warned = 0
    for lane in LANES:
        for evidence in EVIDENCE:
            survey = make_survey(rng, lane, evidence)
            refused, codes = judge.codes(judge.caller(survey), survey.csv(), survey.declaration)
            assert not refused, (lane, evidence, codes)
            warned += any(code not in STANDING for code in codes)
    assert warned <= 2
