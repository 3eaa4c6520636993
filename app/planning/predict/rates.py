"""Read rates and path errors that are predicted for the markers of a plan."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache
from importlib import resources
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from app.errors import InvalidParameter
from app.markers.magnet import Orientation
from app.markers.plate import PlateGeometry
from app.planning.alignment import Lane
from app.planning.magnet_checks import magnet_recall
from app.planning.placement.place import one_of_each_pair, path_error_m
from app.planning.rules import CameraRules, PredictionRules
from app.sensors.camera import Camera
from app.values import Floats

# === Models of read rates and path errors, and their fitted parameters of app/planning/data/predictions.json.


DAY = "day"
"""The condition that the others are added to."""
PLACING_SD_M = 0.01
"""[m] of placing a marker, each axis. Source: `PLACING_SD_M` of app/planning/proof/drives.py."""
_NODES, _WEIGHTS = (np.asarray(part) for part in np.polynomial.hermite_e.hermegauss(15))
_SPACING_UNIT_M, _SPEED_UNIT_M_S = 15.0, 15.0  # units of the powers; source: near the middle of the fitted drives


def normal_quadrature() -> tuple[Floats, Floats]:
    """Nodes and weights of a standard normal variable, each of shape (15,)."""
    return _NODES, _WEIGHTS / _WEIGHTS.sum()


@dataclass(frozen=True, slots=True)
class PlateModel:
    """Read rate of plates in frames of one pass."""

    # `slope`, `unit_px`: Log-odds of reading a frame rise by the slope with the logarithm of a unit's height; they are
    # 0 at this height without blur. [1, px]
    slope: float
    unit_px: float
    blur_slope: float  # by how much the logarithm of that height rises with each unit of motion blur
    spread: float  # standard deviation of the log-odds between passes: light, sensor, state of the plate
    # `sharp`, `blur_limit`: Log-odds that a pass can be read at all, without blur, and by how much a unit of blur
    # lowers them
    sharp: float
    blur_limit: float
    fix_rms_m: float  # [m] error of a vehicle's position from the nearest frame, horizontal, with an exact survey
    # [s] the camera exposes at least for one of these, all equally likely; empty: as its rules state
    exposures_s: tuple[float, ...] = ()

    def pass_log_odds(self, unit_px: Floats, blur_units: npt.ArrayLike) -> Floats:
        """Mean log-odds of reading frames, of the shape of the unit heights."""
        shifted = math.log(self.unit_px) + self.blur_slope * np.asarray(blur_units)
        return np.asarray(self.slope * (np.log(np.maximum(unit_px, 1e-6)) - shifted))

    def readable_share(self, blur_units: npt.ArrayLike) -> Floats:
        """Share of passes that can be read at all."""
        return np.asarray(scipy.special.expit(self.sharp - self.blur_limit * np.asarray(blur_units)))


@dataclass(frozen=True, slots=True)
class MagnetModel:
    """Read rate of a tag or of a line's magnet: what bends and neighbours leave, times that of magnets by distance."""

    # `straight`, `per_metre`, `per_curvature`: log-odds on a straight road 0.16 m above the magnets, and by how much
    # they change with the distance, as neighbours merge, and with curvature. [1, 1/m, m]
    straight: float
    per_metre: float
    per_curvature: float
    # `fix_share`, `fix_rms_m`: share of read tags that fix the position, and its error with an exact survey,
    # horizontal. [1, m]
    fix_share: float = 0.0
    fix_rms_m: float = 0.0

    def read_rate(
        self, distance_m: float, curvature_per_m: npt.ArrayLike, orientation: Orientation, magnets: int = 1
    ) -> Floats:
        """Of the shape of the curvatures.

        Parameters
        ----------
        distance_m : float
            From the sensors down to the magnets: clearance and depth. [m]
        magnets : int
            Of the tag, each of which must be read.
        """
        bend = np.abs(np.asarray(curvature_per_m, dtype=np.float64))
        near = np.asarray(
            scipy.special.expit(self.straight + self.per_metre * (distance_m - 0.16) + self.per_curvature * bend)
        )
        return near * magnet_recall(orientation).share_at(distance_m) ** magnets


