"""The test of a stretch of road whose markers may all be displaced alike, by several drives.

One drive with an ordinary receiver cannot show that all markers of a stretch are a metre beside the lane, as by a
survey in another datum: its own position is no better. The errors of receivers are independent from drive to drive,
and a driver's habit is to one side of the direction of travel, which is the other side of the road in the other
direction. Only the distance across the path is compared: along a straight road nothing can be seen. So four unknowns,
all in metres, are common to all drives: the shift of the markers' path to the east and to the north, its turn
anticlockwise about the middle of the stretch (as the displacement 250 m from there), and the offset to the left that
drivers have in common. A drive is evidence in information form: what it weighs, and its weighted sum.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field

import numpy as np

from app.geodesy.frames import metres_per_radian
from app.health.states import MONTH_S, Displacement, Fault, Verdict
from app.sensors.pose_track import DRIVER_OFFSET_SD_M, RECEIVER_OPTIMISM, SLOW_SHARE, WANDER_LENGTH_M, WANDER_SD_M
from app.values import Floats, JsonObject

TURN_REACH_M = 250.0  # [m] from the middle of a stretch, where a turn is stated; half of a stretch
SHIFT_SD_M, SHIFT_SHARE = (1.0, 10.0), (0.9, 0.1)
"""Standard deviations of a shift or a turn before it is seen, each axis [m], and how common they are: realizations of
a datum that were mistaken for each other (0.2 to 2 m), and larger mistakes."""
TOLERANCE_SD_M = 0.1
"""[m] of the shift of a correct survey, each axis, at least. Source: `HealthRules.disc_m` is 2.5 of it."""
COMMON_OFFSET_SD_M = 0.1  # [m] to one side that drivers have in common; where one direction is driven, it remains
RECEIVER_FLOOR_M = 0.1  # [m] each axis, of what no receiver states: the mounting of its antenna, its own datum
OUTLIER_SHARE, OUTLIER_SD_M = 0.05, 3.0
"""Share of drives that are displaced by their own fault, and by how much [m]: wrong datum, wrong lane."""
MEMORY_SD_M = 0.05
"""[m] standard deviation at which older drives begin to be forgotten: a survey may change, and markers with it."""
MAX_STRETCH_VEHICLES = 10
"""Vehicles whose drives are kept one by one; older ones are kept as sums. So one vehicle is a tenth at most."""
_MAX_SHARED_PASSES = 5  # of a vehicle that its mean rests on, so that it follows a change
_SCALE_DRIVES = 10.0  # drives that `RECEIVER_OPTIMISM` weighs as much as
_MIN_SCALE, _MAX_SQUARE = 0.4, 9.0  # limits of variance ratios


@dataclass(frozen=True, slots=True)
class StretchRules:
    """Error rates and bounds of the test of a stretch."""

    false_alarm_share: float = 1e-3  # share of correct stretches that are reported in a month, at most
    lower: float = -2.0  # [nat] at which a stretch is accepted as correct, and the test starts again
    vehicles: int = 3  # distinct vehicles without which nothing is reported
    vehicle_bound: float = 5.0  # [nat] as of `HealthRules`
    month_passes: float = 100.0  # passes in a month that are assumed at least
    # tests that start in a pass. Source: `python -m benchmarks.health --only stretches`: 0.02 to 0.1 with RTK
    test_starts: float = 0.05
    min_m: float = 0.3  # [m] smallest displacement that is reported; a lane leaves more room

    def upper(self, month_passes: float) -> float:
        """Logarithm of the ratio from which a displacement is reported, as `HealthRules.upper`. [nat]"""
        return math.log(2.0 * max(month_passes, self.month_passes) * self.test_starts / self.false_alarm_share)


STRETCH_RULES = StretchRules()


@dataclass(slots=True)
class StretchDrive:
    """What one drive shows of a stretch."""

    # `lon_deg`, `lat_deg`: [deg] point about which the turn is stated
    lon_deg: float
    lat_deg: float
    heading_deg: float  # [deg] mean direction of travel
    # shape (4, 4), (4,): information on shift east and north, turn, and common offset [1/m2], and times values [1/m]
    information: Floats
    weighted: Floats
    survey_m: float = 0.0  # [m] standard deviation of the registered positions, each axis, where it is stated

    @classmethod
    def from_document(cls, document: JsonObject) -> StretchDrive:
        """The evidence that `document` stored."""
        arrays = {name: np.array(document[name], dtype=np.float64) for name in ("information", "weighted")}
        return cls(**{**document, **arrays})

    def document(self) -> JsonObject:
        """The evidence as JSON values."""
        place = {"lon_deg": round(self.lon_deg, 7), "lat_deg": round(self.lat_deg, 7)}
        rest = {"heading_deg": round(self.heading_deg, 1), "survey_m": round(self.survey_m, 3)}
        return {**place, **rest, "information": _short(self.information), "weighted": _short(self.weighted)}

    def about(self, lon_deg: float, lat_deg: float) -> tuple[Floats, Floats]:
        """Information and weighted values about another point: where it is the middle, a turn is another shift."""
        east_per_rad, north_per_rad = (float(value) for value in metres_per_radian(np.radians(lat_deg)))
        east_m = math.radians((self.lon_deg - lon_deg + 180.0) % 360.0 - 180.0) * east_per_rad
        north_m = math.radians(self.lat_deg - lat_deg) * north_per_rad
        own = np.eye(4)
        own[:2, 2] = -north_m / TURN_REACH_M, east_m / TURN_REACH_M
        return own.T @ self.information @ own, own.T @ self.weighted


def _short(values: Floats) -> list[object]:
    """Values for storage, to six significant digits."""
    flat = [float(f"{value:.6g}") for value in values.ravel().tolist()]
    shortened: list[object] = np.array(flat).reshape(values.shape).tolist()
    return shortened


def stretch_drive(
    vehicle_m: Floats, path_m: Floats, normal: Floats, along_m: Floats, accuracy_m: float
) -> tuple[Floats, Floats]:
    """Information of one drive about the middle of its places, which are in a plane with axes east and north.

    Parameters
    ----------
    vehicle_m : ndarray, shape (N, 2)
        Places of the vehicle, evenly along the path. [m]
    path_m, normal : ndarray, shape (N, 2)
        Places of the markers' path beside them [m], and unit vectors to its left in the direction of travel.
    along_m : ndarray, shape (N,)
        Of the places along the path. [m]
    accuracy_m : float
        That the receiver states, each axis. [m]

    Returns
    -------
    information : ndarray, shape (4, 4)
        [1/m2]
    weighted : ndarray, shape (4,)
        [1/m]

    Notes
    -----
    A place q of the vehicle and p of the path, with the normal n and c as the middle, have
    n . (q - p) = habit - n . (shift + turn x (p - c)) + error. The errors of a drive are its driver's own habit, an
    error of the receiver that is constant, one that changes evenly along the stretch, and wander, correlated over 30 m.
    """
    count = len(along_m)
    from_middle = path_m - path_m.mean(axis=0)
    turned = np.stack([-from_middle[:, 1], from_middle[:, 0]], axis=1) / TURN_REACH_M
    design = np.column_stack([-normal, -np.sum(normal * turned, axis=1), np.ones(count)])
    beside_m = np.sum(normal * (vehicle_m - path_m), axis=1)
    error_m = RECEIVER_OPTIMISM * accuracy_m
    spacing_m = max(float(np.ptp(along_m)) / max(count - 1, 1), 0.1)
    wander_m = math.hypot(WANDER_SD_M, SLOW_SHARE * error_m) * math.sqrt(max(2 * WANDER_LENGTH_M / spacing_m, 1.0))
    drift = (along_m - along_m.mean()) / max(float(along_m.std()), 1.0)
    constant = math.hypot(error_m, RECEIVER_FLOOR_M)
    effects = np.column_stack([DRIVER_OFFSET_SD_M * np.ones(count), constant * normal, error_m * drift])
    covariance = wander_m**2 * np.eye(count) + effects @ effects.T
    solved = np.linalg.solve(covariance, np.column_stack([design, beside_m]))
    return design.T @ solved[:, :4], design.T @ solved[:, 4]


@dataclass(slots=True)
class StretchEntry:
    """Mean evidence of one vehicle in the current test, about the middle of the stretch."""

    vehicle: str
    information: Floats
    weighted: Floats
    passes: int = 1


@dataclass(slots=True)
class _Running:
    """Hypotheses after some vehicles: of H first the correct survey, then shifts, then turns."""

    totals: Floats  # shape (H,): [nat] logarithms of likelihood ratios against the first
    # `information`, `weighted`: shape (H, 4, 4), (H, 4): sums over vehicles
    information: Floats
    weighted: Floats
    # `squares`, `drives`: sum of the squared deviations of drives from their prediction, in variances; their number
    squares: float = 0.0
    drives: float = 0.0
    supporters: int = 0  # vehicles that speak against a correct survey

    @classmethod
    def new(cls) -> _Running:
        count = 1 + 2 * len(SHIFT_SD_M)
        return cls(np.zeros(count), np.zeros((count, 4, 4)), np.zeros((count, 4)))

    def copy(self) -> _Running:
        arrays = (self.totals.copy(), self.information.copy(), self.weighted.copy())
        return _Running(*arrays, self.squares, self.drives, self.supporters)

    def posterior(self, prior_precision: Floats) -> tuple[Floats, Floats]:
        """Means and covariances, shape (H, 4) and (H, 4, 4)."""
        covariance = np.linalg.inv(prior_precision + self.information)
        return np.einsum("hij,hj->hi", covariance, self.weighted), np.asarray(covariance, np.float64)

    def add(self, entry: StretchEntry, prior_precision: Floats, bound: float) -> None:
        """Predict a vehicle by each hypothesis, compare the predictions, and learn from it.

        A vehicle whose receiver has a fault of its own is as likely under all hypotheses; each learns from it by the
        probability that it has none. The variances of drives are scaled by how earlier ones scattered.
        """
        scale = max((_SCALE_DRIVES + self.squares) / (_SCALE_DRIVES + self.drives), _MIN_SCALE)
        information, weighted = entry.information / scale, entry.weighted / scale
        mean, covariance = self.posterior(prior_precision)
        outlier = np.diag([OUTLIER_SD_M, OUTLIER_SD_M, OUTLIER_SD_M, 0.0]) ** 2
        as_usual = math.log(1.0 - OUTLIER_SHARE) + _predicted(mean, covariance, information, weighted)
        as_outlier = math.log(OUTLIER_SHARE) + _predicted(mean, covariance + outlier, information, weighted)
        likelihood = np.logaddexp(as_usual, as_outlier)
        trust = np.exp(as_usual - likelihood)
        gain = np.clip(likelihood - likelihood[0], -bound - 2.0, bound)
        self._learn_scatter(entry, mean, covariance)
        self.totals += gain
        self.supporters += bool(gain.max() > 0.0)
        self.information += trust[:, None, None] * information
        self.weighted += trust[:, None] * weighted
        most = self.information[:, 0, 0] + self.information[:, 1, 1]
        kept = np.minimum(1.0, MEMORY_SD_M**-2 / np.maximum(most, 1e-9))
        self.information *= kept[:, None, None]
        self.weighted *= kept[:, None]

    def _learn_scatter(self, entry: StretchEntry, mean: Floats, covariance: Floats) -> None:
        """Squared deviation of a vehicle from the likeliest hypothesis, in the direction that it shows best."""
        likeliest = int(np.argmax(self.totals))
        values, vectors = np.linalg.eigh(entry.information)
        value, vector = float(values[-1]), vectors[:, -1]
        deviation = float(vector @ (entry.weighted - entry.information @ mean[likeliest]))
        variance = value + value**2 * float(vector @ covariance[likeliest] @ vector)
        self.squares += min(deviation**2 / variance, _MAX_SQUARE)
        self.drives += 1.0


def _predicted(mean: Floats, covariance: Floats, information: Floats, weighted: Floats) -> Floats:
    """Logarithm of a drive's likelihood by predictions, but for a term that all have in common, shape (H,). [nat]"""
    ahead = np.eye(4) + covariance @ information
    rest = weighted - mean @ information
    spread = np.linalg.solve(ahead, np.einsum("hij,hj->hi", covariance, rest)[:, :, None])[:, :, 0]
    explained = np.einsum("hi,hi->h", rest, spread)
    own = mean @ weighted - 0.5 * np.einsum("hi,ij,hj->h", mean, information, mean)
    return np.asarray(own + 0.5 * explained - 0.5 * np.linalg.slogdet(ahead)[1])


