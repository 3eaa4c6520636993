"""Identification: which of the tags that may be on the road a row of magnets is.

A row is matched as a whole: the first and the last magnet of a tag are L apart, which gives the scale of the odometer,
and the others must then stand where the tag has them. So a magnet that was missed, or one too many, costs at most the
tag that it belongs to.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Annotated, NamedTuple

import numpy as np
import numpy.typing as npt
from pydantic import ConfigDict, Field, with_config
from pyproj import Geod

from app.decoders.magnet.readings import LineCrossing, MagnetReading, NoiseFinding, PlacedMagnet, TagReading
from app.errors import InvalidParameter
from app.geodesy import LocalizationGrade, enu_from_wgs84, wgs84_from_enu
from app.inputs import Number, Whole
from app.markers.magnet import HALF_HEIGHT_M, InformationTag, Polarity, check_magnet_count, segments_in
from app.markers.magnet_design import Meaning
from app.markers.reading import Matrix
from app.sensors.magnetometer_bar import MagnetometerBar
from app.values import Floats

# === What matching and localization need to know of a registered information tag.


@dataclass(frozen=True, slots=True)
class RegisteredTag:
    """What the registry knows of an information tag."""

    marker_id: str
    status: str
    tag: InformationTag
    # `lon_deg`, `lat_deg`: [deg] of its first magnet, WGS 84 / ITRF
    lon_deg: float
    lat_deg: float
    height_m: float | None
    # [deg] of the tag in the east, north, up frame at `lane_lon_deg`, `lane_lat_deg`; clockwise from north
    bearing_deg: float
    # `lane_lon_deg`, `lane_lat_deg`: [deg] where its lane begins
    lane_lon_deg: float
    lane_lat_deg: float
    horizontal_rmse_m: float | None  # [m] of both axes together; None where it is not stated
    grade: str  # a `LocalizationGrade`
    localization_warnings: tuple[str, ...] = ()  # what makes its position unfit for localization
    meaning: Meaning | None = None
    depth_m: float = -HALF_HEIGHT_M  # [m] of its magnets' centres below the road


# === Identification.


_MAX_SCALE_ERROR = 0.04  # share by which the odometer may be off; several times a wheel's wear
_MAX_LENGTH_ERROR_M = 0.10  # [m] more that a distance may be off
_SCALE_STD = 0.015  # standard deviation of the odometer's scale; tyres and pressure
_PLACEMENT_STD_M = 0.004  # [m] of a magnet's place in the road; source: METRO section 8.2 saw less than 0.003
_STD_FACTOR = 1.5  # on a place's standard error, for what the fit does not know
_MISSING_COST = 16.0  # chi-squared of a missing magnet
_EXTRA_COST = 6.0  # chi-squared of a magnet that is not of the tag
_MAX_PLACE_COST = 25.0  # chi-squared up to which a magnet stands where the tag has one: five sigma
_MAX_MISSING = 1  # magnets of a tag that may be missing; two leave too many tags alike
_MIN_GRID_STD = 0.05  # [segments] smallest standard error of a place on the grid
_MISSING_PROBABILITY = 0.5  # of a format with missing magnets, whose code is unknown


@with_config(ConfigDict(extra="forbid"))
@dataclass(frozen=True, slots=True)
class TagFormat:
    """Tags of M magnets over L metres on a grid of Seg_d, whatever their code."""

    magnets: Annotated[Whole, Field(ge=2, le=7, description="M.")] = 3
    length_m: Annotated[Number, Field(description="L. [m]")] = 4.0
    segment_m: Annotated[Number, Field(description="Seg_d. [m]")] = 1.0

    def __post_init__(self) -> None:
        check_magnet_count(self.magnets)
        segments_in(self.length_m, self.segment_m)


@dataclass(frozen=True, slots=True)
class Identification:
    """A tag found in a row of magnets."""

    members: tuple[int, ...]  # indices in the row of the tag's magnets
    tag: InformationTag | None  # None if magnets are missing and the format alone does not show where they were
    wrong_way: bool  # the tag was passed against the direction of legal travel
    # `missing`, `extra`: magnets of the tag that are not in the row, and magnets between its own that are not of it
    missing: int
    extra: int
    cost: float  # Chi-squared of its places with penalties
    probability: float = 1.0  # against the other tags that fit


class _Row(NamedTuple):
    """Magnets of a row: chainage along its chords [m], polarity as a sign, standard error of the chainage [m]."""

    at: Floats
    signs: Floats
    std: Floats


class _TagTable(NamedTuple):
    """Tags with the same number of magnets: index among all, offsets (T, M) [m], polarities as signs (T, M)."""

    numbers: npt.NDArray[np.intp]
    offsets: Floats
    signs: Floats


class TagCandidates:
    """Tags that may be on the road, or formats of them.

    Parameters
    ----------
    tags : sequence of InformationTag
        Registered tags; the direction of travel is identified too.
    formats : sequence of TagFormat
        Used where no tag is registered.

    Raises
    ------
    InvalidParameter
        Both tags and formats were passed.
    """

    def __init__(self, tags: Sequence[InformationTag] = (), formats: Sequence[TagFormat] = ()) -> None:
        if tags and formats:
            raise InvalidParameter(
                "tags and formats exclude each other", field="formats", limit="tags or formats", cure="leave one out"
            )
        self.formats = tuple(formats)
        legal = {tag.text for tag in tags}
        self._tags = [(tag, False) for tag in tags]
        self._tags += [(tag, True) for tag in tags if tag.reversed_wrong_way().text not in legal]
        lengths = [tag.length_m for tag in tags] or [f.length_m for f in formats]
        self.longest_m = max(lengths, default=0.0)
        gaps = [g for tag in tags for g in tag.gaps_m] or [f.length_m for f in formats]
        self.longest_gap_m = max(gaps, default=0.0)
        self._tables = _tag_tables([tag.reversed_wrong_way() if wrong else tag for tag, wrong in self._tags])

    def __bool__(self) -> bool:
        return bool(self._tags or self.formats)

    def identify(self, magnets: Sequence[PlacedMagnet]) -> Identification | None:
        """The likeliest tag in a row; the earliest of equals."""
        row = _make_row(magnets)
        if self._tags:
            matches = self._match_tags(row)
        else:
            matches = [m for f in self.formats for m in _match_format(f, row)]
        if not matches:
            return None
        best = min(matches, key=lambda m: (round(m.cost, 6), m.members[0]))
        rivals = [
            m
            for m in matches
            if (m.tag, m.wrong_way) != (best.tag, best.wrong_way) and m.members[0] <= best.members[-1]
        ]
        against = sum(math.exp(-min((m.cost - best.cost) / 2, 50)) for m in rivals)
        return replace(best, probability=best.probability / (1 + against))

    def _match_tags(self, row: _Row) -> list[Identification]:
        matches = []
        for table in self._tables:
            count = table.offsets.shape[1]
            for i, j in combinations(range(len(row.at)), 2):
                for a, b in combinations(range(count), 2):
                    if count - (b - a) <= 1 + _MAX_MISSING:  # a magnet may be missing at an end
                        matches += self._match_pair((i, j), (a, b), table, row)
        return matches

    def _match_pair(
        self, pair: tuple[int, int], ends: tuple[int, int], table: _TagTable, row: _Row
    ) -> list[Identification]:
        """Tags whose magnets at the two ends are a pair of the row: they give the scale, the others must fit."""
        (i, j), (a, b) = pair, ends
        length = row.at[j] - row.at[i]
        expected = table.offsets[:, b] - table.offsets[:, a]
        scale = length / expected
        fits = abs(length - expected) < _MAX_SCALE_ERROR * expected + _MAX_LENGTH_ERROR_M
        fits &= (table.signs[:, a] == row.signs[i]) & (table.signs[:, b] == row.signs[j])
        matches = []
        for k in np.flatnonzero(fits):
            places = row.at[i] + (table.offsets[k] - table.offsets[k, a]) * scale[k]
            members, cost = _assign_magnets(places, table.signs[k], row)
            missing = members.count(-1)
            if i not in members or j not in members or missing > min(table.offsets.shape[1] - 2, _MAX_MISSING):
                continue
            own = [m for m in members if m >= 0]
            extra = own[-1] - own[0] + 1 - len(own)
            cost += _MISSING_COST * missing + _EXTRA_COST * extra + ((scale[k] - 1) / _SCALE_STD) ** 2
            tag, wrong = self._tags[int(table.numbers[k])]
            matches.append(Identification(tuple(own), tag, wrong, missing, extra, cost))
        return matches


def _tag_tables(tags: Sequence[InformationTag]) -> list[_TagTable]:
    """The tags as they are passed, in tables by their number of magnets."""
    tables = []
    for count in {tag.magnet_count for tag in tags}:
        numbers = [i for i, tag in enumerate(tags) if tag.magnet_count == count]
        offsets = np.array([tags[i].offsets_m for i in numbers])
        signs = np.array([[p.sign for p in tags[i].polarities] for i in numbers], float)
        tables.append(_TagTable(np.array(numbers), offsets, signs))
    return tables


def _make_row(magnets: Sequence[PlacedMagnet]) -> _Row:
    places = np.array([m.place_m for m in magnets])
    chords = np.linalg.norm(np.diff(places, axis=0), axis=1) if len(magnets) > 1 else np.empty(0)
    return _Row(
        np.concatenate(([0.0], np.cumsum(chords))),
        np.array([m.reading.polarity.sign for m in magnets], float),
        np.array([math.hypot(m.reading.relative_std_m, _PLACEMENT_STD_M) for m in magnets]),
    )


def _assign_magnets(places: Floats, signs: Floats, row: _Row) -> tuple[list[int], float]:
    """The row's magnet at each place of a tag, -1 for none, and chi-squared."""
    members: list[int] = []
    cost = 0.0
    for place, sign in zip(places, signs, strict=True):
        chi2 = ((row.at - place) / (_STD_FACTOR * row.std)) ** 2 + np.where(row.signs == sign, 0, np.inf)
        k = int(np.argmin(chi2))
        if chi2[k] < _MAX_PLACE_COST and k not in members:
            members.append(k)
            cost += float(chi2[k])
        else:
            members.append(-1)
    return members, cost


