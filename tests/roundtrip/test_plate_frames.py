"""Position -> plate -> artwork -> road -> camera -> digits -> position."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from app.decoders.plate.reader import decode_plates
from app.encoders.plate import PlateOrder, encode_plate, write_png
from app.markers.plate import PlateCode, PlateGeometry, resolve_position
from app.markers.reading import PlateOutcome
from app.sensors.camera import Camera
from app.simulation.camera import render_plate_scene
from app.simulation.plate_face import Face
from app.simulation.plate_scene import PlacedFace, PlateScene

CAMERA = Camera.from_field_of_view(960, 540, 60.0, height_m=1.5, depression_deg=25.0)
PAINT = 0.8  # reflectance of white


def printed_face(code: PlateCode, geometry: PlateGeometry) -> Face:
    """What the fabricator's PNG shows inside the plate's outer edge."""
    drawing = encode_plate(PlateOrder("P", code, geometry))
    sheet = cv2.imdecode(np.frombuffer(write_png(drawing, dpi=75), np.uint8), cv2.IMREAD_COLOR)
    px_per_mm = sheet.shape[1] / drawing.width_mm
    left, bottom, right, top = drawing.trim_mm[0]
    rows = slice(round((drawing.height_mm - top) * px_per_mm), round((drawing.height_mm - bottom) * px_per_mm))
    part = sheet[rows, round(left * px_per_mm) : round(right * px_per_mm)].astype(np.float32) / 255
    size = part.shape[0]
    linear = cv2.resize(part**2.2, (size, size), interpolation=cv2.INTER_AREA) * PAINT
    return Face(geometry.side_mm / 1000, np.ascontiguousarray(linear, np.float32))


@pytest.mark.parametrize(
    ("lon_deg", "lat_deg", "n", "checks"),
    [
        (114.179312, 22.304568, 8, 0),  # Hong Kong
        (-77.036530, -38.897676, 8, 1),  # south and west
        (0.000310, 51.477812, 8, 0),  # Greenwich
        (-0.000310, 51.477812, 8, 0),
        (36.800000, -0.000450, 8, 2),  # just south of the equator
        (179.999400, -16.800120, 8, 0),  # the antimeridian
        (12.9999997, 45.5, 8, 0),  # carries into the integer
        (-70.648270123, -33.456940456, 10, 0),
        (139.767125678, 35.681236789, 12, 1),
    ],
)
@pytest.mark.parametrize("turn_deg", [0.0, 160.0])
def test_a_surveyed_position_comes_back_from_a_frame(
    lon_deg: float, lat_deg: float, n: int, checks: int, turn_deg: float
) -> None:
    code, geometry = PlateCode.from_position(lon_deg, lat_deg, n=n, check_digits=checks), PlateGeometry(n)
    scene = PlateScene(CAMERA, (PlacedFace(printed_face(code, geometry), 2.5, 0.1, turn_deg),), speed_m_s=8.0)
    frame = render_plate_scene(scene, None, np.random.default_rng(4))
    picture = cv2.imdecode(np.frombuffer(frame.jpeg, np.uint8), cv2.IMREAD_COLOR)
    read = [r for r in decode_plates(np.asarray(picture), codebook=[code]) if r.outcome is PlateOutcome.READ]
    assert [r.code for r in read] == [code]
    assert read[0].confidence > 0.999
    found = resolve_position(read[0].code, lon_deg, lat_deg + 0.0002 * (1 if lat_deg > 0 else -1))
    digit = 10.0 ** -{8: 6 if not checks else 5, 10: 9, 12: 9}[n]
    assert abs((found.lon_deg - lon_deg + 180) % 360 - 180) <= 0.51 * digit
    assert abs(found.lat_deg - lat_deg) <= 0.51 * digit


def test_an_id_plate_comes_back_from_a_frame_with_its_number() -> None:
    code = PlateCode.from_registry_number(0xC0FFEE42)
    face = printed_face(code, PlateGeometry())
    dirty = face.reflectance.copy()
    dirty[135:178, 10:80] = 0.1  # below the triangle, a stain over most of one cell
    for used in (face, replace(face, reflectance=dirty)):
        scene = PlateScene(CAMERA, (PlacedFace(used, 2.4, -0.2, 45.0),))
        frame = render_plate_scene(scene, None, np.random.default_rng(1))
        read = [r for r in decode_plates(frame.image) if r.code]
        assert [r.code.registry_number for r in read if r.code] == [0xC0FFEE42]
