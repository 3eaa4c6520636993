"""One pass over a plate of the plan: frames through the simulation and the decoder, the fix, and why it was missed.

The simulated road is flat and straight; bends and changes of grade are put in as what they are for the camera: another
place and direction of the plate, and another height and pitch of the camera above the plate's plane. A frame is decoded
as one that a vehicle uploads: by the functions that decode uploads, with the rows of the registered plates nearby.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import numpy.typing as npt

from app.decoders.plate.pose import VehicleFix
from app.decoding.declarations import CoarsePosition, DecodeContext
from app.decoding.frames import (
    Nearby,
    fix_from_match,
    fuse_fixes,
    match_plate,
    read_plates,
    search_plates,
    with_registered_size,
)
from app.formats.images import load_image
from app.geodesy import enu_from_heading, enu_from_wgs84, wgs84_from_enu
from app.markers.reading import MarkerRow
from app.planning.alignment import Lane
from app.planning.plan import PlannedMarker, PlannedPlate
from app.planning.proof.drives import COARSE_M, EPOCH, START
from app.planning.proof.report import Condition, MarkerPass, WrongReading
from app.planning.rules import CameraRules
from app.sensors.camera import Camera, CameraDeclaration
from app.simulation.backgrounds import road_background, road_photos
from app.simulation.camera import RenderedFrame, render_plate_scene
from app.simulation.conditions import (
    Conditions,
    Drive,
    at_night,
    draw_daylight,
    draw_shadow,
    draw_wear,
    drive_over_plate,
)
from app.simulation.plate_face import PlateWear, plate_face
from app.simulation.plate_scene import Air, PlateScene, Shadow, face_truth
from app.values import Floats

# === Light, weather, camera and state of a plate in a simulated drive.


_RAIN_HAZE = (0.05, 0.35)  # share of airlight; source: assumed, half of the haze of `draw_stress`
_RAIN_GLARE = (0.0, 0.25)  # radiance of the mirrored sky; source: assumed, below the 0.35 of `draw_stress`
_RAIN_BLUR_PX = (0.2, 0.8)  # [px] that drops on the windscreen add; assumed
_RAIN_LIGHT = 0.5  # of a dry day's electrons; source: assumed, an overcast sky
_RAIN_ROAD = 0.6  # reflectance of a wet road over that of a dry one; assumed


def draw_drive(camera: CameraRules, parts: frozenset[Condition], rng: np.random.Generator) -> Conditions:
    """Sensor, exposure and weather of one drive."""
    drawn = draw_daylight(rng)
    sensor = replace(drawn.sensor, readout_s=camera.rolling_shutter_s)
    drawn = replace(drawn, sensor=sensor, exposure_s=camera.exposure_s)
    if Condition.RAIN in parts:
        sensor = replace(
            sensor,
            blur_px=float(np.hypot(sensor.blur_px, rng.uniform(*_RAIN_BLUR_PX))),
            full_well_e=_RAIN_LIGHT * sensor.full_well_e,
        )
        air = Air(
            haze=float(rng.uniform(*_RAIN_HAZE)),
            airlight=float(rng.uniform(0.4, 0.9)),
            glare=float(rng.uniform(*_RAIN_GLARE)),
            glare_at_m=(float(rng.uniform(-0.2, 0.2)), float(rng.uniform(-0.2, 0.2))),
        )
        drawn = replace(drawn, sensor=sensor, air=air, road_reflectance=_RAIN_ROAD * drawn.road_reflectance)
    if Condition.NIGHT in parts:
        night = at_night(drawn, rng)
        light = night.night_light or 0.0  # haze and wet roads mirror no more light than there is
        air = replace(drawn.air, airlight=light * drawn.air.airlight, glare=light * drawn.air.glare)
        drawn = replace(night, air=air, exposure_s=max(camera.exposure_s, night.exposure_s))
    return drawn


def draw_plate(drive: Conditions, parts: frozenset[Condition], rng: np.random.Generator) -> Conditions:
    """The conditions of a drive with one plate's materials, wear, dirt and shadow."""
    own = draw_daylight(rng)
    worn = draw_wear(rng)
    shadow = Shadow()
    while Condition.SHADE in parts and Condition.NIGHT not in parts and shadow.is_none:
        shadow = draw_shadow(rng)
    wear = own.wear
    if Condition.WEAR in parts:
        wear = replace(worn, dirt_blobs=0)
    if Condition.DIRT in parts:
        wear = replace(wear, dirt_blobs=max(worn.dirt_blobs, 1), dirt_mm=worn.dirt_mm)
    look = replace(own.look, led=drive.look.led)
    return replace(drive, look=look, wear=wear, shadow=shadow)


