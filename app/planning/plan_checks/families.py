"""Checks of a plan family by family: magnets, plates and CERPMs, with findings where they are worst."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Literal

import numpy as np
import scipy

from app.encoders.magnet.codebook import CodebookRules, codebook_capacity, list_conflicts
from app.geodesy.frames import ecef_from_wgs84
from app.markers.magnet import MAX_LINE_SPACING_M, MIN_GAP_M, Orientation
from app.markers.magnet_design import TagDesign, covariance_of, placements_of, separation_for
from app.markers.plate import NO_CHECK_TEXT, PlateGeometry, PlateScheme, plate_capacity
from app.markers.reading import Verdict
from app.planning.alignment import Lane
from app.planning.magnet_checks import (
    HALF_BAR_M,
    MAX_SHELL_MM,
    RECALL_SOURCE,
    SHELL_NOTE,
    magnet_recall,
    served_distance_m,
    served_sentence,
    turn_cure,
    turn_margin_m,
    vehicle_clearances,
)
from app.planning.placement.place import path_error_m, tag_conditions
from app.planning.placement.sites import distance_ahead_m
from app.planning.plan import (
    Plan,
    PlanFinding,
    PlannedCerpm,
    PlannedLineMagnet,
    PlannedMarker,
    PlannedPlate,
    PlannedTag,
)
from app.planning.predict.rates import camera_of, project_road
from app.planning.radio_checks import (
    INTERVALS_S,
    EvenRoad,
    PreviewRule,
    RadioCheck,
    RadioPlan,
    check_radio,
    recommend_settings,
)
from app.planning.rules import CameraRules, CerpmRules, PlateRules, TagRules
from app.radio.reception import MAX_MARKERS, SPACINGS_M, Air, RoadMarkers
from app.radio.regulation import LAWS, region_at
from app.radio.settings import SPREADING_FACTORS, RadioSettings, Region
from app.sensors.camera import Camera
from app.values import Floats

# === Findings at the place where they are worst.


def compare(
    name: str,
    figure: float,
    relation: Literal["<=", ">="],
    limit: float,
    unit: str,
    source: str,
    sentence: str,
    at: PlannedMarker | None = None,
    *,
    missed: Verdict = Verdict.FAIL,
) -> PlanFinding:
    """A finding that is OK where the figure keeps the limit, else `missed`; `at` is the marker where it is worst."""
    slack = 1e-9 * max(abs(limit), 1.0)
    met = figure <= limit + slack if relation == "<=" else figure >= limit - slack
    verdict = Verdict.OK if met else missed
    if at is None:
        return PlanFinding(name, figure, relation, limit, unit, source, verdict, sentence)
    return PlanFinding(
        name, figure, relation, limit, unit, source, verdict, sentence, at.lane, at.station_m, at.lon_deg, at.lat_deg
    )


# === CERPMs: the path that vehicles compute from them, and the radio where most of them are in range of each other.


_DEFAULT_REGION = Region.US915  # of the CERPM paper's markers
_EU_SETTINGS = RadioSettings(frequency_hz=868_300_000, power_dbm=14.0)  # within band M
_CARRIAGEWAY_M = 30.0  # [m] across; markers farther aside are farther along a bend; a motorway


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
    settings = radio.radio
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
            _first_settings(rules),
            spreading_factor=rules.spreading_factor,
            interval_s=rules.interval_s,
            bandwidth_hz=rules.bandwidth_hz,
        )
    mean = _radio_plan(plan, cerpms, rules, _first_settings(rules))
    found = _recommended(mean)
    markers, _marker = _busiest(cerpms, found.air)
    real = replace(found, markers=markers)
    if check_radio(real).read_probability >= real.min_probability:
        return found.radio
    farthest = replace(mean.radio, spreading_factor=SPREADING_FACTORS[-1], interval_s=INTERVALS_S[-1])
    markers, _marker = _busiest(cerpms, replace(mean, radio=farthest).air)
    return _recommended(replace(mean, markers=markers)).radio


def _first_settings(rules: CerpmRules) -> RadioSettings:
    """Settings to begin with, on a frequency and with a power of the region."""
    return _EU_SETTINGS if rules.region is Region.EU868 else RadioSettings()


def _radio_plan(plan: Plan, cerpms: Sequence[PlannedMarker], rules: CerpmRules, settings: RadioSettings) -> RadioPlan:
    lanes = {marker.lane for marker in cerpms}
    length_m = sum(plan.alignment.lane(name).length_m for name in lanes)
    spacing_m = min(max(2 * length_m / len(cerpms) / len(lanes), SPACINGS_M[0]), SPACINGS_M[1])
    made = RadioPlan(
        settings,
        rules.region or _DEFAULT_REGION,
        EvenRoad(spacing_m),
        design_speed_m_s=max(float(lane.design_speed_m_s.max()) for lane in plan.alignment.lanes),
        preview=PreviewRule(distance_m=rules.preview_m),
    )
    return replace(made, receiver=replace(made.receiver, channels=max(settings.channels, made.receiver.channels)))


def _recommended(wanted: RadioPlan) -> RadioPlan:
    """The plan with recommended settings, or as it is where none are lawful."""
    settings = recommend_settings(wanted).radio or wanted.radio
    receiver = replace(wanted.receiver, channels=max(settings.channels, wanted.receiver.channels))
    return replace(wanted, radio=settings, receiver=receiver)


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
    """The marker with most others in range, and those around it that can be received beside it.

    Their distances from it are the true ones, so that a bend does not bring them closer.
    """
    lon, lat = np.array([m.lon_deg for m in cerpms]), np.array([m.lat_deg for m in cerpms])
    tree = scipy.spatial.cKDTree(ecef_from_wgs84(lon, lat))
    in_range, received = (
        tree.query_ball_point(tree.data, away, return_length=True) for away in (air.range_m, air.reach_m + air.harm_m)
    )
    centre = int(np.lexsort((received, in_range))[-1])
    near = np.array(tree.query_ball_point(tree.data[centre], air.reach_m + air.harm_m)[:MAX_MARKERS])
    east = np.radians((lon[near] - lon[centre] + 180.0) % 360.0 - 180.0) * np.cos(np.radians(lat[centre])) * 6_371_000.0
    north = np.radians(lat[near] - lat[centre]) * 6_371_000.0
    heading = np.radians(cerpms[centre].heading_deg)
    along = east * np.sin(heading) + north * np.cos(heading)
    across = np.clip(north * np.sin(heading) - east * np.cos(heading), -_CARRIAGEWAY_M, _CARRIAGEWAY_M)
    away = np.sqrt(np.maximum(east**2 + north**2 - across**2, 0.0))
    return RoadMarkers(np.copysign(away, along), across), cerpms[centre]


# === Magnets: spacing, vehicles served by clearance, codes that stay distinguishable, and the distance to events.


_COUNTED = 2_000  # codes of a codebook that are counted; bounds the time


def check_magnets(plan: Plan) -> Iterator[PlanFinding]:
    """All checks of line magnets and tags."""
    lines = [marker for marker in plan.markers if isinstance(marker.detail, PlannedLineMagnet)]
    tags = [marker for marker in plan.markers if isinstance(marker.detail, PlannedTag)]
    if lines:
        yield from _line_spacing(plan, lines)
        yield from _unknown_styles(plan)
        yield _clearance(plan, "line", Orientation.UP)
    if tags:
        assert plan.rules.tags is not None
        yield _clearance(plan, "tags", Orientation.FORWARD)
        yield from _codebook(plan)
        yield _reaction(plan, tags, plan.rules.tags)
    if lines or tags:
        yield _neighbours(lines, tags)
        if plan.rules.installation.on_surface:
            yield compare(
                "shell-height", plan.rules.installation.height_mm, "<=", MAX_SHELL_MM, "mm",
                "MUTCD (2009), section 3B.11", SHELL_NOTE, missed=Verdict.WARN,
            )  # fmt: skip


def _line_spacing(plan: Plan, lines: list[PlannedMarker]) -> Iterator[PlanFinding]:
    """Farthest neighbours of the same line, gaps around avoided areas included; spacings that repeat with wheels."""
    by_line: dict[tuple[str, int], list[PlannedMarker]] = defaultdict(list)
    for marker in lines:
        assert isinstance(marker.detail, PlannedLineMagnet)
        by_line[marker.lane, marker.detail.side].append(marker)
    worst, farthest = lines[0], 0.0
    circumference_m = plan.rules.vehicles.wheel_circumference_m
    repeating: list[tuple[float, PlannedMarker]] = []
    for line in by_line.values():
        points = _ecef(line)
        apart = np.linalg.norm(np.diff(points, axis=0), axis=1)
        if len(apart) and turn_margin_m(float(np.median(apart)), circumference_m) < 0:
            repeating.append((float(np.median(apart)), line[0]))
        if len(apart) and float(apart.max()) > farthest:
            farthest, worst = float(apart.max()), line[int(apart.argmax())]
    yield compare(
        "line-spacing", farthest, "<=", MAX_LINE_SPACING_M + 0.005, "m", "METRO section 6.3",
        "farthest neighbours of a painted line", worst, missed=Verdict.WARN,
    )  # fmt: skip
    low, high = circumference_m
    sentence = f"lines whose magnets are half, one or two turns of a wheel of {low:g} to {high:g} m apart"
    if repeating:
        cure = turn_cure(circumference_m).replace("choose", "choose lines.max_spacing_m of")
        sentence += f", as the wheel's own field: {repeating[0][0]:.2f} m; {cure}"
    yield compare(
        "wheel-turns", len(repeating), "<=", 0, "lines", "docs/benchmarks.md: lines of magnets", sentence,
        repeating[0][1] if repeating else None, missed=Verdict.WARN,
    )  # fmt: skip


def _unknown_styles(plan: Plan) -> Iterator[PlanFinding]:
    unknown = {
        (marker.lane, marker.detail.side.name.lower())
        for marker in plan.markers
        if isinstance(marker.detail, PlannedLineMagnet) and marker.detail.style.value == "unknown"
    }
    if unknown:
        names = ", ".join(f"{side} of lane {lane}" for lane, side in sorted(unknown)[:5])
        yield compare(
            "line-style", len(unknown), "<=", 0, "lines", "METRO section 6.3: N on solid, S on dashed lines",
            f"lines whose paint the road's file does not state, taken as solid: {names}", missed=Verdict.WARN,
        )  # fmt: skip


def _clearance(plan: Plan, what: str, orientation: Orientation) -> PlanFinding:
    """Distance from the sensors to the magnets, for most of the kind of vehicle to be served."""
    rules = plan.rules
    kind = rules.tags.clearance_class if rules.tags is not None else TagRules().clearance_class
    name = f"clearance {kind}" + (f" {what}" if what != "tags" else "")
    if kind not in vehicle_clearances():
        known = ", ".join(vehicle_clearances())
        return compare("clearance", 0, ">=", 1, "classes", "METRO figure 14a", f"{kind[:40]!r} is none of {known}")
    readable_m = magnet_recall(orientation).proven_m
    distance_m = served_distance_m(kind, rules.installation)
    sentence = f"{what}: {served_sentence(kind, rules.installation, readable_m)}"
    if distance_m > readable_m:
        sentence += "; choose a smaller installation.hole_depth_mm, or installation.mounting: surface"
    return compare(
        name, distance_m, "<=", readable_m, "m", f"METRO figure 14a; {RECALL_SOURCE}", sentence, missed=Verdict.WARN
    )


def _codebook(plan: Plan) -> Iterator[PlanFinding]:
    book = plan.codebook
    assert book is not None
    reading = tag_conditions(plan.rules, plan.alignment)
    at = f"at {reading.speed_m_s * 3.6:.0f} km/h, {100 * reading.clearance_m:.0f} cm above the magnets"
    used = len(book.entries)
    capacity = max(codebook_capacity(book.design, reading, max_count=_COUNTED), used)
    least = "at least " if capacity == _COUNTED else ""
    yield compare(
        "codebook-room", used / capacity, "<=", 1.0, "share", "METRO equation 2 and figure 17",
        f"{used} of {least}{capacity} codes that stay distinguishable {at} are used",
    )  # fmt: skip
    near = list_conflicts(book, reading)
    yield compare(
        "distinguishable-codes", len(near), "<=", 0, "pairs", "docs/magnets.md: confused once in 1,000 readings",
        f"pairs of codes that are nearer to each other than the decoder's error allows {at}",
    )  # fmt: skip
    if book.design.magnets > 2:
        yield _resolution(book.design, reading, at)


def _resolution(design: TagDesign, reading: CodebookRules, at: str) -> PlanFinding:
    """The grid of a tag's middle magnets, against how far one must move to be another code.

    A longer tag with longer segments is for higher speeds, at which the bar has fewer samples of each magnet, and for
    larger distances (METRO section 10).
    """
    covariance = covariance_of(placements_of(design).astype(np.float64) * design.segment_m, reading.conditions)
    std_m = design.length_m * math.sqrt(float(np.diagonal(covariance, axis1=1, axis2=2).max()))
    needed_m = separation_for(reading.confusion) * std_m
    sentence = f"segments of tags, against the least move of a magnet that is read as another code {at}"
    if design.segment_m < needed_m:
        sentence += "; some codes are left out: longer tags with longer segments keep all (tags.size: freeway)"
    return compare(
        "tag-resolution", design.segment_m, ">=", needed_m, "m", "METRO sections 4.2 and 10; docs/plans.md", sentence,
        missed=Verdict.WARN,
    )  # fmt: skip


def _reaction(plan: Plan, tags: list[PlannedMarker], rules: TagRules) -> PlanFinding:
    """Distance from a tag's last magnet to its event, less the needed one; at most 0 where tags had to move back."""
    worst, least = tags[0], np.inf
    for marker in tags:
        detail = marker.detail
        assert isinstance(detail, PlannedTag)
        if detail.event.kind.value == "arrow":
            continue
        lane = plan.alignment.lane(marker.lane)
        needed = distance_ahead_m(lane, detail.event.chainage_m, rules)
        spare = detail.event.chainage_m - detail.magnets[-1][0] - needed
        if spare < least:
            worst, least = marker, spare
    spare_m = float(least) if np.isfinite(least) else 0.0
    return compare(
        "reaction-distance", spare_m, ">=", -0.01, "m", "AASHTO Green Book (2018), section 3.2.2",
        "distance from a tag's last magnet to its event beyond what reaction and deceleration need", worst,
    )  # fmt: skip