def _match_format(form: TagFormat, row: _Row) -> list[Identification]:
    """Tags of a format whose first and last magnet are in the row."""
    matches: list[Identification] = []
    for i, j in combinations(range(len(row.at)), 2):
        length = row.at[j] - row.at[i]
        if abs(length - form.length_m) > _MAX_SCALE_ERROR * form.length_m + _MAX_LENGTH_ERROR_M:
            continue
        between = range(i + 1, j)
        scale_cost = ((length / form.length_m - 1) / _SCALE_STD) ** 2
        missing = form.magnets - 2 - len(between)
        if missing > 0:
            cost = scale_cost + _MISSING_COST * missing
            matches.append(Identification((i, *between, j), None, False, missing, 0, cost, _MISSING_PROBABILITY))
            continue
        for middle in combinations(between, form.magnets - 2):
            match = _match_on_grid(form, row, (i, *middle, j), scale_cost)
            if match is not None:
                matches.append(match)
    return matches


def _match_on_grid(form: TagFormat, row: _Row, members: tuple[int, ...], scale_cost: float) -> Identification | None:
    """The tag of a format whose magnets are these; None if two of them are nearest to one place of the grid."""
    i, *middle, j = members
    n, length = segments_in(form.length_m, form.segment_m), row.at[j] - row.at[i]
    step = (row.at - row.at[i]) / length * n
    std = np.hypot(row.std, math.hypot(row.std[i], row.std[j]) / 2) / length * n
    positions = [round(float(step[k])) for k in middle]
    if any(not a < b for a, b in zip([0, *positions], [*positions, n], strict=True)):
        return None
    off = [float(step[k]) - p for k, p in zip(middle, positions, strict=True)]
    # the next place of the grid is the rival of each
    odds = [
        math.exp(min(((d * d) - (1 - abs(d)) ** 2) / (2 * std[k] ** 2), 0.0)) for k, d in zip(middle, off, strict=True)
    ]
    cost = scale_cost + sum((d / max(std[k], _MIN_GRID_STD)) ** 2 for k, d in zip(middle, off, strict=True))
    extra = j - i + 1 - len(members)
    polarities = tuple(Polarity.N if row.signs[k] > 0 else Polarity.S for k in members)
    tag = InformationTag(polarities, form.length_m, form.segment_m, tuple(positions))
    probability = math.prod(1 / (1 + o) for o in odds)
    return Identification(members, tag, False, 0, extra, cost + _EXTRA_COST * extra, probability)