def without(conditions: Conditions, cause: Condition, fair: Conditions) -> Conditions:
    """The conditions with one of them replaced by fair weather and a new plate: to find out what a miss is due to."""
    match cause:
        case Condition.SHADE:
            return replace(conditions, shadow=Shadow())
        case Condition.WEAR:
            return replace(conditions, wear=replace(conditions.wear, contrast_loss=0.0, patchy_loss=0.0))
        case Condition.DIRT:
            return replace(conditions, wear=replace(conditions.wear, dirt_blobs=0))
        case Condition.RAIN | Condition.NIGHT:
            return replace(fair, wear=conditions.wear, shadow=conditions.shadow)
        case Condition.DAY:
            return replace(fair, wear=PlateWear())


# === One pass over a plate of the plan.


Image = npt.NDArray[np.uint8]

MIN_UNIT_PX = 1.0
"""[px] height of a unit's image from which frames are rendered. Source: benchmarks/plates/sets.py, RENDERED_ROWS."""
FAR_M = 18.0
"""[m] ahead, from where frames are simulated. Source: benchmarks/plates/sets.py, the paper's trials."""
PLACEMENT_SD_M, ROTATION_SD_DEG = 0.15, 2.0
"""[m, deg] of the vehicle's offset and the plate's direction. Source: app/demo/drive.py and `Driver` of the CERPMs."""
_GRAIN = (0.01, 0.05)  # of the asphalt; source: benchmarks/plates/sets.py
_FEW_FRAMES = 2  # readable frames, below which a miss is due to the speed alone
_CAUSE_FRAMES = 6  # nearest frames in which a cause is looked for; for speed
_SLOWER = 0.25  # of the speed, to find out whether speed is the cause


@dataclass(frozen=True, slots=True, eq=False)
class PlatePass:
    """A pass over a plate, with everything drawn but phase, sway and noise."""

    marker: PlannedMarker  # with a PlannedPlate
    lane: Lane
    camera: Camera
    # `conditions`, `fair`: those of the pass, and the fair ones of the same drive, for causes
    conditions: Conditions
    fair: Conditions
    parts: frozenset[Condition]
    # `speed_m_s`, `left_m`, `rotation_deg`: as in `Drive`
    speed_m_s: float
    fps: float
    left_m: float
    rotation_deg: float
    rows: Sequence[MarkerRow]  # of the plates about the marker, after the survey
    coarse_error_m: Floats  # shape (2,): [m] east and north of the coarse position from the vehicle's true one
    noise_seed: tuple[int, ...]
    # `bends`, `grades`: whether the lane's curvature and grade are simulated
    bends: bool = True
    grades: bool = True

    @property
    def plate(self) -> PlannedPlate:
        """What the marker is."""
        assert isinstance(self.marker.detail, PlannedPlate)
        return self.marker.detail

    def context(self, ahead_m: float) -> DecodeContext:
        """What the vehicle sends with a frame that it takes at a distance from the plate."""
        at_m = max(self.marker.chainage_m - ahead_m, 0.0)
        (lon_deg,), (lat_deg,) = self.lane.position_at(at_m, self.marker.offset_m - self.left_m)
        lon, lat, _height = wgs84_from_enu(np.array([*self.coarse_error_m, 0.0]), (lon_deg, lat_deg, 0.0))
        camera = self.camera
        return DecodeContext(
            coarse_position=CoarsePosition(lon_deg=lon, lat_deg=lat, accuracy_m=COARSE_M),
            heading_deg=float(self.lane.heading_at(at_m)),
            camera=CameraDeclaration(
                width_px=camera.width_px, height_px=camera.height_px, fx_px=camera.fx_px, fy_px=camera.fy_px,
                cx_px=camera.cx_px, cy_px=camera.cy_px, height_m=camera.height_m, depression_deg=camera.depression_deg,
                readout_s=self.conditions.sensor.readout_s,
            ),
            captured_at=START,
        )  # fmt: skip