@dataclass(slots=True)
class StretchState:
    """Evidence on one stretch."""

    # `lon_deg`, `lat_deg`: [deg] its middle, about which a turn is stated
    lon_deg: float
    lat_deg: float
    heading_deg: float  # [deg] of the first drive
    earlier: _Running = field(default_factory=_Running.new)  # vehicles that are no longer kept one by one
    entries: list[StretchEntry] = field(default_factory=list)
    # `forward`, `backward`: drives in the direction of the first one, and against it
    forward: int = 0
    backward: int = 0
    survey_m: float = 0.0  # [m] of the last drive
    ratios: dict[str, float] = field(default_factory=dict)  # [nat] of each fault
    passes: int = 0
    month_passes: float = 0.0  # as of `MarkerState`
    since_s: float = 0.0  # when the current test began. [s since 1970]
    last_s: float = 0.0

    @classmethod
    def from_document(cls, document: JsonObject) -> StretchState:
        """The state that `document` stored."""
        earlier: JsonObject = {
            name: np.array(value, dtype=np.float64) if isinstance(value, list) else value
            for name, value in document["earlier"].items()
        }
        entries = [
            StretchEntry(
                one["vehicle"], np.array(one["information"], np.float64), np.array(one["weighted"], np.float64),
                one["passes"],
            )
            for one in document["entries"]
        ]  # fmt: skip
        return cls(**{**document, "earlier": _Running(**earlier), "entries": entries})

    def document(self) -> JsonObject:
        """The state as JSON values."""

        def short(value: object) -> object:
            return _short(value) if isinstance(value, np.ndarray) else value

        found = asdict(self)
        found["earlier"] = {name: short(value) for name, value in found["earlier"].items()}
        found["entries"] = [{name: short(value) for name, value in one.items()} for one in found["entries"]]
        return found

    def reset(self) -> None:
        """Start the test again: a person has decided, or the stretch was accepted as correct. Its scatter is kept."""
        running, self.entries = self.earlier, []
        self.earlier = _Running.new()
        self.earlier.squares, self.earlier.drives = running.squares, running.drives
        self.ratios, self.forward, self.backward = {}, 0, 0
        self.since_s = self.last_s


