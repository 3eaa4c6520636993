"""Videos of drives past a plate."""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import Any

import av
import numpy as np

from app.markers.plate import PlateCode, PlateGeometry, PlateScheme
from app.sensors.camera import Camera
from app.simulation.camera import render_plate_scene
from app.simulation.conditions import draw_daylight
from app.simulation.plate_face import plate_face
from app.simulation.plate_scene import PlacedFace, PlateScene

_CAMERA = Camera.from_field_of_view(960, 540, 60.0)
DECLARED = {"width_px": 960, "height_px": 540, "horizontal_fov_deg": 60.0}
SPEED_M_S, RATE_HZ = 12.0, 20.0


def video_past(code: Mapping[str, Any]) -> bytes:
    """MP4 of 14 frames past a plate of 8 x 8 units, by its code as the API returns it."""
    rng = np.random.default_rng(5)
    fair = draw_daylight(rng)
    shown = PlateCode(code["digits"], PlateScheme(code["scheme"]))
    face = plate_face(shown, PlateGeometry(8), fair.look, fair.wear, rng)
    out = io.BytesIO()
    with av.open(out, "w", format="mp4") as container:
        stream: Any = container.add_stream("libx264", rate=round(RATE_HZ))
        stream.width, stream.height, stream.pix_fmt = 960, 540, "yuv420p"
        stream.options = {"preset": "ultrafast", "crf": "18", "x264-params": "log-level=none"}
        for number in range(14):
            ahead_m = 8.0 - number * SPEED_M_S / RATE_HZ
            scene = PlateScene(_CAMERA, (PlacedFace(face, ahead_m, 0.2),), SPEED_M_S, fair.exposure_s)
            image = render_plate_scene(scene, None, rng).image
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="bgr24")))
        container.mux(stream.encode(None))
    return out.getvalue()