def _neighbours(lines: list[PlannedMarker], tags: list[PlannedMarker]) -> PlanFinding:
    """Nearest two magnets of different markers, and nearest two of one tag."""
    magnets: list[tuple[float, float]] = [(marker.lon_deg, marker.lat_deg) for marker in lines]
    owners = list(lines)
    gaps = [np.inf]
    for marker in tags:
        assert isinstance(marker.detail, PlannedTag)
        gaps += [b[0] - a[0] for a, b in pairwise(marker.detail.magnets)]
        magnets += [(lon, lat) for _, lon, lat in marker.detail.magnets]
        owners += [marker] * len(marker.detail.magnets)
    points = ecef_from_wgs84(*(np.array(values) for values in zip(*magnets, strict=True)))
    if len(points) < 2:
        return compare("magnet-spacing", MIN_GAP_M, ">=", MIN_GAP_M, "m", "METRO figure 17a", "there is one magnet")
    distance = np.asarray(scipy.spatial.cKDTree(points).query(points, k=2)[0])
    k = int(distance[:, 1].argmin())
    return compare(
        "magnet-spacing", float(distance[k, 1]), ">=", MIN_GAP_M - 0.001, "m", "METRO figure 17a",
        f"nearest two magnets; a bar reads {HALF_BAR_M:.2f} m to each side", owners[k],
    )  # fmt: skip