# === Position and heading of the vehicle from one matched information tag.


LATERAL_STD_M, LATERAL_STD_CLEARANCE_M = 0.003, 0.16
"""Lateral error of a magnet on the bar, and the clearance at which it is so large; it grows with the square of the
clearance. [m] Source: `python -m benchmarks.magnets lateral` (docs/benchmarks.md): 0.30 cm at 16 cm, 1.00 cm at 30
cm."""
MIN_CLEARANCE_RATIO = 0.5
"""Smallest clearance for that, over `LATERAL_STD_CLEARANCE_M`."""
TAG_BEARING_STD_DEG = 0.1
"""Error of a tag's direction in the road. [deg] Two holes 4 m apart, each drilled within 5 mm."""
ASSUMED_HORIZONTAL_RMSE_M = 1.0
"""Error of a tag's position without a stated one, both axes together. [m]"""
MAX_DRIFT = 0.9
"""Largest lateral drift over a tag per metre, of which the arc sine is the heading."""
DISTINCT_RATIO, DISTINCT_M2 = 4.0, 1e-4
"""The second best choice of holes must fit so many times worse, and by a sum of squares more. [1, m2]"""


@dataclass(frozen=True, slots=True)
class TagFixSigma:
    """Standard deviations of a vehicle's position at a tag, along and across the lane."""

    along_m: float
    across_m: float
    heading_deg: float