@dataclass(frozen=True, slots=True)
class PathModel:
    """Root mean square distance of the path from the lane's centre line, of drives with an RTK receiver."""

    exact_markers_m: float  # [m] with markers that are exactly surveyed, 15 m apart, at 15 m/s
    # what markers that are off by a distance on each axis add in square, as a share of that distance, there
    marker_gain: float
    # `spacing_power`, `speed_power`: Exponents of these two
    spacing_power: float
    speed_power: float
    exact_share: float  # share of the squared error of the spline through exact markers that remains
    end_gain_m: float  # [m] length of lane at each of its ends that would double the squared error there
    worst_share: float  # mean greatest distance along 500 m, over the root mean square

    def rms_of(
        self, survey_rmse_m: float, spacing_m: Floats, speed_m_s: Floats, exact_rms_m: Floats, ends_per_m: Floats
    ) -> Floats:
        """Of stretches, shape (K,); see `app.planning.predict.rates.Stretches`. [m]"""
        sigma = math.hypot(survey_rmse_m / math.sqrt(2), PLACING_SD_M)
        own = (
            math.hypot(self.exact_markers_m, self.marker_gain * sigma)
            * (spacing_m / _SPACING_UNIT_M) ** self.spacing_power
            * (np.maximum(speed_m_s, 1.0) / _SPEED_UNIT_M_S) ** self.speed_power
        )
        return np.asarray(np.sqrt(own**2 * (1.0 + self.end_gain_m * ends_per_m) + self.exact_share * exact_rms_m**2))


@dataclass(frozen=True, slots=True)
class Models:
    """All models; plates by condition."""

    plates: Mapping[str, PlateModel]
    tags: MagnetModel
    lines: MagnetModel
    path: PathModel
    source: str

    def plate_model(self, condition: str) -> PlateModel:
        """Of a condition, also of several joined with ``+``.

        Notes
        -----
        Of joined conditions each adds its difference from the day: to the logarithm of the height, to the variance
        between passes, and to the odds against reading. The proof of ``night+rain`` and others may differ more.
        """
        day = self.plates[DAY]
        parts = [self.plates[part] for part in sorted({part.strip() for part in condition.split("+")} - {DAY})]
        if len(parts) < 2:
            return parts[0] if parts else day
        variance = day.spread**2 + sum(part.spread**2 - day.spread**2 for part in parts)
        return PlateModel(
            slope=min(part.slope for part in parts),
            unit_px=day.unit_px * math.prod(max(part.unit_px / day.unit_px, 1.0) for part in parts),
            blur_slope=max(part.blur_slope for part in parts),
            spread=math.sqrt(max(variance, day.spread**2)),
            sharp=day.sharp + sum(min(part.sharp - day.sharp, 0.0) for part in parts),
            blur_limit=max(part.blur_limit for part in parts),
            fix_rms_m=math.sqrt(sum(part.fix_rms_m**2 for part in parts)),
            exposures_s=next((part.exposures_s for part in parts if part.exposures_s), ()),
        )


@lru_cache(maxsize=1)
def fitted_models() -> Models:
    """The models with the parameters of app/planning/data/predictions.json."""
    text = (resources.files("app.planning") / "data" / "predictions.json").read_text("utf-8")
    found = json.loads(text)
    plates = {
        name: PlateModel(**{**values, "exposures_s": tuple(values["exposures_s"])})
        for name, values in found["plates"].items()
    }
    return Models(
        plates, MagnetModel(**found["tags"]), MagnetModel(**found["lines"]), PathModel(**found["path"]), found["source"]
    )


# === Read rates and path errors that are predicted for the markers of a plan.


FAR_M = 18.0
"""[m] ahead, from where frames count. Source: `FAR_M` of app/planning/proof/plates.py."""
MIN_UNIT_PX = 1.0
"""[px] height of a unit from which frames count. Source: `MIN_UNIT_PX` of app/planning/proof/plates.py."""
STRETCH_M = 500.0
"""[m] of lane that path errors are predicted for. Source: `LANE_STRETCH_M` of app/planning/proof/prove.py."""
_GRID_M = 0.02  # [m] between distances at which the view is computed
_PHASES = 8  # of the first frame
_SPEED_STEP_M_S = 0.5  # [m/s] speeds are rounded up to it; at most 4 % of 13 m/s
_OFFSET_STEP_M = 0.1  # [m] less than a vehicle's own 0.15 m


