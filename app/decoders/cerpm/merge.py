"""Verified packets to one position a marker, compared with the registry, the other markers and the vehicle's track."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np
import numpy.typing as npt

from app.decoders.cerpm.verify import (
    FreshnessRules,
    SequenceSpan,
    Verdict,
    Verification,
    VerifiedPacket,
    decode_message,
    verify_packets,
)
from app.errors import InvalidParameter, WaymarkError
from app.geodesy import LocalizationGrade, grade_accuracy
from app.geodesy.frames import metres_per_radian
from app.markers.cerpm import MAX_INVALID_TAGS_PER_LOG, MESSAGE_BYTES, CerpmMessage, LaneSide
from app.sensors.pose_track import PlainClaim, PoseTrack, ReceivedPacket
from app.values import Floats

# === Positions of the vehicle at given times, and distances from them.


MAX_GAP_S = 5.0  # [s] between poses further apart the position is unknown; 100 m at 72 km/h


def vehicle_positions(track: PoseTrack, time_s: npt.ArrayLike, max_gap_s: float = MAX_GAP_S) -> Floats:
    """Longitude and latitude of the vehicle at given times.

    Parameters
    ----------
    time_s : array_like, shape (N,)
        NaN where it is not known. [s]
    max_gap_s : float
        [s]

    Returns
    -------
    ndarray, shape (N, 2)
        Longitude, latitude; NaN before, after and in gaps of the track. [deg]
    """
    at = np.asarray(time_s, float)
    positions = np.full((len(at), 2), np.nan)
    if not len(track.time_s):
        return positions
    after = np.searchsorted(track.time_s, at, side="left").clip(0, len(track.time_s) - 1)
    before = np.maximum(np.where(track.time_s[after] == at, after, after - 1), 0)
    with np.errstate(invalid="ignore"):
        known = (at >= track.time_s[0]) & (at <= track.time_s[-1])
        known &= track.time_s[after] - track.time_s[before] <= max_gap_s
    lon = np.interp(at[known], track.time_s, np.unwrap(track.lon_deg, period=360.0))
    positions[known, 0] = (lon + 180.0) % 360.0 - 180.0
    positions[known, 1] = np.interp(at[known], track.time_s, track.lat_deg)
    return positions


def offsets_m(from_deg: npt.ArrayLike, to_deg: npt.ArrayLike) -> Floats:
    """East and north from places to others near them, on the ellipsoid; NaN where either is unknown.

    Parameters
    ----------
    from_deg, to_deg : array_like, shape (N, 2)
        Longitude, latitude. [deg]

    Returns
    -------
    ndarray, shape (N, 2)
        Accurate to 1e-5 over kilometres; of places far apart only the order of magnitude is correct. [m]
    """
    start, end = np.atleast_2d(np.asarray(from_deg, float)), np.atleast_2d(np.asarray(to_deg, float))
    lon = np.radians((end[:, 0] - start[:, 0] + 180.0) % 360.0 - 180.0)
    lat = np.radians(end[:, 1] - start[:, 1])
    middle = np.radians((end[:, 1] + start[:, 1]) / 2)
    east_per_rad, north_per_rad = metres_per_radian(middle)
    return np.stack([lon * east_per_rad, lat * north_per_rad], axis=1)


def distances_m(from_deg: npt.ArrayLike, to_deg: npt.ArrayLike) -> Floats:
    """Distances of `offsets_m`, shape (N,). [m]"""
    return np.asarray(np.hypot(*offsets_m(from_deg, to_deg).T))


# === Input and result of merging verified packets: registered markers, one position a marker, and disagreements.


class Disagreement(StrEnum):
    """How the messages of a marker disagree with each other, the registry or the track."""

    MOVED = "moved"
    TWO_PLACES = "two-places"
    REPROGRAMMED = "reprogrammed"
    OUT_OF_REACH = "out-of-reach"
    SWAPPED = "swapped"
    DATUM_SHIFT = "datum-shift"
    OTHER_SIDE = "other-side"


USED_ANYWAY = frozenset((Disagreement.REPROGRAMMED, Disagreement.OTHER_SIDE))
"""These are reported, and the marker is used."""


@dataclass(frozen=True, slots=True)
class RegisteredMarker:
    """A marker as it is registered."""

    # `lon_deg`, `lat_deg`: [deg] WGS 84 / ITRF
    lon_deg: float
    lat_deg: float
    height_m: float | None = None  # [m] above the ellipsoid
    side: LaneSide = LaneSide.UNKNOWN
    speed_limit_kmh: float = math.nan  # [km/h] NaN where none is posted
    sigma_m: float = math.nan  # [m] standard deviation of its survey on each axis; NaN if unknown


@dataclass(frozen=True, slots=True)
class Finding:
    """A disagreement about one marker."""

    number: int
    kind: Disagreement
    reason: str
    distance_m: float = math.nan  # [m] between the positions that disagree; NaN where there are none


@dataclass(frozen=True, slots=True)
class MergeRules:
    """Limits of a disagreement."""

    # [m] positions closer than this to the registered one, or to each other, agree
    apart_m: float = 0.5  # [m] a marker that is moved by less still marks the boundary
    # they also agree within this many standard deviations of the survey
    sigmas: float = 3.0  # source: three sigma, one false alarm in 370
    # [m] no marker is received from further away
    reach_m: float = 2000.0  # [m] six times the 340 m of the CERPM paper, section 4.1
    accept_clear: bool = False  # use packets in clear of markers without an authentic packet

    def __post_init__(self) -> None:
        for name in ("apart_m", "sigmas", "reach_m"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise InvalidParameter(f"{name} is {getattr(self, name)}", field=name, limit="above 0, finite")


@dataclass(frozen=True, slots=True, eq=False)
class MergedMarkers:
    """One row for each marker that may be used, and the findings on all."""

    number: npt.NDArray[np.int64]  # shape (K,)
    # `lon_deg`, `lat_deg`: shape (K,): [deg] registered position, or that of the newest authentic message
    lon_deg: Floats
    lat_deg: Floats
    side: npt.NDArray[np.int64]  # shape (K,): `LaneSide` values
    # `sigma_m`, `speed_limit_kmh`: shape (K,): [m, km/h]
    sigma_m: Floats
    speed_limit_kmh: Floats
    packets: npt.NDArray[np.int64]  # shape (K,): accepted ones
    registered: npt.NDArray[np.bool_]  # shape (K,)
    left_out: dict[int, str]  # markers without a row, with the reason
    findings: list[Finding]
    # [m] common shift of sent against registered positions, east and north, from another datum
    shift_m: tuple[float, float] | None
    warnings: list[str]


# === Verified packets to one position a marker, compared with the registry, the other markers and the vehicle's track.


SURVEY_SIGMA_M = 0.02  # [m] of a survey of unknown accuracy; source: CERPM paper, section 2.2
_MIN_SHIFTED = 3  # markers with a common shift; a median of three ignores one outlier
_MAX_SHIFT_SCATTER_M = 0.2  # [m] about a common shift; well above surveys of 0.02 m
_MIN_SHIFTED_SHARE = 0.8  # of the registered markers
_MAX_SHIFT_M = 1000.0  # [m] old national datums are shifted by some hundred metres against WGS 84
_SWAPPED_REACHES = 5.0  # reaches from its place, at which swapped coordinates are looked for


@dataclass(slots=True)
class _Candidate:
    """What was received of one marker number."""

    number: int
    newest: CerpmMessage | PlainClaim
    accepted: list[VerifiedPacket]
    place: tuple[float, float]
    known: RegisteredMarker | None


def merge_markers(
    verified: Iterable[VerifiedPacket],
    registered: Mapping[int, RegisteredMarker | None],
    track: PoseTrack | None = None,
    rules: MergeRules | None = None,
) -> MergedMarkers:
    """One position for each marker; disagreements are reported and, except for `USED_ANYWAY`, left out.

    Parameters
    ----------
    verified : iterable of VerifiedPacket
        Of `verify_packets`.
    registered : mapping of int to RegisteredMarker or None
        Registered markers by number.
    track : PoseTrack, optional
        The vehicle's own positions.

    Returns
    -------
    MergedMarkers
        In the order of numbers.
    """
    rules = rules or MergeRules()
    packets = list(verified)
    candidates = _candidates(packets, registered, rules)
    findings = _two_places(packets, candidates, rules)
    findings += _swapped(candidates, track, rules)
    warnings: list[str] = []
    findings += _out_of_reach(_without_findings(candidates, findings), track, rules, warnings)
    rest = _without_findings(candidates, findings)
    shift_m = _common_shift(rest, rules)
    findings += _compare_with_registry(rest, rules) if shift_m is None else _shifted(rest, shift_m)
    left_out = {f.number: f.reason for f in reversed(findings) if f.kind not in USED_ANYWAY}
    return _rows([c for c in candidates if c.number not in left_out], left_out, findings, shift_m, warnings)


def _without_findings(candidates: Sequence[_Candidate], findings: Sequence[Finding]) -> list[_Candidate]:
    """Candidates that no finding leaves out."""
    named = {finding.number for finding in findings if finding.kind not in USED_ANYWAY}
    return [candidate for candidate in candidates if candidate.number not in named]


def _candidates(
    packets: Sequence[VerifiedPacket], registered: Mapping[int, RegisteredMarker | None], rules: MergeRules
) -> list[_Candidate]:
    """Numbers with an authentic packet or, where the rules allow, packets in clear; each with its newest message."""
    accepted: dict[int, list[VerifiedPacket]] = defaultdict(list)
    clear: dict[int, list[VerifiedPacket]] = defaultdict(list)
    for packet in packets:
        if packet.accepted and packet.number is not None:
            accepted[packet.number].append(packet)
        elif rules.accept_clear and packet.verdict is Verdict.UNAUTHENTICATED and packet.number is not None:
            clear[packet.number].append(packet)
    found = []
    for number in sorted({*accepted, *clear}):
        if number in accepted:
            group = accepted[number]
            newest: CerpmMessage | PlainClaim | None = max(
                (p.message for p in group if p.message is not None), key=lambda m: m.sequence, default=None
            )
        else:
            group = clear[number]
            newest = max(group, key=lambda p: _time_key(p.packet.received_at_s)).packet.claim
        if newest is not None:
            found.append(_Candidate(number, newest, group, (newest.lon_deg, newest.lat_deg), registered.get(number)))
    return found


def _time_key(time_s: float) -> float:
    return time_s if math.isfinite(time_s) else -math.inf


def _sent_position(packet: VerifiedPacket) -> tuple[float, float]:
    """Longitude and latitude in a packet; NaN without. [deg]"""
    content = packet.message or packet.packet.claim
    return (content.lon_deg, content.lat_deg) if content is not None else (math.nan, math.nan)


# --- one number in two places -------------------------------------------------------------------------------------


def _two_places(
    packets: Sequence[VerifiedPacket], candidates: Sequence[_Candidate], rules: MergeRules
) -> list[Finding]:
    """Numbers whose packets have valid tags and different positions."""
    rejected: dict[int, list[VerifiedPacket]] = defaultdict(list)
    for packet in packets:
        # a packet that an earlier drive received is certainly a replay, so it does not show a second marker
        if packet.verdict is Verdict.OUT_OF_ORDER and packet.number is not None:
            rejected[packet.number].append(packet)
    findings = []
    for candidate in candidates:
        more = rejected.get(candidate.number, [])
        if all(_sent_position(packet) == candidate.place for packet in (*candidate.accepted, *more)):
            continue
        ordered = sorted(candidate.accepted, key=_order_key)
        away_m = _away_m(candidate.place, ordered)
        changes = int(np.count_nonzero(np.diff((away_m > rules.apart_m).astype(int))))
        also_m = _away_m(candidate.place, more)
        if changes > 1 or (candidate.known is None and (also_m > rules.apart_m).any()):
            far_m = max(float(away_m.max()), float(also_m.max(initial=0.0)))
            reason = (
                f"packets with valid tags have positions {far_m:.1f} m apart: two markers have this number, or an "
                "old message of a moved marker is being sent again"
            )
            findings.append(Finding(candidate.number, Disagreement.TWO_PLACES, reason, far_m))
        elif changes == 1:
            far_m = float(away_m.max())
            reason = f"its position changed by {far_m:.1f} m during the log: programmed again; the newest is used"
            findings.append(Finding(candidate.number, Disagreement.REPROGRAMMED, reason, far_m))
    return findings


def _away_m(place: tuple[float, float], packets: Sequence[VerifiedPacket]) -> Floats:
    """Distances of sent positions from a place. [m]"""
    sent = np.array([_sent_position(packet) for packet in packets], float).reshape(-1, 2)
    return distances_m(np.broadcast_to(place, sent.shape), sent)


def _order_key(packet: VerifiedPacket) -> tuple[float, float]:
    sequence = packet.message.sequence if packet.message else -1
    return (float(sequence), _time_key(packet.packet.received_at_s))


# --- impossible positions -----------------------------------------------------------------------------------------


def _swapped(candidates: Sequence[_Candidate], track: PoseTrack | None, rules: MergeRules) -> list[Finding]:
    """Positions that are possible only with longitude and latitude exchanged."""
    if not candidates:
        return []
    near = _expected_places(candidates, track)
    claims = np.array([c.place for c in candidates], float)
    fits = (np.abs(claims[:, 0]) <= 90) & (distances_m(near, claims) > _SWAPPED_REACHES * rules.reach_m)
    fits &= distances_m(near, claims[:, ::-1]) <= rules.reach_m
    findings = []
    for i in np.flatnonzero(fits).tolist():
        lon_deg, lat_deg = candidates[i].place
        reason = f"longitude {lon_deg:.5f} and latitude {lat_deg:.5f} fit if they are exchanged: programmed swapped"
        findings.append(Finding(candidates[i].number, Disagreement.SWAPPED, reason))
    return findings


def _expected_places(candidates: Sequence[_Candidate], track: PoseTrack | None) -> Floats:
    """A place near each marker: registered, or the vehicle's at its first packet, or the median of all markers."""
    near = np.array([(c.known.lon_deg, c.known.lat_deg) if c.known else (math.nan, math.nan) for c in candidates])
    unknown = np.isnan(near[:, 0])
    if track is not None:
        near[unknown] = vehicle_positions(track, [c.accepted[0].packet.received_at_s for c in candidates])[unknown]
        unknown = np.isnan(near[:, 0])
    if len(candidates) >= _MIN_SHIFTED:
        claims = np.array([c.place for c in candidates], float)
        near[unknown] = np.median(claims, axis=0)
    return near


