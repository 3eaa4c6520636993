"""The error of distance ratios, against the paper's field results and against drawing errors."""

from __future__ import annotations

import math

import numpy as np
import pytest

from app.errors import InvalidParameter
from app.markers.magnet_design import (
    METRO_ERROR,
    MagnetErrorModel,
    OdometerError,
    ReadingConditions,
    TagDesign,
    covariance_of,
    distinguishable,
    placements_of,
    ratio_std,
    separation,
    separation_for,
)

MPS_30_MPH = 13.41
ROUGH = ReadingConditions(20.0, 0.35, OdometerError(drift=0.01), MagnetErrorModel(timing_s=0.0005))


def metro(speed_m_s: float = MPS_30_MPH, clearance_m: float = 0.16) -> ReadingConditions:
    return ReadingConditions(speed_m_s, clearance_m, model=METRO_ERROR)


# METRO figure 17b, 30 mph: accuracy over neighbouring tags, ten passes each
@pytest.mark.parametrize(
    ("segment_m", "low", "high"), [(1.0, 0.99, 1), (0.5, 0.99, 1), (0.1, 0.99, 1), (0.05, 0.8, 0.97), (0.02, 0.2, 0.6)]
)
def test_the_papers_pipeline_tells_segments_apart_as_in_its_field_test(
    segment_m: float, low: float, high: float
) -> None:
    assert low <= distinguishable(TagDesign(3, 4.0, segment_m), metro()).mean_accuracy <= high


def test_the_papers_pipeline_has_the_spread_of_its_field_test() -> None:
    (std,) = ratio_std((1.0, 3.0), metro())
    assert std == pytest.approx(0.019, abs=0.004)  # section 7.2, {NNN, 0, 3, 4, 1, 3/1} beside parked cars at 30 mph


def read_tags(gaps_m: np.ndarray, at: ReadingConditions, count: int, scale: float = 1.0) -> np.ndarray:
    """Gaps of one tag as they are read, shape (count, M - 1)."""
    rng = np.random.default_rng(7)
    places = np.concatenate([[0.0], np.cumsum(gaps_m)])
    std = at.model.position_std_m(at.speed_m_s, at.clearance_m)
    places = places + rng.normal(0, std, (count, len(places)))
    return scale * (np.diff(places) + rng.normal(0, at.odometer.gap_std_m(gaps_m, at.speed_m_s), (count, len(gaps_m))))


def normalised(gaps: np.ndarray) -> np.ndarray:
    return np.cumsum(gaps, axis=-1)[..., :-1] / gaps.sum(axis=-1)[..., None]


@pytest.mark.parametrize("gaps", [(1.0, 3.0), (2.0, 2.0), (3.5, 0.5), (0.5, 1.0, 2.0, 0.5), (0.5,) * 6])
@pytest.mark.parametrize("at", [metro(), ROUGH])
def test_covariances_are_those_of_drawn_errors(gaps: tuple[float, ...], at: ReadingConditions) -> None:
    read = read_tags(np.array(gaps), at, 40_000)
    expected = covariance_of(np.array([gaps]), at)[0]
    np.testing.assert_allclose(np.cov(normalised(read).T).reshape(expected.shape), expected, rtol=0.06, atol=2e-8)
    deviation = read[:, 1:] / read[:, :1] / (np.array(gaps[1:]) / gaps[0])
    np.testing.assert_allclose(deviation.std(axis=0), ratio_std(gaps, at), rtol=0.06)


def test_an_error_of_scale_cancels() -> None:
    gaps = np.array([1.0, 3.0])
    np.testing.assert_allclose(
        normalised(read_tags(gaps, ROUGH, 50, scale=1.07)), normalised(read_tags(gaps, ROUGH, 50)), atol=1e-12
    )


def decoded_share(design: TagDesign, at: ReadingConditions) -> np.ndarray:
    """Share of drawn readings of each placement to which that placement is the nearest, shape (K,)."""
    gaps_m = placements_of(design) * design.segment_m
    codes = normalised(gaps_m)
    covariances = covariance_of(gaps_m, at)
    shares = []
    for k in range(len(codes)):
        read = normalised(read_tags(gaps_m[k], at, 2000))
        delta = read[:, None, :] - codes[None]
        distance = np.einsum("nki,ij,nkj->nk", delta, np.linalg.inv(covariances[k]), delta)
        shares.append(np.mean(distance.argmin(axis=1) == k))
    return np.array(shares)


def test_the_distinguishable_share_is_what_drawing_gives() -> None:
    design, at = TagDesign(3, 4.0, 0.05), metro()
    shares = decoded_share(design, at)
    assert distinguishable(design, at).mean_accuracy == pytest.approx(shares.mean(), abs=0.01)
    hard = ReadingConditions(MPS_30_MPH, 0.16, model=MagnetErrorModel(channels=1.0, timing_s=0.00063))
    verdict = distinguishable(design, hard, accuracy=0.975)
    assert verdict.mean_accuracy == pytest.approx(decoded_share(design, hard).mean(), abs=0.01)
    assert 0 < verdict.share < 1
    assert verdict.codes == round(verdict.share * 61) * 8


@pytest.mark.slow
def test_with_more_magnets_the_share_is_a_bound_from_below() -> None:
    design, at = TagDesign(4, 3.0, 0.1), ReadingConditions(20.0, 0.30)
    verdict = distinguishable(design, at)
    drawn = decoded_share(design, at)
    assert verdict.mean_accuracy <= drawn.mean() + 0.005
    assert verdict.mean_accuracy > drawn.mean() - 0.05