def plate_rates(
    offsets_m: Floats,
    speeds_m_s: Floats,
    geometry: PlateGeometry,
    camera: CameraRules,
    condition: str,
    rules: PredictionRules,
) -> Floats:
    """Probability that a pass reads each plate that is there, shape (K,), by its offset from the centre line [m]."""
    speed = np.ceil(np.maximum(speeds_m_s * rules.speed_share, 0.1) / _SPEED_STEP_M_S) * _SPEED_STEP_M_S
    offset = np.round(offsets_m / _OFFSET_STEP_M) * _OFFSET_STEP_M
    kinds, which = np.unique(np.column_stack([speed, offset]), axis=0, return_inverse=True)
    found = [plate_read_rate(geometry, camera, condition, v, left) for v, left in kinds.tolist()]
    return np.asarray(np.array(found)[which.reshape(-1)])


@lru_cache(maxsize=4096)
def plate_read_rate(
    geometry: PlateGeometry, camera: CameraRules, condition: str, speed_m_s: float, left_m: float
) -> float:
    """Probability that a pass at a speed reads a plate beside the camera's path, on a flat and straight road.

    Notes
    -----
    Frames follow each other at the speed's distance from a first one of any phase. Each is read with the log-odds of
    its unit's height; the pass's own circumstances shift all of them alike (`PlateModel`).
    """
    return read_rate_of_model(fitted_models().plate_model(condition), geometry, camera, speed_m_s, left_m)


def read_rate_of_model(
    model: PlateModel, geometry: PlateGeometry, camera: CameraRules, speed_m_s: float, left_m: float = 0.0
) -> float:
    """As `plate_read_rate`, for another model than the fitted ones."""
    ahead = np.arange(_GRID_M, FAR_M, _GRID_M)
    height = unit_heights_px(camera_of(camera), geometry, ahead, left_m)
    exposures = [max(camera.exposure_s, least) for least in model.exposures_s] or [camera.exposure_s]
    rates = [_rate(model, ahead, height, speed_m_s, speed_m_s * exposure, camera, geometry) for exposure in exposures]
    return float(np.mean(rates))


def readable_frames(geometry: PlateGeometry, camera: CameraRules, speed_m_s: float) -> float:
    """Mean number of frames of a pass in which a unit is `MIN_UNIT_PX` high or more, on a flat and straight road."""
    ahead = np.arange(_GRID_M, FAR_M, _GRID_M)
    in_reach = unit_heights_px(camera_of(camera), geometry, ahead) >= MIN_UNIT_PX
    return float(in_reach.sum() * _GRID_M / (speed_m_s / camera.frames_per_s))


def _rate(
    model: PlateModel,
    ahead: Floats,
    height: Floats,
    speed_m_s: float,
    blur_m: float,
    camera: CameraRules,
    geometry: PlateGeometry,
) -> float:
    blur = blur_m / (geometry.pitch_mm / 1000)
    nodes, weights = normal_quadrature()
    step = speed_m_s / camera.frames_per_s
    missed = 0.0
    for phase in (np.arange(_PHASES) + 0.5) / _PHASES:
        at = np.arange(phase * step, FAR_M, step)
        units = np.where(at >= _GRID_M, np.interp(at, ahead, height), 0.0)
        odds = model.pass_log_odds(units[units >= MIN_UNIT_PX], blur)[:, None] + model.spread * nodes
        missed += float((weights * np.exp(-np.logaddexp(0, odds).sum(axis=0))).sum()) / _PHASES
    return float(model.readable_share(blur)) * (1.0 - missed)


def plate_fix_error_m(condition: str, survey_rmse_m: float) -> float:
    """Standard error of a position from a plate, horizontal. [m]"""
    return float(np.hypot(fitted_models().plate_model(condition).fix_rms_m, survey_rmse_m))


def tag_fix_error_m(survey_rmse_m: float) -> float:
    """Standard error of a position from a tag, horizontal. [m]"""
    return float(np.hypot(fitted_models().tags.fix_rms_m, survey_rmse_m))


def tag_fix_share() -> float:
    """Share of the tags that are read that also fix the position."""
    return fitted_models().tags.fix_share


