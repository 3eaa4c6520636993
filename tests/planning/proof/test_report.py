"""Intervals and summaries of a proof."""

from __future__ import annotations

import pytest

from app.planning.plan import Plan
from app.planning.proof import ProofTerms, UnitResult, summarize, wilson
from app.planning.proof.report import MarkerPass, WrongReading


@pytest.mark.parametrize(
    ("hits", "trials", "low", "high"),
    [(81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0.0, 0.1611), (1, 29, 0.0061, 0.1718)],
)
def test_wilson_agrees_with_newcombe_1998_table_1(hits: int, trials: int, low: float, high: float) -> None:
    assert wilson(hits / trials, trials) == pytest.approx((low, high), abs=5e-5)


def passed(marker: int, read: int, *, lost: bool = False, weight: float = 1.0, cause: str | None = None) -> MarkerPass:
    fix = [0.03, 0.04] if read else None
    return MarkerPass(marker=marker, weight=weight, lost=lost, readable=5, seen=2, read=read, fix_m=fix, cause=cause)


def unit(drive: int, *passes: MarkerPass, wrong: tuple[WrongReading, ...] = ()) -> UnitResult:
    return UnitResult(
        key=f"{drive}/plates/1/{passes[0]['marker']}", kind="plates", drive=drive, lane="1", condition="day",
        camera="camera", weight=1.0, passes=list(passes), wrong=list(wrong), path=None,
    )  # fmt: skip


def test_weights_count_and_weak_markers_have_their_most_frequent_cause(plates: Plan) -> None:
    results = [
        unit(0, passed(1, 2, weight=3.0), passed(2, 0, cause="shade")),
        unit(1, passed(1, 1, weight=3.0), passed(2, 0, cause="shade")),
        unit(2, passed(1, 0, lost=True, weight=3.0, cause="lost"), passed(2, 0, cause="bend")),
    ]
    report = summarize(plates, ProofTerms(drives=3), results)
    assert report.rates[0].rate == pytest.approx(6 / 12)
    assert (report.rates[0].passes, report.rates[0].read, report.rates[0].lost) == (6, 2, 1)
    first, second = report.markers
    assert (first.rate, first.weak, first.lost, first.cause) == (1.0, False, 1, None)
    assert first.fix_rms_m == pytest.approx(0.05)
    assert (second.rate, second.weak, second.cause) == (0.0, True, "shade")


def test_gaps_reach_from_the_lanes_start_to_its_end(plates: Plan) -> None:
    report = summarize(
        plates, ProofTerms(drives=2), [unit(0, passed(1, 2), passed(2, 0)), unit(1, passed(1, 0), passed(2, 0))]
    )
    near, none = report.drives
    assert (near.longest_gap_m, near.gap_from_m) == pytest.approx((150.0, 50.0))
    assert (none.longest_gap_m, none.gap_from_m) == pytest.approx((200.0, 0.0))


def test_wrong_readings_are_counted_with_their_marker(plates: Plan) -> None:
    report = summarize(plates, ProofTerms(), [unit(0, passed(1, 2), wrong=(WrongReading(marker=1, text="99"),))])
    assert report.wrong == ({"drive": 0, "marker": 1, "text": "99"},)
    assert report.markers[0].wrong == report.drives[0].wrong == 1
