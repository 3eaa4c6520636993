"""Light, weather, camera and state of a plate in a simulated drive."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from app.planning.proof.terms import Condition
from app.planning.rules import CameraRules
from app.simulation.conditions import Conditions, at_night, draw_daylight, draw_shadow, draw_wear
from app.simulation.plate_face import PlateWear
from app.simulation.plate_scene import Air, Shadow

_RAIN_HAZE = (0.05, 0.35)  # share of airlight; source: assumed, half of the haze of `draw_stress`
_RAIN_GLARE = (0.0, 0.25)  # radiance of the mirrored sky; source: assumed, below the 0.35 of `draw_stress`
_RAIN_BLUR_PX = (0.2, 0.8)  # [px] that drops on the windscreen add; source: assumed, no measurement kept
_RAIN_LIGHT = 0.5  # of a dry day's electrons; source: assumed, an overcast sky
_RAIN_ROAD = 0.6  # reflectance of a wet road over that of a dry one; source: assumed, no measurement kept


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