def _out_of_reach(
    candidates: Sequence[_Candidate], track: PoseTrack | None, rules: MergeRules, warnings: list[str]
) -> list[Finding]:
    """Markers whose packets were all received from further away than radio reaches."""
    if track is None or not candidates:
        return []
    counts = [len(c.accepted) for c in candidates]
    vehicle = vehicle_positions(track, [p.packet.received_at_s for c in candidates for p in c.accepted])
    away_m = distances_m(vehicle, np.repeat(np.array([_used_place(c) for c in candidates], float), counts, axis=0))
    nearest_m = np.full(len(candidates), np.inf)
    np.fmin.at(nearest_m, np.repeat(np.arange(len(candidates)), counts), away_m)
    located = int(np.isfinite(nearest_m).sum())
    findings = []
    for i in np.flatnonzero(np.isfinite(nearest_m) & (nearest_m > rules.reach_m)).tolist():
        reason = (
            f"received {nearest_m[i] / 1000:.1f} km from its place, further than radio reaches: recorded there and "
            "sent again here, or carried away"
        )
        findings.append(Finding(candidates[i].number, Disagreement.OUT_OF_REACH, reason, float(nearest_m[i])))
    if 2 * len(findings) > max(located, 2):
        warnings.append(
            f"{len(findings)} of {located} markers were received from further away than radio reaches: the track is of "
            "another drive, or the clocks do not fit"
        )
    return findings