def update_stretch(
    state: StretchState, drive: StretchDrive, vehicle: str, at_s: float, rules: StretchRules = STRETCH_RULES
) -> Verdict | None:
    """Add a drive to the test of its stretch.

    Parameters
    ----------
    state : StretchState
        Changed in place.
    drive : StretchDrive
        Of `stretch_drive`.
    vehicle : str
        Who drove: its drives count as one, because they share the errors of its receiver and its driver.
    at_s : float
        When it was driven. [s since 1970]

    Returns
    -------
    Verdict or None
        A shift or a turn that is suspected now.
    """
    aged = math.exp(-max(at_s - state.last_s, 0.0) / MONTH_S) if state.passes else 0.0
    state.month_passes, state.passes = state.month_passes * aged + 1.0, state.passes + 1
    state.last_s, state.survey_m = max(state.last_s, at_s), drive.survey_m
    state.since_s = state.since_s or at_s
    is_forward = math.cos(math.radians(drive.heading_deg - state.heading_deg)) >= 0.0
    state.forward, state.backward = state.forward + is_forward, state.backward + (not is_forward)
    _add_entry(state, drive, vehicle)
    prior = _prior_precision(max(TOLERANCE_SD_M, state.survey_m))
    if len(state.entries) > MAX_STRETCH_VEHICLES:
        state.earlier.add(state.entries.pop(0), prior, rules.vehicle_bound)
    running = state.earlier.copy()
    for entry in state.entries:
        running.add(entry, prior, rules.vehicle_bound)
    share, count = np.log(SHIFT_SHARE), len(SHIFT_SD_M)
    shift = float(np.logaddexp.reduce(running.totals[1 : 1 + count] + share))
    turn = float(np.logaddexp.reduce(running.totals[1 + count :] + share))
    if max(shift, turn) <= rules.lower:
        state.earlier.squares, state.earlier.drives = running.squares, running.drives
        state.reset()
        return None
    state.ratios = {str(Fault.SHIFTED): shift, str(Fault.TURNED): turn - max(shift, 0.0)}
    limit = rules.upper(state.month_passes)
    if running.supporters < rules.vehicles or max(shift, turn) < limit:
        return None
    return _displaced(state, running, prior, limit, rules)