def tag_rates(lane: Lane, chainages_m: npt.ArrayLike, distance_m: float, magnets: int) -> Floats:
    """Probability that a pass reads each tag that is there, shape (K,), of so many magnets at a distance below."""
    at = np.asarray(chainages_m, dtype=np.float64)
    bend = lane.value_at(lane.curvature_per_m, at)
    return fitted_models().tags.read_rate(distance_m, bend, Orientation.FORWARD, magnets)


def tag_rate(distance_m: float, magnets: int) -> float:
    """Probability that a bar on a straight road reads a tag of so many magnets at a distance below."""
    return float(fitted_models().tags.read_rate(distance_m, 0.0, Orientation.FORWARD, magnets))


def line_rates(lane: Lane, chainages_m: npt.ArrayLike, distance_m: float) -> Floats:
    """Probability that a vehicle with its bar over a line reads each of its magnets, shape (K,), that far below."""
    at = np.asarray(chainages_m, dtype=np.float64)
    return fitted_models().lines.read_rate(distance_m, lane.value_at(lane.curvature_per_m, at), Orientation.UP)


class Stretches(NamedTuple):
    """Equal stretches of a lane with CERPMs, each of shape (S,)."""

    spacing_m: Floats  # [m] mean distance between pairs
    speed_m_s: Floats  # [m/s] mean design speed
    # `exact_rms_m`, `exact_worst_m`: [m] distances of a cubic spline through the exact pairs of the lane from its
    # centre line
    exact_rms_m: Floats
    exact_worst_m: Floats
    ends_per_m: Floats  # [1/m] ends of the lane in the stretch over its length


def lane_stretches(lane: Lane, chainages_m: Floats) -> Stretches:
    """A lane with CERPMs at chainages as equal stretches of at most 500 m."""
    count = max(int(np.ceil(lane.length_m / STRETCH_M - 1e-9)), 1)
    borders = np.linspace(0.0, lane.length_m, count + 1)
    stretch = np.minimum((lane.chainage_m / lane.length_m * count).astype(np.intp), count - 1)
    samples = np.bincount(stretch, minlength=count)
    error = path_error_m(lane, chainages_m)
    worst = np.zeros(count)
    np.maximum.at(worst, stretch, error)
    pairs = np.histogram(one_of_each_pair(chainages_m, None)[0], borders)[0]
    ends = np.zeros(count)
    ends[0] += 1.0
    ends[-1] += 1.0
    return Stretches(
        np.diff(borders) / np.maximum(pairs, 1),
        np.bincount(stretch, lane.design_speed_m_s, count) / samples,
        np.sqrt(np.bincount(stretch, error**2, count) / samples),
        worst,
        ends / np.diff(borders),
    )


def path_errors_m(lane: Lane, chainages_m: Floats, rules: PredictionRules) -> tuple[Floats, Floats]:
    """Root mean square and greatest path error of each stretch of a lane with CERPMs at chainages, shape (S,). [m]"""
    found, model = lane_stretches(lane, chainages_m), fitted_models().path
    spacing = found.spacing_m / (1.0 - rules.lost_share)
    speed = found.speed_m_s * rules.speed_share
    rms = model.rms_of(rules.survey_rmse_m, spacing, speed, found.exact_rms_m, found.ends_per_m)
    return rms, np.maximum(rms * model.worst_share, np.sqrt(model.exact_share) * found.exact_worst_m)


# === Pictures of what a camera sees, as values; app/planning/predict/printed_plate.py renders them.


MAX_VIEW_PIXELS = 9_000_000
"""Pixels of a picture at most. 3840 x 2160, two seconds of a processor."""


class ViewReading(StrEnum):
    """How the plate was read in a picture."""

    ALONE = "alone"
    WITH_REGISTRY = "with-registry"
    NOT_READ = "not-read"


@dataclass(frozen=True, slots=True)
class CameraView:
    """A picture and what was read in it."""

    jpeg: bytes
    # [px] outer corners of the plate, clockwise from the triangle's; empty where it is not in view
    corners_px: tuple[tuple[float, float], ...]
    # read from the picture alone; or only by a vehicle that knows the plate and its neighbours; or not
    reading: ViewReading
    confidence: float  # of the reading, 0 to 1
    exposure_s: float  # [s] of the camera; by night at least as long as the light requires


