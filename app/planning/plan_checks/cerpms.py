"""CERPMs: the path that vehicles compute from them, and the radio where most of them are in range of each other."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import scipy

from app.geodesy.ellipsoid import ecef_from_wgs84
from app.markers.checks import Verdict
from app.planning.alignment import Floats, Lane
from app.planning.placement.cerpms import path_error_m
from app.planning.plan import Plan, PlanFinding, PlannedCerpm, PlannedMarker
from app.planning.plan_checks.finding import compare
from app.planning.radio_checks import PreviewRule, RadioCheck, RadioPlan, check_radio
from app.planning.radio_recommendation import INTERVALS_S, recommend_settings
from app.planning.rules import CerpmRules
from app.radio.airtime import SPREADING_FACTORS
from app.radio.lorawan import Region
from app.radio.reception import MAX_MARKERS, SPACINGS_M, Air, RoadMarkers
from app.radio.regulation import LAWS, region_at
from app.radio.settings import RadioSettings

_DEFAULT_REGION = Region.US915  # of the CERPM paper's markers
_EU_SETTINGS = RadioSettings(frequency_hz=868_300_000, power_dbm=14.0)  # source: by hand, within band M
_CARRIAGEWAY_M = 30.0  # [m] across; markers farther aside are farther along a bend; source: by hand, a motorway


def check_cerpms(plan: Plan) -> Iterator[PlanFinding]:
    """Path error of every lane, and the radio at the busiest place."""
    rules = plan.rules.cerpm
    cerpms = [marker for marker in plan.markers if isinstance(marker.detail, PlannedCerpm)]
    if rules is None or not cerpms:
        return
    yield from _path_error(plan, cerpms, rules)
    yield from _radio(plan, cerpms, rules)


def _path_error(plan: Plan, cerpms: list[PlannedMarker], rules: CerpmRules) -> Iterator[PlanFinding]:
    """Exact markers and a cubic spline; the survey's error comes on top."""
    worst, error = None, 0.0
    for name in dict.fromkeys(marker.lane for marker in cerpms):
        lane = plan.alignment.lane(name)
        own = [marker for marker in cerpms if marker.lane == name]
        chainages = np.array([marker.chainage_m for marker in own])
        if np.ptp(chainages) < lane.length_m / 2:
            continue
        found = path_error_m(lane, chainages, _shifts_m(lane, own))
        if float(found.max()) > error:
            error = float(found.max())
            at = float(lane.chainage_m[int(found.argmax())])
            worst = min(own, key=lambda marker: abs(marker.chainage_m - at))
    required = plan.rules.quality.path_error_m if plan.rules.quality is not None else None
    limit = required if required is not None else rules.max_path_error_m
    limit = limit if limit is not None else error
    yield compare(
        "path-error", error, "<=", limit, "m", "CERPM paper, section 2.3: cubic spline through the markers",
        "greatest distance of the path through exactly surveyed markers from the centre line", worst,
    )  # fmt: skip


def _shifts_m(lane: Lane, cerpms: Sequence[PlannedMarker]) -> Floats:
    """How far each stands left of its boundary, as surveys of built ones find, shape (K,). [m]

    The boundary is the nearer one: markers that two lanes share name no side.
    """
    offset_m = np.array([marker.offset_m for marker in cerpms])
    half_m = lane.value_at(lane.width_m, [marker.chainage_m for marker in cerpms]) / 2
    return np.asarray(offset_m - np.sign(offset_m) * half_m)


def _radio(plan: Plan, cerpms: list[PlannedMarker], rules: CerpmRules) -> Iterator[PlanFinding]:
    """The radio checks where most markers are in reach of each other, with the real markers of the plan."""
    yield _law(cerpms, rules)
    radio = _radio_plan(plan, cerpms, rules, plan.radio or _first_settings(rules))
    markers, busiest = _busiest(cerpms, radio.air)
    check = check_radio(replace(radio, markers=markers))
    settings = radio.settings
    setting = f"SF{settings.spreading_factor}, {settings.bandwidth_hz / 1000:g} kHz, every {settings.interval_s:g} s, "
    setting += f"{settings.channels} channels: "
    for finding in check.checks:
        yield PlanFinding(
            f"radio {finding.name}", finding.figure, finding.relation, finding.limit, finding.unit, finding.source,
            finding.verdict, setting + finding.sentence, busiest.lane, busiest.station_m, busiest.lon_deg,
            busiest.lat_deg,
        )  # fmt: skip
    yield _collisions(check, rules, busiest)


def _law(cerpms: list[PlannedMarker], rules: CerpmRules) -> PlanFinding:
    """Whether the rules that the radio is checked by apply where the markers are."""
    checked = rules.region or _DEFAULT_REGION
    found = [region_at(marker.lon_deg, marker.lat_deg) for marker in cerpms]
    elsewhere = [marker for marker, region in zip(cerpms, found, strict=True) if region is not checked]
    how = "as declared" if rules.region else "because no region is declared"
    sentence = f"CERPMs at places where other rules may apply; checked by {checked}, {LAWS[checked]}, {how}"
    if others := [region for region in Region if region in found and region is not checked]:
        sentence += "; some are under " + " and ".join(f"{region}, {LAWS[region]}" for region in others)
    if None in found:
        sentence += "; of some the law is unknown here, near a border or in another country"
    if elsewhere:
        cure = "ask the authority before installing"
        sentence += f": {cure}" if rules.region else f": declare cerpm.region, and {cure}"
    return compare(
        "radio law", len(elsewhere), "<=", 0, "CERPMs", "positions of the CERPMs; app/radio/regulation.py", sentence,
        elsewhere[0] if elsewhere else None, missed=Verdict.WARN,
    )  # fmt: skip