@dataclass(frozen=True, slots=True)
class TagFix:
    """The vehicle's position at a tag's last magnet; the covariance is of east, north [m] and heading [rad]."""

    t_s: float  # [s] time in the trace
    # `lon_deg`, `lat_deg`, `heading_deg`: [deg] of the vehicle's reference point
    lon_deg: float
    lat_deg: float
    heading_deg: float
    covariance: Matrix  # shape (3, 3)
    sigma: TagFixSigma
    across_m: float  # [m] of the bar's middle from the tag's line, left positive
    localization_grade: LocalizationGrade
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class _Passage:
    """A tag's magnets as they were passed, K of them, in the lane's east and north.

    along_m, lateral_m (K,): odometer, and place on the bar to the left; holes_m (K, 2): where the magnets are;
    span_m: from the first to the last hole; bearing_rad: of legal travel along the tag.
    """

    along_m: Floats
    lateral_m: Floats
    holes_m: Floats
    span_m: float
    bearing_rad: float
    wrong_way: bool

    @property
    def drift(self) -> float:
        """Slope of the lateral place over the distance driven, by least squares."""
        along = self.along_m - self.along_m.mean()
        return float((along * (self.lateral_m - self.lateral_m.mean())).sum() / (along**2).sum())

    @property
    def heading_rad(self) -> float:
        """Heading: magnets in a row drift to the left on the bar of a vehicle that heads right of it."""
        turn = math.asin(float(np.clip(self.drift, -MAX_DRIFT, MAX_DRIFT)))
        return self.bearing_rad + (math.pi if self.wrong_way else 0.0) + turn


def fix_from_tag(reading: TagReading, tag: RegisteredTag, bar: MagnetometerBar) -> TagFix | None:
    """Vehicle's position and heading from one matched tag; None where the magnets fit several of its holes."""
    frame = (tag.lane_lon_deg, tag.lane_lat_deg, tag.height_m or 0.0)
    first_m = enu_from_wgs84(tag.lon_deg, tag.lat_deg, frame[2], frame)
    passage = _passage(reading, tag, first_m[:2])
    if passage is None:
        return None
    forward = np.array([math.sin(passage.heading_rad), math.cos(passage.heading_rad)])
    left = np.array([-forward[1], forward[0]])
    # the tag's own length takes the scale of the vehicle's speed out
    along_m = passage.along_m
    left_over_m = (along_m[-1] - along_m) * passage.span_m / (along_m[-1] - along_m[0])
    # each magnet shows where the bar's middle is at the last one
    middles_m = passage.holes_m + left_over_m[:, None] * forward - passage.lateral_m[:, None] * left
    array = bar.positions_m[bar.array]
    bar_m = np.array([array[:, 0].mean(), (array[:, 1].max() + array[:, 1].min()) / 2])
    place = middles_m.mean(axis=0) - bar_m[0] * forward - bar_m[1] * left
    lon_deg, lat_deg, _height = wgs84_from_enu(np.array([*place, first_m[2]]), frame)
    along_std_m, across_std_m, heading_std = _standard_errors(reading, tag, passage)
    axes = np.stack([forward, left], axis=1)
    covariance = np.zeros((3, 3))
    covariance[:2, :2] = axes @ np.diag([along_std_m**2, across_std_m**2]) @ axes.T
    covariance[2, 2] = heading_std**2
    lane_left = np.array([-math.cos(passage.bearing_rad), math.sin(passage.bearing_rad)])
    return TagFix(
        t_s=reading.end_s,
        lon_deg=lon_deg,
        lat_deg=lat_deg,
        heading_deg=math.degrees(passage.heading_rad) % 360.0,
        covariance=covariance,
        sigma=TagFixSigma(along_std_m, across_std_m, math.degrees(heading_std)),
        across_m=float((middles_m.mean(axis=0) - passage.holes_m[-1]) @ lane_left),
        localization_grade=LocalizationGrade.UNFIT if tag.localization_warnings else LocalizationGrade(tag.grade),
        notes=tag.localization_warnings,
    )