def check_view_size(rules: CameraRules) -> None:
    """Refuse a camera whose pictures are too large to render.

    Raises
    ------
    InvalidParameter
        They are.
    """
    pixels = rules.width_px * rules.height_px
    if pixels > MAX_VIEW_PIXELS:
        raise InvalidParameter(
            f"the picture would have {pixels / 1e6:.1f} million pixels",
            field="camera.width_px",
            limit=f"{MAX_VIEW_PIXELS / 1e6:g} million pixels",
            cure="choose a smaller width and height",
        )


# === What a camera sees of one pass over a plate: frames, motion blur, and how often the plate is predicted to be read.


MAX_FRAMES = 40
"""Frames of a pass that are listed; of more, so many at equal steps. A page of a table."""
_PASS_GRID_M = 0.02  # [m] between distances at which the view is computed; source: as in app/planning/predict/rates.py


@dataclass(frozen=True, slots=True)
class PassFrame:
    """One frame of a pass."""

    ahead_m: float  # [m] from the camera to the plate's centre, along the road
    unit_px: float  # [px] height of a unit's image
    # `plate_width_px`, `plate_height_px`: [px] extent of the plate's image
    plate_width_px: float
    plate_height_px: float
    blur_px: float  # [px] how far the plate's image moves during the exposure
    read_probability: float  # of reading this frame by day, in mean circumstances


MIN_READ_RATE: float = PredictionRules().min_read_rate
"""[1] least read rate of a plate that counts as readable. Source: default of `PredictionRules.min_read_rate`."""


@dataclass(frozen=True, slots=True)
class PassRate:
    """How often a pass is predicted to read the plate."""

    condition: str
    read_rate: float
    will_be_read: bool


@dataclass(frozen=True, slots=True)
class CameraPass:
    """A pass of a camera over a plate at even speed on a flat and straight road.

    `frames` are those with units of a pixel or more, one in `listed_every`.
    """

    speed_kmh: float
    step_m: float  # [m] that the vehicle advances from frame to frame
    # `near_m`, `far_m`: [m] nearest and farthest distance at which a unit is `MIN_UNIT_PX` high or more and the plate
    # is whole in view; None where it never is
    near_m: float | None
    far_m: float | None
    readable_frames_per_pass: float  # mean number of frames of a pass between these two
    best_unit_px: float  # [px] greatest height of a unit's image
    # `blur_mm`, `blur_units`: distance driven during the exposure, and as a share of the pitch of the units. [mm, 1]
    blur_mm: float
    blur_units: float
    frames: tuple[PassFrame, ...]  # those between these two, far to near
    listed_every: int  # `frames` has one of so many
    read_rates: tuple[PassRate, ...]
    min_read_rate: float  # [1] least rate of a plate that counts as readable


