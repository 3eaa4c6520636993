"""All checks of a radio plan, its battery, and the settings that are recommended."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from app.errors import InvalidParameter
from app.markers.reading import RadioFinding, Verdict
from app.planning import radio_checks
from app.planning.radio_checks import (
    EvenRoad,
    PreviewRule,
    RadioCheck,
    RadioPlan,
    check_radio,
    in_slots,
    recommend_settings,
)
from app.radio.link import LinkModel
from app.radio.reception import Air, Approach, Receiver, RoadMarkers, approach
from app.radio.regulation import check_legal, is_permitted
from app.radio.settings import (
    MAX_BATTERY_DAYS,
    Battery,
    RadioSettings,
    Region,
    battery_life_days,
    mean_current_ma,
    transmit_current_ma,
)
from benchmarks.cerpm.europe import Design, share_in_time

TEN_A_SIDE = RoadMarkers(np.repeat(np.arange(10) * 12.192, 2), np.tile([1.8, -1.8], 10))
PAPERS_RADIO = RadioSettings(bandwidth_hz=125_000, interval_s=2.0)
EUROPE = RadioSettings(frequency_hz=868_100_000, bandwidth_hz=125_000, power_dbm=14.0, interval_s=10.0)


def named(check: RadioCheck, name: str) -> RadioFinding:
    (finding,) = [finding for finding in check.checks if finding.name == name]
    return finding


def test_every_check_says_what_it_has_and_why() -> None:
    check = check_radio(RadioPlan(RadioSettings(lorawan=True)))
    names = [finding.name for finding in check.checks]
    assert len(set(names)) == len(names)
    assert {"lorawan-room", "link-margin", "read-in-time", "receiver-channels", "jitter", "battery-life"} <= set(names)
    for finding in check.checks:
        assert finding.unit
        assert finding.source
        assert finding.sentence
        met = finding.figure >= finding.limit if finding.relation == ">=" else finding.figure <= finding.limit
        assert finding.passed is met


def test_the_papers_radio_on_a_long_road_is_neither_lawful_nor_heard() -> None:
    check = check_radio(RadioPlan(PAPERS_RADIO))
    assert check.verdict is Verdict.FAIL
    assert named(check, "fixed-narrow-channel").verdict is Verdict.WARN
    assert named(check, "read-in-time").verdict is Verdict.FAIL
    assert check.range_m > 4 * check.preview_m
    assert named(check, "link-margin").passed


def test_ten_markers_a_side_are_read_at_the_cameras_preview() -> None:
    check = check_radio(RadioPlan(RadioSettings(), markers=TEN_A_SIDE, preview=PreviewRule(31.0)))
    assert check.read_probability >= 0.99
    assert max(check.road.markers_in_range) == 20
    assert all(success is not None and success > 0 for success in check.road.packet_success_min)
    assert all(success is not None and success <= 1 for success in check.road.packet_success_mean)
    assert check.verdict is Verdict.WARN
    assert [finding.name for finding in check.checks if not finding.passed] == ["battery-life"]


def test_an_even_road_is_checked_at_its_middle() -> None:
    plan = RadioPlan(RadioSettings(), preview=PreviewRule(31.0))
    long_road = plan.road.markers(1200.0)
    middle = RoadMarkers(np.append(long_road.chainage_m, 0.0)[1:], np.append(long_road.offset_m, 1.8)[1:])
    given = check_radio(replace(plan, markers=middle))
    even = check_radio(plan)
    assert given.read_probability == pytest.approx(even.read_probability, abs=0.03)
    assert max(given.road.markers_in_range) == max(even.road.markers_in_range)


def test_reading_in_time_is_harder_the_faster_the_denser_and_the_farther() -> None:
    plan = RadioPlan(RadioSettings(), preview=PreviewRule(31.0))
    base = check_radio(plan).read_probability
    assert check_radio(replace(plan, design_speed_m_s=25.0)).read_probability < base
    assert check_radio(replace(plan, road=EvenRoad(6.0))).read_probability < base
    assert check_radio(replace(plan, preview=PreviewRule(60.0))).read_probability < base
    assert check_radio(replace(plan, road=EvenRoad(sides=1))).read_probability > base
    assert check_radio(replace(plan, link=LinkModel(near_dbm=-118.0))).read_probability < base


@pytest.mark.parametrize(("speed_m_s", "preview_m"), [(3.0, 31.0), (13.4, 59.9), (30.0, 207.4)])
def test_the_preview_is_the_stopping_distance_and_at_least_the_cameras(speed_m_s: float, preview_m: float) -> None:
    assert RadioPlan(RadioSettings(), design_speed_m_s=speed_m_s).preview_m == pytest.approx(preview_m, abs=0.1)


def test_channels_that_nobody_hears_are_warned_of() -> None:
    settings = RadioSettings(frequency_hz=902_500_000, channels=8)
    finding = named(check_radio(RadioPlan(settings)), "receiver-channels")
    assert (finding.verdict, finding.figure, finding.limit) == (Verdict.WARN, 1, 8)
    assert named(check_radio(RadioPlan(settings, receiver=Receiver(channels=8))), "receiver-channels").passed


def test_clockwork_markers_are_warned_of() -> None:
    assert named(check_radio(RadioPlan(RadioSettings(jitter_share=0.0))), "jitter").verdict is Verdict.WARN


@pytest.mark.parametrize(
    ("spreading_factor", "bandwidth_hz", "verdict"),
    [(10, 125_000, Verdict.FAIL), (9, 125_000, Verdict.OK), (8, 500_000, Verdict.OK), (7, 500_000, Verdict.FAIL)],
)
def test_lorawan_needs_a_data_rate_with_room(spreading_factor: int, bandwidth_hz: int, verdict: Verdict) -> None:
    settings = RadioSettings(
        spreading_factor=spreading_factor, bandwidth_hz=bandwidth_hz, interval_s=10.0, lorawan=True
    )
    assert named(check_radio(RadioPlan(settings)), "lorawan-room").verdict is verdict


def test_a_receiver_among_two_thousand_reads_nothing() -> None:
    markers = RoadMarkers(np.linspace(0.0, 240.0, 2000), np.tile([1.8, -1.8], 1000))
    check = check_radio(RadioPlan(RadioSettings(), markers=markers, preview=PreviewRule(31.0)))
    assert check.read_probability < 1e-6
    assert max(check.road.markers_in_range) > 1900


@pytest.mark.parametrize(
    ("values", "field"),
    [
        ({"design_speed_m_s": 0.0}, "design_speed_m_s"),
        ({"design_speed_m_s": float("nan")}, "design_speed_m_s"),
        ({"min_probability": 1.0}, "min_probability"),
        ({"min_battery_days": -1.0}, "min_battery_days"),
    ],
)
def test_plans_outside_their_limits_are_refused(values: dict[str, float], field: str) -> None:
    with pytest.raises(InvalidParameter) as caught:
        RadioPlan(RadioSettings(), **values)  # type: ignore[arg-type]
    assert caught.value.field == field


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda: EvenRoad(0.5), "road.spacing_m"),
        (lambda: EvenRoad(sides=0), "road.sides"),
        (lambda: EvenRoad(lane_width_m=50.0), "road.lane_width_m"),
        (lambda: PreviewRule(0.0), "preview.distance_m"),
        (lambda: PreviewRule(deceleration_m_s2=0.0), "preview.deceleration_m_s2"),
        (lambda: Battery(capacity_mah=0.0), "battery.capacity_mah"),
        (lambda: Battery(usable_share=1.1), "battery.usable_share"),
        (lambda: Battery(sleep_ma=-1.0), "battery.sleep_ma"),
        (lambda: Battery(solar_mw=-1.0), "battery.solar_mw"),
        (lambda: Battery(winter_sun_h=9.0), "battery.winter_sun_h"),
    ],
)
def test_rules_and_batteries_outside_their_limits_are_refused(make: object, field: str) -> None:
    with pytest.raises(InvalidParameter) as caught:
        make()  # type: ignore[operator]
    assert caught.value.field == field


# --- battery ------------------------------------------------------------------------------------------------------


def test_a_battery_lasts_by_what_is_drawn() -> None:
    settings, battery = RadioSettings(interval_s=1.0), Battery()
    drawn_ma = 0.8 + 0.015424 * 120 + (0.015424 + 0.01) * 40
    assert mean_current_ma(settings, battery) == pytest.approx(drawn_ma, abs=1e-6)
    assert battery_life_days(settings, battery) == pytest.approx(800 / drawn_ma / 24, rel=1e-6)
    asleep = replace(settings, interval_s=86_400.0)
    assert battery_life_days(asleep, battery) == pytest.approx(1000 * 0.8 / 0.8 / 24, rel=1e-3)


@pytest.mark.parametrize(("power_dbm", "current_ma"), [(20, 120), (18, 120), (17, 87), (13, 29), (7, 20), (-4, 20)])
def test_power_costs_what_the_data_sheet_says(power_dbm: float, current_ma: float) -> None:
    assert transmit_current_ma(power_dbm) == current_ma


def test_a_solar_cell_carries_a_marker_through_the_winter_or_not() -> None:
    settings, bare = RadioSettings(interval_s=20.0), Battery(sleep_ma=0.1)
    load_mw = 3.7 * mean_current_ma(settings, bare)
    without = battery_life_days(settings, bare)
    assert without == pytest.approx(800 * 3.7 / load_mw / 24)
    # half of the rated energy of 0.5 h of sun a day carries it in December
    enough = load_mw * 24 / 0.5 / 0.5
    assert battery_life_days(settings, replace(bare, solar_mw=1.01 * enough)) == MAX_BATTERY_DAYS
    little = [battery_life_days(settings, replace(bare, solar_mw=share * enough)) for share in (0.05, 0.2, 0.5)]
    assert without < little[0] < little[1] <= little[2]
    # a battery of a few days is empty in the first month in which the sun is too weak
    small = replace(bare, capacity_mah=10.0, solar_mw=0.9 * enough)
    days = battery_life_days(settings, small)
    assert 61 < days < 92  # from October on: in December
    dark = replace(small, winter_sun_h=0.0, solar_mw=1.01 * enough)
    assert battery_life_days(settings, dark) < 92
    assert [round(dark.charge_mw(month) / dark.solar_mw * 48, 2) for month in (0, 5, 11)] == [0.2, 4.9, 0.0]


def test_listening_and_the_time_of_satellites_cost_current() -> None:
    slotted = in_slots(RadioPlan(EUROPE, region=Region.EU868)).radio
    battery = Battery()
    untimed = replace(slotted, slotted=False)
    deaf = replace(untimed, polite=False)
    timing_ma = mean_current_ma(slotted, battery) - mean_current_ma(untimed, battery)
    assert timing_ma == pytest.approx(3.0 * 25.0 / 1800.0)
    listening_ma = mean_current_ma(untimed, battery) - mean_current_ma(deaf, battery)
    assert listening_ma == pytest.approx(0.005 * (12.0 + 40.0) / slotted.interval_s)


# --- recommendation -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "plan",
    [
        RadioPlan(PAPERS_RADIO, markers=TEN_A_SIDE, preview=PreviewRule(31.0)),
        RadioPlan(RadioSettings(), road=EvenRoad(24.384), preview=PreviewRule(31.0)),
        RadioPlan(RadioSettings()),
    ],
    ids=["ten a side", "80 ft", "40 ft at the stopping distance"],
)
def test_recommended_settings_pass_the_checks(plan: RadioPlan) -> None:
    found = recommend_settings(plan)
    assert found.reaches
    assert found.radio is not None
    assert is_permitted(found.radio, plan.region)
    receiver = replace(plan.receiver, channels=found.receiver_channels)
    check = check_radio(replace(plan, radio=found.radio, receiver=receiver))
    assert named(check, "read-in-time").passed
    assert check.battery_days == found.battery_days
    if plan.markers is None:
        assert check.read_probability == pytest.approx(found.read_probability)


def test_a_quieter_air_needs_no_more_channels() -> None:
    ten = recommend_settings(RadioPlan(RadioSettings(), markers=TEN_A_SIDE, preview=PreviewRule(31.0)))
    long_road = recommend_settings(RadioPlan(RadioSettings(), preview=PreviewRule(31.0)))
    assert ten.receiver_channels == 1
    assert long_road.receiver_channels > 1
    alone = recommend_settings(RadioPlan(RadioSettings(), preview=PreviewRule(31.0)), more_channels=False)
    assert not alone.reaches
    assert "no lawful settings tried reach" in alone.sentence


def test_of_those_that_reach_the_longest_lived_is_recommended() -> None:
    plan = RadioPlan(RadioSettings(), markers=TEN_A_SIDE, preview=PreviewRule(31.0))
    found = recommend_settings(plan)
    assert found.radio is not None
    assert found.battery_days > battery_life_days(replace(found.radio, interval_s=1.0), plan.battery)
    rarer = replace(found.radio, interval_s=1.3 * found.radio.interval_s)
    assert check_radio(replace(plan, radio=rarer)).read_probability < plan.min_probability


def test_more_markers_than_a_check_takes_are_refused_and_not_recommended() -> None:
    crowded = RadioPlan(replace(PAPERS_RADIO, spreading_factor=12, interval_s=20.0), road=EvenRoad(1.0))
    with pytest.raises(InvalidParameter, match="in reach") as caught:
        check_radio(crowded)
    assert caught.value.field == "road.spacing_m"
    assert not recommend_settings(crowded, more_channels=False).reaches


def test_what_cannot_be_reached_lawfully_is_said() -> None:
    found = recommend_settings(RadioPlan(EUROPE, region=Region.EU868, design_speed_m_s=25.0))
    assert not found.reaches
    assert found.radio is not None
    assert is_permitted(found.radio, Region.EU868)
    assert found.read_probability < 0.99
    assert "no lawful settings tried reach 99.0%" in found.sentence
    alone = recommend_settings(RadioPlan(EUROPE, region=Region.EU868), more_channels=False)
    assert not alone.reaches
    nowhere = recommend_settings(RadioPlan(RadioSettings(), region=Region.EU868), more_channels=False)
    assert nowhere.radio is None
    assert nowhere.law == ()
    assert "no settings are lawful" in nowhere.sentence


@pytest.mark.parametrize("frequency_hz", [868_100_000, 915_000_000])
def test_in_europe_slots_on_polite_channels_are_recommended(frequency_hz: int) -> None:
    plan = RadioPlan(replace(EUROPE, frequency_hz=frequency_hz), region=Region.EU868)
    found = recommend_settings(plan)
    assert found.reaches
    assert found.radio is not None
    assert found.radio.polite
    assert found.radio.slotted
    assert "in slots by satellite time, with polite spectrum access" in found.sentence
    assert found.law == check_legal(found.radio, Region.EU868)
    assert {finding.name for finding in found.law} == {
        "band", "polite-on-time", "polite-packet", "polite-pause", "power",
    }  # fmt: skip
    assert all(finding.passed for finding in found.law)
    received = replace(plan, radio=found.radio, receiver=replace(plan.receiver, channels=found.receiver_channels))
    check = check_radio(received)
    assert check.read_probability == pytest.approx(found.read_probability)
    assert named(check, "slots").passed
    assert named(check, "slots").figure == found.radio.slots.capacity  # type: ignore[union-attr]
    rarer = replace(found.radio, interval_s=1.5 * found.radio.interval_s)
    assert check_radio(replace(received, radio=rarer)).read_probability < plan.min_probability


def test_of_settings_that_a_solar_cell_carries_the_most_probable_are_recommended() -> None:
    plan = RadioPlan(EUROPE, region=Region.EU868, battery=Battery(sleep_ma=0.008, awake_ma=4.0, transmit_ma=25.5))
    dark = recommend_settings(plan)
    sunny = recommend_settings(replace(plan, battery=replace(plan.battery, solar_mw=400.0)))
    assert dark.battery_days < 100
    assert sunny.battery_days == MAX_BATTERY_DAYS
    assert sunny.read_probability > dark.read_probability
    assert sunny.read_probability > 0.999


def test_slots_too_few_for_the_markers_in_range_are_named() -> None:
    radio = replace(in_slots(RadioPlan(EUROPE, region=Region.EU868)).radio, interval_s=0.1, spreading_factor=7)
    check = check_radio(RadioPlan(radio, Region.EU868, receiver=Receiver(channels=10)))
    assert named(check, "slots").verdict is Verdict.WARN
    assert named(check, "slots").figure == 10
    assert check.read_probability < 0.5


@pytest.mark.parametrize(("interval_s", "spreading_factor"), [(1.7, 7), (3.4, 7), (6.9, 9)])
def test_the_probability_in_slots_is_that_of_the_simulation(interval_s: float, spreading_factor: int) -> None:
    radio = replace(
        in_slots(RadioPlan(EUROPE, region=Region.EU868)).radio,
        interval_s=interval_s,
        spreading_factor=spreading_factor,
    )
    predicted = check_radio(RadioPlan(radio, Region.EU868, receiver=Receiver(channels=10))).read_probability
    counts = np.array([share_in_time(Design("", "", radio), (1, k), 800.0) for k in range(5)]).sum(axis=0)
    share = counts[0] / counts[1]
    # three standard deviations of the count, and half a per cent
    assert share == pytest.approx(predicted, abs=0.005 + 3 * math.sqrt(predicted * (1 - predicted) / counts[1]))


@pytest.mark.slow
def test_an_approach_is_computed_once_for_all_channels(monkeypatch: pytest.MonkeyPatch) -> None:
    approached: list[tuple[float, float]] = []

    def count(markers: RoadMarkers, index: int, nearest_m: float, air: Air) -> Approach:
        approached.append((air.threshold_dbm, air.settings.power_dbm))
        return approach(markers, index, nearest_m, air)

    monkeypatch.setattr(radio_checks, "approach", count)
    crowded = RoadMarkers(np.linspace(0.0, 500.0, 500), np.tile([1.8, -1.8], 250))
    found = recommend_settings(RadioPlan(RadioSettings(), markers=crowded))
    assert not found.reaches
    assert len(approached) <= 8 * len(set(approached))


@pytest.mark.slow
def test_reception_among_twenty_thousand_is_computed_at_fewer_stations() -> None:
    def stations(count: int) -> int:
        markers = RoadMarkers(np.linspace(0.0, 2000.0, count), np.tile([1.8, -1.8], count // 2))
        return len(check_radio(RadioPlan(RadioSettings(), markers=markers)).road.station_m)

    assert (stations(1000), stations(20_000)) == (200, 100)