def _ecef(markers: list[PlannedMarker]) -> Floats:
    return ecef_from_wgs84(np.array([m.lon_deg for m in markers]), np.array([m.lat_deg for m in markers]))


# === Plates: frames in which each camera reads them at the design speed, and room in their scheme.


ROWS_PER_UNIT = 2.0
"""Rows of the image that a unit must cover to be readable. [px] Source: the decoder's bound of rows for digits that
nothing else confirms is 1.25 (docs/decisions/0010); the rest is in reserve."""
MAX_BLUR_UNITS = 1.0
"""Units that a plate may move during the exposure. Source: PolyU trials (docs/benchmarks.md): 80 km/h with 1/1000 s is
0.6 units and read."""
MAX_SHEAR_SHARE = 0.1
"""Share of its length by which a rolling shutter may stretch a plate. The pose fit's slack."""
_STEP_M = 0.02  # [m] between distances that are tried
_NEAREST_M, _FARTHEST_M = 0.3, 40.0  # [m] source: beyond it no unit of 50 mm covers two rows of a camera up to 5 m high


def readable_zone_m(camera: Camera, geometry: PlateGeometry, left_m: float = 0.0, grade_change: float = 0.0) -> float:
    """Length of road on which a plate is wholly in the image with enough rows per unit. [m]

    Parameters
    ----------
    left_m : float
        Plate's centre left of the camera. [m]
    grade_change : float
        Slope of the road at the plate against that under the vehicle; a crest makes it flatter in the image.
    """
    ahead = np.arange(_NEAREST_M, _FARTHEST_M, _STEP_M)
    side = geometry.side_mm / 1000
    corners = [(forward, across) for forward in (-side / 2, side / 2) for across in (-side / 2, side / 2)]
    inside = np.ones(len(ahead), dtype=bool)
    for forward, across in corners:
        u, v = project_road(camera, ahead + forward, left_m + across, grade_change * ahead)
        inside &= (u >= 0) & (u <= camera.width_px - 1) & (v >= 0) & (v <= camera.height_px - 1)
    unit = (geometry.unit_mm + geometry.gap_mm) / 1000
    rise = grade_change * ahead
    _, far = project_road(camera, ahead + side / 2, np.full_like(ahead, left_m), rise)
    _, near = project_road(camera, ahead + side / 2 - unit, np.full_like(ahead, left_m), rise)
    return float(np.count_nonzero(inside & (near - far >= ROWS_PER_UNIT)) * _STEP_M)