def _used_place(candidate: _Candidate) -> tuple[float, float]:
    known = candidate.known
    return candidate.place if known is None else (known.lon_deg, known.lat_deg)


# --- comparison with the registry ---------------------------------------------------------------------------------


def _common_shift(candidates: Sequence[_Candidate], rules: MergeRules) -> tuple[float, float] | None:
    """Common shift of sent against registered positions, if there is one that surveys do not explain."""
    pairs = [(_used_place(c), c.place) for c in candidates if c.known is not None]
    if len(pairs) < _MIN_SHIFTED:
        return None
    off_m = offsets_m([known for known, _sent in pairs], [sent for _known, sent in pairs])
    shift_m = np.median(off_m, axis=0)
    size_m = float(np.hypot(*shift_m))
    scatter_m = np.hypot(*(off_m - shift_m).T)
    if not rules.apart_m < size_m <= _MAX_SHIFT_M or np.mean(scatter_m <= _MAX_SHIFT_SCATTER_M) < _MIN_SHIFTED_SHARE:
        return None
    return float(shift_m[0]), float(shift_m[1])


def _shifted(candidates: Sequence[_Candidate], shift_m: tuple[float, float]) -> list[Finding]:
    reason = (
        f"the markers send positions {shift_m[0]:+.2f} m east and {shift_m[1]:+.2f} m north of their registered ones, "
        "all alike: their datum is another one"
    )
    return [Finding(c.number, Disagreement.DATUM_SHIFT, reason, math.hypot(*shift_m)) for c in candidates]