def _add_entry(state: StretchState, drive: StretchDrive, vehicle: str) -> None:
    information, weighted = drive.about(state.lon_deg, state.lat_deg)
    for entry in state.entries:
        if entry.vehicle == vehicle:
            entry.passes += 1
            share = 1.0 / min(entry.passes, _MAX_SHARED_PASSES)
            entry.information = entry.information + share * (information - entry.information)
            entry.weighted = entry.weighted + share * (weighted - entry.weighted)
            return
    state.entries.append(StretchEntry(vehicle, information, weighted))


def _prior_precision(tolerance_m: float) -> Floats:
    """Precisions of the four unknowns by each hypothesis, shape (H, 4, 4). [1/m2]"""
    sizes = [(tolerance_m, tolerance_m)]
    sizes += [(size, tolerance_m) for size in SHIFT_SD_M]
    sizes += [(size, size) for size in SHIFT_SD_M]
    deviations = np.array([(shift, shift, turn, COMMON_OFFSET_SD_M) for shift, turn in sizes])
    return deviations[:, :, None] ** -2.0 * np.eye(4)


def _displaced(
    state: StretchState, running: _Running, prior: Floats, limit: float, rules: StretchRules
) -> Verdict | None:
    """The displacement by the widest hypothesis of what is suspected; None where it is too small to matter."""
    fault = Fault.TURNED if state.ratios[Fault.TURNED] >= limit else Fault.SHIFTED
    if state.ratios[fault] < limit:
        return None
    mean, covariance = running.posterior(prior)
    which = -1 if fault is Fault.TURNED else len(SHIFT_SD_M)
    east_m, north_m, turn_m, _habit = (float(value) for value in mean[which])
    own = covariance[which]
    size_m = math.hypot(east_m, north_m)
    if max(size_m, abs(turn_m) if fault is Fault.TURNED else 0.0) < rules.min_m:
        return None
    shift = np.array([east_m, north_m])
    sigma = np.sqrt(np.diag(own))
    in_sigmas = math.sqrt(float(shift @ np.linalg.solve(own[:2, :2], shift)))
    found = Displacement(
        east_m, north_m, float(sigma[0]), float(sigma[1]), size_m / max(in_sigmas, 1e-9),
        math.degrees(turn_m / TURN_REACH_M), math.degrees(float(sigma[2]) / TURN_REACH_M),
        1 + (state.forward > 0 and state.backward > 0),
    )  # fmt: skip
    return Verdict(
        fault, state.ratios[fault], limit, running.supporters, state.forward + state.backward, state.since_s,
        (east_m, north_m), displacement=found,
    )  # fmt: skip