@dataclass(slots=True)
class FramesRead:
    """Frames of a pass."""

    readable: int = 0  # frames in which a unit is a pixel high or more
    read: int = 0  # frames that were read
    fix_m: list[float] | None = None  # [m] error of the most accurate fix along and across the lane
    wrong: list[str] = field(default_factory=list)  # digits that are not there
    # of those rendered: height of a unit's image [px], and whether it was read
    frames: list[tuple[float, bool]] = field(default_factory=list)

    @property
    def seen(self) -> int:
        """Frames that were rendered."""
        return len(self.frames)


def drive_plate(one: PlatePass, weight: float, min_frames: int) -> tuple[MarkerPass, list[WrongReading]]:
    """Read a plate in one pass, in at least `min_frames` frames if it can be.

    A miss is repeated without one difficulty at a time, to find its cause.
    """
    frames = read_frames(one, enough=min_frames)
    result = MarkerPass(
        marker=one.marker.number, weight=weight, lost=False, readable=frames.readable, seen=frames.seen,
        read=frames.read, fix_m=frames.fix_m, cause=None if frames.read else find_cause(one, frames.readable),
    )  # fmt: skip
    return result, [WrongReading(marker=one.marker.number, text=text) for text in frames.wrong]


def find_cause(one: PlatePass, readable: int) -> str:
    """The first difficulty without which the same pass reads the plate in one of its nearest frames."""
    tries: list[tuple[str, PlatePass]] = [
        (str(part), replace(one, conditions=without(one.conditions, part, one.fair)))
        for part in (Condition.SHADE, Condition.DIRT, Condition.WEAR, Condition.RAIN, Condition.NIGHT)
        if part in one.parts
    ]
    tries.append(("bend", replace(one, bends=False)))
    tries.append(("grade", replace(one, grades=False)))
    slower = replace(one, speed_m_s=_SLOWER * one.speed_m_s)
    tries.append(("few frames at this speed" if readable < _FEW_FRAMES else "blur at this speed", slower))
    for cause, easier in tries:
        if read_frames(easier, enough=1, most=_CAUSE_FRAMES).read:
            return cause
    return "several together" if one.parts - {Condition.DAY} else "camera"


def read_frames(one: PlatePass, *, enough: int | None = None, most: int | None = None) -> FramesRead:
    """Render and decode the frames of a pass in which the plate's units are a pixel high or more.

    Parameters
    ----------
    enough : int, optional
        Stop when so many frames were read: the nearest is rendered first, the others in an even spread. A frame is
        the same whether others were rendered before it or not.
    most : int, optional
        Only so many of the nearest frames.
    """
    out = FramesRead()
    rng = np.random.default_rng(one.noise_seed)
    photos = road_photos()
    photo = photos[int(rng.integers(len(photos)))]
    background = road_background(photo, one.camera, rng, grain=float(rng.uniform(*_GRAIN)))
    scenes = [(k, scene) for k, scene in enumerate(scenes_of(one, rng)) if _unit_px(one, scene) >= MIN_UNIT_PX]
    out.readable = len(scenes)
    scenes = scenes[::-1][:most]
    best = math.inf
    for nearest in _spread_order(len(scenes)):
        k, scene = scenes[nearest]
        frame = render_plate_scene(scene, background, np.random.default_rng((*one.noise_seed, k)))
        hit, fix = _read(one, scene, frame, out)
        out.frames.append((_unit_px(one, scene), hit))
        out.read += hit
        if fix is not None:
            size = float(np.trace(fix.covariance[:2, :2]))
            if size < best:
                best, out.fix_m = size, fix_error(one, fix, scene)
        if enough is not None and out.read >= enough:
            break
    return out


def _unit_px(one: PlatePass, scene: PlateScene) -> float:
    """Height of a unit's image, 0 where the plate is not in view. [px]"""
    truth = face_truth(scene, scene.faces[0])
    return truth.height_px / one.plate.geometry.n if truth.in_view else 0.0


def _spread_order(count: int) -> list[int]:
    """0, then the others in an even spread: by the binary digits of their indices in reverse."""
    bits = max(count - 1, 1).bit_length()
    return sorted(range(count), key=lambda k: int(f"{k:0{bits}b}"[::-1], 2))