def _compare_with_registry(candidates: Sequence[_Candidate], rules: MergeRules) -> list[Finding]:
    known = [(c, c.known) for c in candidates if c.known is not None]
    if not known:
        return []
    places = np.array([(marker.lon_deg, marker.lat_deg) for _c, marker in known], float)
    away_m = distances_m(places, [c.place for c, _marker in known])
    findings = []
    for (candidate, marker), apart_m in zip(known, away_m, strict=True):
        limit_m = max(rules.apart_m, rules.sigmas * _sigma_m(marker))
        sent_side = candidate.newest.side
        if not apart_m <= limit_m:
            reason = (
                f"sends a position {apart_m:.2f} m from its registered one (limit {limit_m:.2f} m): moved, or "
                "programmed wrongly"
            )
            findings.append(Finding(candidate.number, Disagreement.MOVED, reason, float(apart_m)))
        elif LaneSide.UNKNOWN not in (marker.side, sent_side) and marker.side != sent_side:
            reason = (
                f"sends the side {sent_side.name.lower()}, registered {marker.side.name.lower()}; the registry is used"
            )
            findings.append(Finding(candidate.number, Disagreement.OTHER_SIDE, reason))
    return findings


def _sigma_m(known: RegisteredMarker | None) -> float:
    return known.sigma_m if known is not None and known.sigma_m > 0 else SURVEY_SIGMA_M