def _passage(reading: TagReading, tag: RegisteredTag, first_m: Floats) -> _Passage | None:
    """The reading's magnets with their holes; None where several choices of holes fit."""
    bearing = math.radians(tag.bearing_deg)
    holes_m = np.array(tag.tag.offsets_m)
    places_m = first_m + holes_m[:, None] * np.array([math.sin(bearing), math.cos(bearing)])
    if reading.wrong_way:
        holes_m, places_m = holes_m[::-1], places_m[::-1]
    along_m = np.array([magnet.odometer_m for magnet in reading.magnets])
    chosen = _choose_holes(along_m - along_m[0], np.abs(holes_m - holes_m[0]))
    if chosen is None:
        return None
    return _Passage(
        along_m=along_m,
        lateral_m=np.array([magnet.lateral_cm for magnet in reading.magnets]) / 100,
        holes_m=places_m[list(chosen)],
        span_m=abs(float(holes_m[chosen[-1]] - holes_m[chosen[0]])),
        bearing_rad=bearing,
        wrong_way=reading.wrong_way,
    )


def _standard_errors(reading: TagReading, tag: RegisteredTag, passage: _Passage) -> tuple[float, float, float]:
    """Standard errors along and across the lane [m] and of the heading [rad], the survey's with them."""
    count, along_m = len(reading.magnets), passage.along_m
    survey_m = (tag.horizontal_rmse_m or ASSUMED_HORIZONTAL_RMSE_M) / math.sqrt(2)
    clearance_m = float(np.median([magnet.clearance_cm for magnet in reading.magnets])) / 100
    lateral_std_m = LATERAL_STD_M * max(clearance_m / LATERAL_STD_CLEARANCE_M, MIN_CLEARANCE_RATIO) ** 2
    spread_m = math.sqrt(float(((along_m - along_m.mean()) ** 2).sum()))
    heading_std = math.hypot(lateral_std_m / spread_m, math.radians(TAG_BEARING_STD_DEG))
    stamps_m = float(np.mean([m.along_std_m or 0.0 for m in reading.magnets]))  # they share stamps
    along_std_m = math.hypot(stamps_m, survey_m)
    turned_m = 0.5 * abs(along_m[-1] - along_m[0]) * heading_std
    return along_std_m, math.hypot(lateral_std_m / math.sqrt(count), survey_m, turned_m), heading_std


def _choose_holes(met_m: Floats, holes_m: Floats) -> tuple[int, ...] | None:
    """Which holes the magnets are, both measured from the first, by the best fit of a common shift."""
    if not 2 <= len(met_m) <= len(holes_m):
        return None
    fits = []
    for chosen in combinations(range(len(holes_m)), len(met_m)):
        off = holes_m[list(chosen)] - met_m
        fits.append((float(((off - off.mean()) ** 2).sum()), chosen))
    fits.sort()
    if len(fits) > 1 and fits[1][0] < DISTINCT_RATIO * fits[0][0] + DISTINCT_M2:
        return None
    return fits[0][1]