def radio_settings(plan: Plan) -> RadioSettings | None:
    """Settings of the plan's CERPMs: those of the rules, or recommended ones; None without CERPMs.

    They are recommended for the mean spacing of all lanes side by side, and for the real markers of the busiest place
    if they would not be read in time there.
    """
    rules = plan.rules.cerpm
    cerpms = [marker for marker in plan.markers if isinstance(marker.detail, PlannedCerpm)]
    if rules is None or not cerpms:
        return None
    if rules.spreading_factor is not None and rules.interval_s is not None:
        return replace(
            _first_settings(rules), spreading_factor=rules.spreading_factor, interval_s=rules.interval_s,
            bandwidth_hz=rules.bandwidth_hz,
        )  # fmt: skip
    mean = _radio_plan(plan, cerpms, rules, _first_settings(rules))
    found = _recommended(mean)
    markers, _marker = _busiest(cerpms, found.air)
    real = replace(found, markers=markers)
    if check_radio(real).read_probability >= real.min_probability:
        return found.settings
    farthest = replace(mean.settings, spreading_factor=SPREADING_FACTORS[-1], interval_s=INTERVALS_S[-1])
    markers, _marker = _busiest(cerpms, replace(mean, settings=farthest).air)
    return _recommended(replace(mean, markers=markers)).settings


def _first_settings(rules: CerpmRules) -> RadioSettings:
    """Settings to begin with, on a frequency and with a power of the region."""
    return _EU_SETTINGS if rules.region is Region.EU868 else RadioSettings()


def _radio_plan(plan: Plan, cerpms: Sequence[PlannedMarker], rules: CerpmRules, settings: RadioSettings) -> RadioPlan:
    lanes = {marker.lane for marker in cerpms}
    length_m = sum(plan.alignment.lane(name).length_m for name in lanes)
    spacing_m = min(max(2 * length_m / len(cerpms) / len(lanes), SPACINGS_M[0]), SPACINGS_M[1])
    made = RadioPlan(
        settings, rules.region or _DEFAULT_REGION, spacing_m=spacing_m,
        design_speed_mps=max(float(lane.design_speed_mps.max()) for lane in plan.alignment.lanes),
        preview=PreviewRule(distance_m=rules.preview_m),
    )  # fmt: skip
    return replace(made, receiver=replace(made.receiver, channels=max(settings.channels, made.receiver.channels)))


def _recommended(wanted: RadioPlan) -> RadioPlan:
    """The plan with recommended settings, or as it is where none are lawful."""
    settings = recommend_settings(wanted).settings or wanted.settings
    receiver = replace(wanted.receiver, channels=max(settings.channels, wanted.receiver.channels))
    return replace(wanted, settings=settings, receiver=receiver)


def _collisions(check: RadioCheck, rules: CerpmRules, busiest: PlannedMarker) -> PlanFinding:
    lost = 1.0 - check.packet_success
    sentence = (
        f"share of packets that are lost at {check.preview_m:.0f} m, minimum over the markers of the busiest place"
    )
    return compare(
        "radio collisions", lost, "<=", rules.collisions_max, "share", "pure ALOHA with capture", sentence, busiest,
        missed=Verdict.WARN,
    )  # fmt: skip


def _busiest(cerpms: Sequence[PlannedMarker], air: Air) -> tuple[RoadMarkers, PlannedMarker]:
    """The marker with most others in range, and those around it that can be heard beside it.

    Their distances from it are the true ones, so that a bend does not bring them closer.
    """
    lon, lat = np.array([m.lon_deg for m in cerpms]), np.array([m.lat_deg for m in cerpms])
    tree = scipy.spatial.cKDTree(ecef_from_wgs84(lon, lat))
    in_range, heard = (
        tree.query_ball_point(tree.data, away, return_length=True) for away in (air.range_m, air.reach_m + air.harm_m)
    )
    centre = int(np.lexsort((heard, in_range))[-1])
    near = np.array(tree.query_ball_point(tree.data[centre], air.reach_m + air.harm_m)[:MAX_MARKERS])
    east = np.radians((lon[near] - lon[centre] + 180.0) % 360.0 - 180.0) * np.cos(np.radians(lat[centre])) * 6_371_000.0
    north = np.radians(lat[near] - lat[centre]) * 6_371_000.0
    heading = np.radians(cerpms[centre].heading_deg)
    along = east * np.sin(heading) + north * np.cos(heading)
    across = np.clip(north * np.sin(heading) - east * np.cos(heading), -_CARRIAGEWAY_M, _CARRIAGEWAY_M)
    away = np.sqrt(np.maximum(east**2 + north**2 - across**2, 0.0))
    return RoadMarkers(np.copysign(away, along), across), cerpms[centre]