def _rows(
    used: Sequence[_Candidate],
    left_out: dict[int, str],
    findings: list[Finding],
    shift_m: tuple[float, float] | None,
    warnings: list[str],
) -> MergedMarkers:
    places = np.array([_used_place(c) for c in used], float).reshape(-1, 2)
    return MergedMarkers(
        number=np.array([c.number for c in used], np.int64),
        lon_deg=places[:, 0],
        lat_deg=places[:, 1],
        side=np.array([_side(c) for c in used], np.int64),
        sigma_m=np.array([_sigma_m(c.known) for c in used], float),
        speed_limit_kmh=np.array([_speed_limit_kmh(c) for c in used], float),
        packets=np.array([len(c.accepted) for c in used], np.int64),
        registered=np.array([c.known is not None for c in used], bool),
        left_out=left_out,
        findings=findings,
        shift_m=shift_m,
        warnings=warnings,
    )


def _side(candidate: _Candidate) -> int:
    known = candidate.known
    return int(candidate.newest.side if known is None or known.side is LaneSide.UNKNOWN else known.side)


def _speed_limit_kmh(candidate: _Candidate) -> float:
    if candidate.known is not None and math.isfinite(candidate.known.speed_limit_kmh):
        return candidate.known.speed_limit_kmh
    limit = candidate.newest.speed_limit
    return math.nan if limit is None else limit.km_h


# === Received packets matched with known markers: which packets are authentic, where the markers are, and how
# accurately.
#
# Used on the server with the registry, and on board with a snapshot.


RETIRED_REASON = "it is retired: its messages are not used any more"