def test_every_difficulty_costs_codes() -> None:
    design = TagDesign(3, 4.0, 0.05)
    easy = distinguishable(design, ReadingConditions(10.0, 0.16))
    assert (easy.share, easy.codes) == (1.0, 488)
    for hard in (
        ReadingConditions(10.0, 0.40),
        ReadingConditions(60.0, 0.33),
        ReadingConditions(10.0, 0.16, OdometerError(drift=0.02)),
        ReadingConditions(10.0, 0.16, OdometerError(quantum_m_s=0.6)),
        ReadingConditions(10.0, 0.16, model=MagnetErrorModel(placement_m=0.02)),
    ):
        assert distinguishable(design, hard).mean_accuracy < easy.mean_accuracy
        assert distinguishable(design, hard).codes < 488


def test_designs_without_ratio_and_designs_without_room() -> None:
    two = distinguishable(TagDesign(2, 4.0, 1.0), metro())
    assert (two.share, two.codes, two.worst_accuracy) == (1.0, 4, 1.0)
    assert distinguishable(TagDesign(7, 2.0, 0.5), metro()).codes == 0


def test_a_design_too_large_to_list_is_sampled() -> None:
    design = TagDesign(5, 6.0, 0.05)
    assert design.placements > 4000
    steps = placements_of(design)
    assert len({tuple(row) for row in steps}) == len(steps) == 4000
    assert [list(steps[0]), list(steps[-1])] == [[10, 10, 10, 90], [90, 10, 10, 10]]
    assert 0 < distinguishable(design, ReadingConditions(20.0, 0.30)).mean_accuracy < 1


@pytest.mark.parametrize("design", [TagDesign(2, 1.0, 0.5), TagDesign(4, 3.0, 0.2), TagDesign(7, 4.0, 0.5)])
def test_placements_have_ranks(design: TagDesign) -> None:
    assert [design.gap_steps_at(k) for k in range(design.placements)] == list(design.list_gap_steps())
    with pytest.raises(InvalidParameter, match="no placement"):
        design.gap_steps_at(design.placements)


def test_separation_is_a_probability_of_confusion() -> None:
    distance = separation_for(0.001)
    draws = np.random.default_rng(3).normal(size=400_000)
    assert np.mean(draws > distance / 2) == pytest.approx(0.001, rel=0.2)
    gaps = np.array([[1.0, 3.0], [1.5, 2.5]])
    u = normalised(gaps)
    covariance = covariance_of(gaps, metro())
    assert separation(u[0], covariance[0], u[1:])[0] == pytest.approx(0.125 / math.sqrt(covariance[0, 0, 0]))


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda: ReadingConditions(speed_m_s=0.0), "speed_m_s"),
        (lambda: ReadingConditions(speed_m_s=math.nan), "speed_m_s"),
        (lambda: ReadingConditions(clearance_m=30.0), "clearance_m"),
        (lambda: OdometerError(rate_hz=0.0), "rate_hz"),
        (lambda: OdometerError(drift=-0.1), "drift"),
        (lambda: MagnetErrorModel(moment_am2=math.inf), "moment_am2"),
        (lambda: MagnetErrorModel(noise_ut=math.nan), "noise_ut"),
        (lambda: distinguishable(TagDesign(3, 4.0, 1.0), metro(), accuracy=1.0), "accuracy"),
        (lambda: separation_for(0.5), "confusion"),
        (lambda: separation_for(math.nan), "confusion"),
    ],
)
def test_conditions_outside_the_limits_are_refused_by_name(make: object, field: str) -> None:
    with pytest.raises(InvalidParameter) as caught:
        make()  # type: ignore[operator]
    assert caught.value.field == field
    assert caught.value.limit


def test_places_follow_the_physics() -> None:
    noise = MagnetErrorModel(placement_m=0.0, timing_s=0.0)
    # 15.8 uT over a lying magnet at 25 cm (half the 32 uT of an upright one), 26 samples of 1.5 uT in a pulse of 25 cm
    assert noise.position_std_m(13.4, 0.25) == pytest.approx(0.25 * 1.5 / 15.8 / math.sqrt(26.1), rel=0.01)
    assert noise.position_std_m(13.4, 0.32) / noise.position_std_m(13.4, 0.16) == pytest.approx(2**3.5)
    assert noise.position_std_m(40.0, 0.2) / noise.position_std_m(10.0, 0.2) == pytest.approx(2.0)
    timing = MagnetErrorModel(placement_m=0.0, noise_ut=0.0, timing_s=0.001)
    assert timing.position_std_m(20.0, 0.3) == pytest.approx(0.02)
    assert MagnetErrorModel(placement_m=0.003, noise_ut=0.0, timing_s=0.0).position_std_m(20.0, 0.3) == 0.003


def test_the_odometer_errs_by_its_steps_and_by_its_drift() -> None:
    rng = np.random.default_rng(5)
    speeds = rng.uniform(9.0, 11.0, (100_000, 3))  # three speeds a gap of 3 m: 10 a second, in steps of 0.1 m/s
    errors = ((np.round(speeds / 0.1) * 0.1 - speeds) / 10.0).sum(axis=1)
    steps = OdometerError(quantum_m_s=0.1, drift=0.0)
    assert steps.gap_std_m(np.array([3.0]), 10.0)[0] == pytest.approx(errors.std(), rel=0.02)
    drift = OdometerError(quantum_m_s=0.0, drift=0.01)
    np.testing.assert_allclose(drift.gap_std_m(np.array([1.0, 3.0]), 10.0), [0.01, 0.03])