def frames_per_pass(
    camera: CameraRules, geometry: PlateGeometry, speed_m_s: float, left_m: float = 0.0, grade_change: float = 0.0
) -> float:
    """Mean number of frames of a pass in which a plate is readable; 0 where it is blurred too much."""
    blur_units = speed_m_s * camera.exposure_s / ((geometry.unit_mm + geometry.gap_mm) / 1000)
    if blur_units > MAX_BLUR_UNITS:
        return 0.0
    return readable_zone_m(camera_of(camera), geometry, left_m, grade_change) * camera.frames_per_s / speed_m_s


def check_plates(plan: Plan) -> Iterator[PlanFinding]:
    """Frames per pass of each camera, rolling shutter, and room in the scheme."""
    rules = plan.rules.plates
    plates = [marker for marker in plan.markers if isinstance(marker.detail, PlannedPlate)]
    if rules is None or not plates:
        return
    for camera in plan.rules.cameras:
        yield _frames(plan, plates, camera, rules)
        if camera.rolling_shutter_s > 0:
            yield _rolling_shutter(plan, plates, camera)
    yield _room(plates, rules)
    yield _alone(plan, plates, rules)


def _frames(plan: Plan, plates: Sequence[PlannedMarker], camera: CameraRules, rules: PlateRules) -> PlanFinding:
    geometry = PlateGeometry(rules.n, rules.unit_mm, rules.gap_mm, rules.thickness_mm)
    zones = {offset: readable_zone_m(camera_of(camera), geometry, offset) for offset in {m.offset_m for m in plates}}
    unit_m = (geometry.unit_mm + geometry.gap_mm) / 1000
    worst, frames, speed = plates[0], math.inf, 0.0
    for marker in plates:
        lane = plan.alignment.lane(marker.lane)
        at_m_s = float(lane.value_at(lane.design_speed_m_s, marker.chainage_m))
        blurred = at_m_s * camera.exposure_s / unit_m > MAX_BLUR_UNITS
        found = 0.0 if blurred else zones[marker.offset_m] * camera.frames_per_s / at_m_s
        if found < frames:
            worst, frames, speed = marker, found, at_m_s
    sentence = (
        f"mean readable frames per pass of {camera.name} at {speed * 3.6:.0f} km/h: {zones[worst.offset_m]:.1f} m "
        f"of road with {ROWS_PER_UNIT:g} rows per unit at {camera.frames_per_s:g} frames/s"
    )
    if frames < rules.min_frames:
        sentence += "; a faster, higher or steeper camera, a shorter exposure or larger units give more"
    source = "geometry of the camera; rows per unit from docs/decisions/0010, blur from docs/benchmarks.md"
    return compare(f"frames-per-pass {camera.name}", frames, ">=", rules.min_frames, "frames", source, sentence, worst)