def _read(
    one: PlatePass, scene: PlateScene, rendered: RenderedFrame, out: FramesRead
) -> tuple[bool, VehicleFix | None]:
    """Decode a frame as the server decodes an upload: whether the plate was read, and the vehicle's position."""
    cv2.setNumThreads(1)
    context = one.context(scene.faces[0].ahead_m)
    position = context.coarse_position
    assert position is not None
    frame = load_image(rendered.jpeg)
    camera = context.camera_of(frame.header)
    assert camera is not None
    nearby = Nearby.of(one.rows, position)
    corners_px = rendered.truths[0].corners_px
    read, fixes = False, []
    for reading in read_plates(frame.pixels, search_plates(nearby, camera)):
        if reading.code is None:
            continue
        assert reading.corners_px is not None
        apart_px = np.linalg.norm(reading.corners_px.mean(axis=0) - corners_px.mean(axis=0))
        is_there = apart_px < np.ptp(corners_px, axis=0).max() / 2
        if reading.code.digits == one.plate.code.digits and is_there:
            read = True
        else:
            out.wrong.append(reading.code.digits)
        match = match_plate(nearby, reading.code, position)
        pose = None if match is None else with_registered_size(reading, match, camera).pose
        if match is not None and pose is not None:
            fix = fix_from_match(pose, camera, match, "plate", context.heading_deg, epoch=EPOCH)
            fixes += [fix] if fix is not None else []
    fused = fuse_fixes(fixes)
    return read, None if fused is None else fused.vehicle


def scenes_of(one: PlatePass, rng: np.random.Generator) -> Iterator[PlateScene]:
    """Scenes of the frames, far to near, with the road's shape about the plate."""
    conditions = one.conditions
    face = plate_face(one.plate.code, one.plate.geometry, conditions.look, conditions.wear, rng)
    drive = Drive(
        camera=one.camera,
        face=face,
        speed_m_s=one.speed_m_s,
        fps=one.fps,
        exposure_s=conditions.exposure_s,
        left_m=one.left_m,
        rotation_deg=one.rotation_deg,
        far_m=FAR_M,
        road_reflectance=conditions.road_reflectance,
        shadow=conditions.shadow,
        air=conditions.air,
        sensor=conditions.sensor,
    )
    for scene in drive_over_plate(drive, rng, partly=True):
        yield replace(_on_road(scene, one), night_light=conditions.night_light)


def _on_road(scene: PlateScene, one: PlatePass) -> PlateScene:
    """A scene of a straight, even road as it is on the lane.

    Notes
    -----
    Over a distance d with the curvature k, the plate is k d^2 / 2 to the left and turned by k d. With a grade that
    changes by g, the camera's road is g d / 2 above the plane of the plate, and the vehicle pitched by g against it.
    """
    placed = scene.faces[0]
    lane, at_m, d = one.lane, one.marker.chainage_m, placed.ahead_m
    here, there = float(max(at_m - d, 0.0)), float(min(at_m, lane.length_m))
    if one.bends:
        curvature = float(lane.value_at(lane.curvature_per_m, (here + there) / 2))
        moved = replace(
            placed,
            left_m=placed.left_m + curvature * d**2 / 2,
            rotation_deg=placed.rotation_deg - math.degrees(curvature * d),
        )
        scene = replace(scene, faces=(moved,))
    change = float(lane.value_at(lane.grade, there) - lane.value_at(lane.grade, here)) if one.grades else 0.0
    if change:
        camera = replace(scene.camera, height_m=max(scene.camera.height_m + change * d / 2, 0.1))
        roll, pitch, yaw = scene.body_deg
        scene = replace(scene, camera=camera, body_deg=(roll, pitch + math.degrees(change), yaw))
    return scene


def fix_error(one: PlatePass, fix: VehicleFix, scene: PlateScene) -> list[float]:
    """Error of the vehicle's position from one frame, along and across the plate's direction. [m]"""
    marker = one.marker
    true = (marker.lon_deg, marker.lat_deg, marker.height_m or 0.0)
    fixed = enu_from_wgs84(fix.lon_deg, fix.lat_deg, true[2], true)
    placed = scene.faces[0]
    ground_from_vehicle = scene.camera_from_ground.T @ one.camera.camera_from_vehicle
    vehicle = (0.0, 0.0, scene.camera.height_m) - ground_from_vehicle @ one.camera.position_vehicle_m
    in_plate = placed.ground_from_face.T @ (vehicle - (placed.ahead_m, placed.left_m, 0.0))
    off = enu_from_heading(marker.heading_deg).T @ fixed - in_plate  # right, up (along), out of the road
    return [float(off[1]), float(-off[0])]