# === Matching of a trace's tags with registered ones.
#
# The same on the server, from the registry, and on board, from a snapshot. The position that follows is below.


MAX_TAGS = 500
"""With more registered tags within reach the decoder takes formats instead. For speed."""
_ODOMETER_ERROR = 0.03  # share by which an odometer's distance may be off
_ODOMETER_SPARE_M = 10.0  # [m] more that it may be off
_MIN_STRAIGHT_SHARE = 0.6  # straight distance between two tags over the way driven, at least
_GEOD = Geod(ellps="WGS84")


def tag_candidates(tags: Sequence[RegisteredTag], formats: Iterable[TagFormat]) -> TagCandidates:
    """Tags that may be on the road; formats where none is registered, or too many are."""
    different = tuple(dict.fromkeys(tag.tag for tag in tags))
    if 0 < len(tags) <= MAX_TAGS:
        return TagCandidates(tags=different)
    return TagCandidates(formats=tuple(dict.fromkeys(formats)))


@dataclass(frozen=True, slots=True)
class TagMatch:
    """The registered tag that was passed; without it, none or several have this code."""

    tag: RegisteredTag | None
    others: tuple[str, ...] = ()
    note: str = ""


@dataclass(frozen=True, slots=True)
class ReadTag:
    """A tag with its match in the registry and the position that follows."""

    reading: TagReading
    match: TagMatch | None = None
    fix: TagFix | None = None


@dataclass(frozen=True, slots=True)
class ReadTrace:
    """All readings of a trace, its tags matched."""

    magnets: tuple[MagnetReading, ...]
    crossings: tuple[LineCrossing, ...]
    tags: tuple[ReadTag, ...]
    noise: tuple[NoiseFinding, ...]


def match_tags(findings: Sequence[object], nearby: Sequence[RegisteredTag], bar: MagnetometerBar) -> ReadTrace:
    """Match the tags of a trace with the registered ones within reach, in the order in which they were passed."""
    readings = sorted((f for f in findings if isinstance(f, TagReading)), key=lambda tag: tag.start_s)
    tags: list[ReadTag] = []
    for reading in readings:
        match = _match(reading, nearby, tags)
        fix = None
        if match is not None and match.tag is not None:
            fix = fix_from_tag(reading, match.tag, bar)
        tags.append(ReadTag(reading, match, fix))
    return ReadTrace(
        tuple(sorted((f for f in findings if isinstance(f, MagnetReading)), key=lambda f: f.t_s)),
        tuple(sorted((f for f in findings if isinstance(f, LineCrossing)), key=lambda f: f.t_s)),
        tuple(tags),
        tuple(sorted((f for f in findings if isinstance(f, NoiseFinding)), key=lambda f: f.t_s)),
    )


def _match(reading: TagReading, nearby: Sequence[RegisteredTag], before: Sequence[ReadTag]) -> TagMatch | None:
    if reading.tag is None or not nearby:
        return None
    found = [tag for tag in nearby if tag.tag == reading.tag]
    if len(found) > 1:
        found = _reachable(reading, found, before) or found
    if not found:
        return TagMatch(None, note="no tag with this code is registered nearby")
    if len(found) > 1:
        note = f"ambiguous: {len(found)} tags within reach have this code"
        return TagMatch(None, tuple(tag.marker_id for tag in found), note)
    return TagMatch(found[0])


def _reachable(reading: TagReading, among: Sequence[RegisteredTag], before: Sequence[ReadTag]) -> list[RegisteredTag]:
    """Those whose distance from the last tag that was matched fits the odometer."""
    known = next((tag for tag in reversed(before) if tag.match is not None and tag.match.tag is not None), None)
    if known is None or known.match is None or known.match.tag is None:
        return []
    driven_m = reading.magnets[0].odometer_m - known.reading.magnets[0].odometer_m
    last = known.match.tag
    slack_m = _ODOMETER_ERROR * driven_m + _ODOMETER_SPARE_M
    reachable = []
    for tag in among:
        away_m = float(_GEOD.inv(last.lon_deg, last.lat_deg, tag.lon_deg, tag.lat_deg)[2])
        # a road bends: the way is at least as long as the straight line
        if _MIN_STRAIGHT_SHARE * driven_m - slack_m <= away_m <= driven_m + slack_m:
            reachable.append(tag)
    return reachable