@dataclass(frozen=True, slots=True)
class KnownCerpms:
    """What is known of markers, by their numbers."""

    registered: dict[int, RegisteredMarker] = field(default_factory=dict)
    earlier_spans: dict[int, list[SequenceSpan]] = field(default_factory=dict)  # of earlier drives
    # [s] shortest programmed time between two transmissions of a marker
    min_interval_s: dict[int, float] = field(default_factory=dict)
    # why a registered position is unfit for localization
    localization_warnings: dict[int, tuple[str, ...]] = field(default_factory=dict)
    retired: frozenset[int] = frozenset()  # their messages are not used


def list_numbers(packets: Iterable[ReceivedPacket]) -> list[int]:
    """Marker numbers in packets, each once, sorted."""
    received = list(packets)
    found = {packet.claim.number for packet in received if packet.claim is not None}
    for payload in {packet.payload for packet in received}:
        if payload is not None and len(payload) == MESSAGE_BYTES:
            try:
                found.add(decode_message(payload)[0].number)
            except WaymarkError:
                continue  # verification reports what is wrong with it
    return sorted(found)


def match_known_markers(
    packets: Sequence[ReceivedPacket],
    keys: Callable[[int], bytes | None] | Mapping[int, bytes],
    known: KnownCerpms,
    track: PoseTrack | None = None,
    freshness: FreshnessRules | None = None,
    rules: MergeRules | None = None,
    *,
    max_invalid_tags: int = MAX_INVALID_TAGS_PER_LOG,
) -> tuple[Verification, MergedMarkers]:
    """Verify packets, and merge them to one position a marker.

    Parameters
    ----------
    keys : callable or mapping
        As of `verify_packets`.
    freshness : FreshnessRules, optional
        Its `min_interval_s` is replaced by half of the shortest programmed interval of these markers, if known: their
        clocks may be inaccurate.
    max_invalid_tags : int
        As of `verify_packets`.
    """
    numbers = list_numbers(packets)
    intervals_s = [known.min_interval_s[n] / 2 for n in numbers if n in known.min_interval_s]
    freshness = (freshness or FreshnessRules()).model_copy(update={"min_interval_s": min(intervals_s, default=None)})
    verification = verify_packets(packets, keys, known.earlier_spans, freshness, max_invalid_tags=max_invalid_tags)
    merged = merge_markers(verification.packets, known.registered, track, rules)
    return verification, _without_retired(merged, known.retired)


def grade_markers(
    merged: MergedMarkers, verification: Verification, known: KnownCerpms
) -> tuple[LocalizationGrade, tuple[str, ...]]:
    """Grade of the least accurate of these markers, and the reasons why their path may not localize a vehicle."""
    localization_warnings: dict[str, int] = {}
    authentic = {packet.number for packet in verification.packets if packet.accepted}
    for number in merged.number.tolist():
        warnings = list(known.localization_warnings.get(number, ()))
        if number not in known.registered:
            warnings.append("the marker is not registered")
        if number not in authentic:
            warnings.append("the marker was only received in clear: anyone can have sent it")
        for warning in warnings:
            localization_warnings[warning] = localization_warnings.get(warning, 0) + 1
    if merged.shift_m is not None:
        localization_warnings["the markers send positions in another datum"] = len(merged.left_out)
    texts = tuple(f"{warning} ({count} of {len(merged.number)})" for warning, count in localization_warnings.items())
    if texts or not len(merged.number):
        return LocalizationGrade.UNFIT, texts
    return grade_accuracy(float(merged.sigma_m.max()) * math.sqrt(2)), texts  # horizontal RMSE is of both axes


def _without_retired(merged: MergedMarkers, retired: frozenset[int]) -> MergedMarkers:
    named = [number for number in merged.number.tolist() if number in retired]
    if not named:
        return merged
    kept = ~np.isin(merged.number, named)
    arrays = ("number", "lon_deg", "lat_deg", "side", "sigma_m", "speed_limit_kmh", "packets", "registered")
    return replace(
        merged,
        **{name: getattr(merged, name)[kept] for name in arrays},
        left_out={**merged.left_out, **dict.fromkeys(named, RETIRED_REASON)},
    )