def camera_pass(geometry: PlateGeometry, rules: CameraRules, speed_kmh: float, left_m: float = 0.0) -> CameraPass:
    """Predict a pass.

    Parameters
    ----------
    speed_kmh : float
        Above 0. [km/h]
    left_m : float
        Plate's centre left of the camera's path. [m]

    Raises
    ------
    InvalidParameter
        The speed is not positive.

    Notes
    -----
    The rates are those of plans: `app.planning.predict.rates`. A single frame's probability is that of the same model
    without the spread between passes.
    """
    if not speed_kmh > 0:
        raise InvalidParameter(f"the speed is {speed_kmh:g} km/h", field="speed_kmh", limit="above 0")
    camera, speed_m_s = camera_of(rules), speed_kmh / 3.6
    grid = np.arange(_PASS_GRID_M, FAR_M, _PASS_GRID_M)
    unit_px = unit_heights_px(camera, geometry, grid, left_m)
    in_reach = grid[unit_px >= MIN_UNIT_PX]
    step_m = speed_m_s / rules.frames_per_s
    blur_m = speed_m_s * rules.exposure_s
    ahead = np.arange(step_m / 2, FAR_M, step_m)
    ahead = ahead[unit_heights_px(camera, geometry, ahead, left_m) >= MIN_UNIT_PX]
    every = max(-(-len(ahead) // MAX_FRAMES), 1)
    models = fitted_models()
    frames_per_pass = len(in_reach) * _PASS_GRID_M / step_m if left_m else readable_frames(geometry, rules, speed_m_s)
    rates = {name: plate_read_rate(geometry, rules, name, speed_m_s, left_m) for name in models.plates}
    return CameraPass(
        speed_kmh=speed_kmh,
        step_m=step_m,
        near_m=float(in_reach[0]) if len(in_reach) else None,
        far_m=float(in_reach[-1]) if len(in_reach) else None,
        readable_frames_per_pass=round(frames_per_pass, 2),
        best_unit_px=float(unit_px.max()),
        blur_mm=blur_m * 1000,
        blur_units=blur_m / (geometry.pitch_mm / 1000),
        frames=_frames(camera, geometry, ahead[::every][::-1], left_m, blur_m),
        listed_every=every,
        read_rates=tuple(PassRate(name, round(rate, 4), rate >= MIN_READ_RATE) for name, rate in rates.items()),
        min_read_rate=MIN_READ_RATE,
    )


def _frames(
    camera: Camera, geometry: PlateGeometry, ahead_m: Floats, left_m: float, blur_m: float
) -> tuple[PassFrame, ...]:
    half = geometry.side_mm / 2000
    corners = [(forward, across) for forward in (-half, half) for across in (-half, half)]
    seen = [project_road(camera, ahead_m + forward, left_m + across) for forward, across in corners]
    u, v = np.stack([columns for columns, _ in seen]), np.stack([rows for _, rows in seen])
    ends = [project_road(camera, ahead_m + way, left_m) for way in (-blur_m / 2, blur_m / 2)]
    blur_px = np.hypot(ends[1][0] - ends[0][0], ends[1][1] - ends[0][1])
    unit_px = unit_heights_px(camera, geometry, ahead_m, left_m)
    model = fitted_models().plate_model(DAY)
    blur_units = blur_m / (geometry.pitch_mm / 1000)
    share = scipy.special.expit(model.pass_log_odds(unit_px, blur_units)) * float(model.readable_share(blur_units))
    rows = np.column_stack([ahead_m, unit_px, np.ptp(u, axis=0), np.ptp(v, axis=0), np.nan_to_num(blur_px), share])
    return tuple(PassFrame(*row) for row in rows.tolist())


# === Plates in the image of a camera: its geometry alone, on a flat road.


def camera_of(rules: CameraRules) -> Camera:
    """The camera that rules describe."""
    return Camera.from_field_of_view(
        rules.width_px,
        rules.height_px,
        rules.horizontal_fov_deg,
        height_m=rules.height_m,
        depression_deg=rules.depression_deg,
    )


def project_road(
    camera: Camera, ahead_m: Floats, left_m: float | Floats, up_m: float | Floats = 0.0
) -> tuple[Floats, Floats]:
    """Columns and rows of places ahead of the camera on the road, each of shape (K,); NaN behind it. [px]"""
    left, up = np.broadcast_to(left_m, ahead_m.shape), np.broadcast_to(up_m, ahead_m.shape)
    vehicle = np.stack([ahead_m, left, up - camera.height_m], axis=1)
    x, y, z = (camera.camera_from_vehicle @ vehicle.T).astype(float)
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = camera.fx_px * x / z + camera.cx_px, camera.fy_px * y / z + camera.cy_px
    return np.where(z > 0.05, u, np.nan), np.where(z > 0.05, v, np.nan)


def unit_heights_px(camera: Camera, geometry: PlateGeometry, ahead_m: Floats, left_m: float | Floats = 0.0) -> Floats:
    """Height of a unit's image when a plate's centre is at distances ahead, shape (K,); 0 where it is not in view. [px]

    The height of the whole plate's image over its number of units, as the proof has it.
    """
    side = geometry.side_mm / 1000
    corners = [(forward, across) for forward in (-side / 2, side / 2) for across in (-side / 2, side / 2)]
    columns, rows = zip(
        *(project_road(camera, ahead_m + forward, left_m + across) for forward, across in corners), strict=True
    )
    u, v = np.stack(columns), np.stack(rows)
    with np.errstate(invalid="ignore"):
        inside = ((u >= -0.5) & (u <= camera.width_px - 0.5) & (v >= -0.5) & (v <= camera.height_px - 0.5)).all(axis=0)
    return np.where(inside, (v.max(axis=0) - v.min(axis=0)) / geometry.n, 0.0)