def _rolling_shutter(plan: Plan, plates: Sequence[PlannedMarker], camera: CameraRules) -> PlanFinding:
    """Stretch of a plate by the rows that are read later, as a share of its length."""
    worst = max(plates, key=lambda marker: _speed_m_s(plan, marker))
    speed = _speed_m_s(plan, worst)
    detail = worst.detail
    assert isinstance(detail, PlannedPlate)
    view = camera_of(camera)
    length = detail.geometry.side_mm / 1000
    ahead = view.height_m / math.tan(math.radians(max(view.depression_deg, 5.0)))
    _, far = project_road(view, np.array([ahead + length / 2]), np.zeros(1), np.zeros(1))
    _, near = project_road(view, np.array([ahead - length / 2]), np.zeros(1), np.zeros(1))
    seconds = float(near[0] - far[0]) / camera.height_px * camera.rolling_shutter_s
    share = speed * seconds / length
    sentence = f"share of its length by which {camera.name} stretches a plate at {speed * 3.6:.0f} km/h"
    return compare(
        f"rolling-shutter {camera.name}", share, "<=", MAX_SHEAR_SHARE, "share", "geometry of the camera", sentence,
        worst, missed=Verdict.WARN,
    )  # fmt: skip


def _room(plates: Sequence[PlannedMarker], rules: PlateRules) -> PlanFinding:
    capacity = plate_capacity(rules.n, rules.scheme, 1)
    codes = len({marker.code for marker in plates})
    if rules.scheme is PlateScheme.ID:
        used = codes / 2.0**capacity.bits
        sentence = f"{codes} of 2^{capacity.bits:.0f} registry numbers"
        return compare("plate-scheme", used, "<=", 0.5, "share", "PlateScheme.ID: Reed-Solomon over GF(16)", sentence)
    sentence = f"{len(plates) - codes} plates have the same digits as another plate of the plan"
    return compare("plate-scheme", len(plates) - codes, "<=", 0, "plates", "PolyU section II.A", sentence)


def _alone(plan: Plan, plates: Sequence[PlannedMarker], rules: PlateRules) -> PlanFinding:
    """Plates whose digits nothing confirms, where vehicles read them without the registry."""
    count = 0 if rules.scheme.has_check or not plan.rules.vehicles.read_alone else len(plates)
    sentence = "plates of a scheme without a check, for vehicles that read alone"
    if count:
        sentence += f": {NO_CHECK_TEXT}; choose plates.scheme: {PlateScheme.POSITION_ROBUST} or {PlateScheme.ID}, or "
        sentence += "vehicles.read_alone: false if all vehicles know the registered plates"
    return compare(
        "plate-check", count, "<=", 0, "plates", "docs/artwork.md", sentence, plates[0] if count else None,
        missed=Verdict.WARN,
    )  # fmt: skip


def _speed_m_s(plan: Plan, marker: PlannedMarker) -> float:
    lane = plan.alignment.lane(marker.lane)
    return float(lane.value_at(lane.design_speed_m_s, marker.chainage_m))
