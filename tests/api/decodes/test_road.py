"""The whole way with the shipped decoder: plates registered, a drive rendered, frames uploaded, the vehicle found."""

from __future__ import annotations

import io
import re
import zipfile
from collections.abc import Callable
from typing import Any

import cv2
import httpx
import numpy as np
import pytest
from PIL import Image, TiffImagePlugin

from app.geodesy import enu_from_heading, enu_from_wgs84, move_to_epoch, wgs84_from_enu
from app.markers.plate import PlateCode, PlateGeometry, PlateScheme, decimal_codes
from app.sensors.camera import Camera
from app.simulation.camera import render_plate_scene
from app.simulation.plate_face import Face, PlateWear, draw_look, plate_face
from app.simulation.plate_scene import PlacedFace, PlateScene
from tests.api.decodes.conftest import post_frame
from tests.api.decodes.test_archives import wait_for
from tests.conftest import LiveServer, Place
from tests.decoders.plate.scenes import marker_units, painted

CAMERA = Camera.from_field_of_view(1920, 1080, 70.0, height_m=1.57, depression_deg=23.0, forward_m=1.2, left_m=0.1)
CAMERA_IN = {
    "width_px": 1920,
    "height_px": 1080,
    "horizontal_fov_deg": 70.0,
    "height_m": 1.57,
    "depression_deg": 23.0,
    "forward_m": 1.2,
    "left_m": 0.1,
}
HEADING_DEG = 63.0


def from_vehicle_m(ahead_m: float, left_m: float) -> np.ndarray[Any, np.dtype[np.float64]]:
    """East, north, up from the vehicle's reference point of a place seen from below the camera."""
    right, forward = -(left_m + CAMERA.left_m), ahead_m + CAMERA.forward_m
    return enu_from_heading(HEADING_DEG) @ np.array([right, forward, 0.0])


EPOCH, CAPTURED_AT = 2026.4, "2026-05-27T00:00:00Z"


class Road:
    """A vehicle at a place, and the plates before it: (ahead_m, left_m, rotation_deg) from below the camera."""

    def __init__(self, client: httpx.Client, vehicle: dict[str, Any], *plates: tuple[float, float, float]) -> None:
        self.client = client
        self.origin = (vehicle["lon_deg"], vehicle["lat_deg"], 40.0)
        self.plates = plates
        self.markers: list[dict[str, Any]] = []

    def register(self, **more: Any) -> Road:
        """Register the plates where they lie."""
        for ahead, left, rotation in self.plates:
            enu_m = from_vehicle_m(ahead, left)
            lon, lat, height = wgs84_from_enu(enu_m, self.origin)
            body: dict[str, Any] = {
                "position": {
                    "lon_deg": lon,
                    "lat_deg": lat,
                    "height_m": height,
                    "realization": "ITRF2014",
                    "epoch": EPOCH,
                    "horizontal_rmse_m": 0.01,
                    "vertical_rmse_m": 0.02,
                },
                "heading_deg": (HEADING_DEG + rotation) % 360,
                "heading_rmse_deg": 0.2,
                "status": "surveyed",
            } | more
            answer = self.client.post("/v1/markers", json=body)
            assert answer.status_code == 201, answer.text
            self.markers.append(answer.json())
        return self

    def frame(
        self, codes: list[PlateCode] | None = None, seed: int = 1, cover: Callable[[Face], Face] = lambda face: face
    ) -> bytes:
        """JPEG of the plates, each covered by something, as the camera sees them."""
        rng = np.random.default_rng(seed)
        codes = codes or [
            PlateCode(m["code"]["digits"], PlateScheme(m["code"]["scheme"]), m["geometry"]["n"]) for m in self.markers
        ]
        faces = tuple(
            PlacedFace(
                cover(plate_face(code, PlateGeometry(n=code.n), draw_look(rng), PlateWear(), rng)),
                *where,
            )
            for code, where in zip(codes, self.plates, strict=True)
        )
        jpeg = render_plate_scene(PlateScene(camera=CAMERA, faces=faces), None, rng).jpeg
        assert jpeg
        return jpeg

    def context(self, **more: Any) -> dict[str, Any]:
        """What the vehicle knows: its place within a few metres."""
        coarse = {"lon_deg": self.origin[0] + 3e-5, "lat_deg": self.origin[1] - 3e-5, "accuracy_m": 10.0}
        return {"coarse_position": coarse, "camera": CAMERA_IN, "captured_at": CAPTURED_AT} | more

    def error_m(self, fix: dict[str, Any]) -> float:
        """Distance of a fix from where the vehicle really is."""
        enu_m = enu_from_wgs84(fix["lon_deg"], fix["lat_deg"], fix["height_m"], self.origin)
        return float(np.linalg.norm(enu_m))


def test_the_vehicle_is_found(real_client: httpx.Client, place: Place) -> None:
    road = Road(real_client, place(), (5.0, 0.4, 8.0)).register()
    decode = post_frame(real_client, road.frame(), road.context()).json()
    assert decode["summary"]["plates_matched"] == 1, decode["summary"]
    [reading] = [r for r in decode["readings"] if r["outcome"] == "read"]
    assert reading["digits"] == road.markers[0]["code"]["digits"]
    assert reading["match"]["marker_id"] == road.markers[0]["id"]
    assert len(reading["corners_px"]) == 4
    assert reading["grade"]["letter"] in "ABCDF"
    assert reading["pose"]["reprojection_rms_px"] < 1.0
    fix = decode["fix"]
    assert fix["localization_grade"] == "cm"
    assert road.error_m(fix) < 0.06
    assert abs((fix["heading_deg"] - HEADING_DEG + 180) % 360 - 180) < 0.6
    # the plate moves on with its tectonic plate: the vehicle is where it is when the frame is captured
    assert fix["epoch"] == pytest.approx(EPOCH, abs=0.002)
    earlier = post_frame(real_client, road.frame(), road.context(captured_at="2015-01-01T00:00:00Z")).json()["fix"]
    then = move_to_epoch(fix["lon_deg"], fix["lat_deg"], EPOCH, 2015.0)
    assert (earlier["lon_deg"], earlier["lat_deg"]) == pytest.approx((then.lon_deg[0], then.lat_deg[0]), abs=1e-8)
    assert earlier["sigma"]["east_m"] > fix["sigma"]["east_m"]
    covariance = np.array(fix["covariance"])
    assert covariance.shape == (4, 4)
    assert (np.linalg.eigvalsh(covariance) > 0).all()
    assert road.error_m(fix) < 5 * np.sqrt(np.trace(covariance[:3, :3]))


def test_a_plate_whose_markers_are_under_snow_finds_the_vehicle(real_client: httpx.Client, place: Place) -> None:
    """No colour of it shows: it is found by its pattern, which only the registry can name."""
    corners = ("top-left", "top-right", "bottom-right", "bottom-left")
    snow = dict.fromkeys((unit for corner in corners for unit in marker_units(corner)), (0.88, 0.86, 0.83))
    road = Road(real_client, place(), (5.0, 0.4, 8.0)).register()
    frame = road.frame(cover=lambda face: painted(face, snow))
    decode = post_frame(real_client, frame, road.context()).json()
    [reading] = [r for r in decode["readings"] if r["outcome"] == "read"]
    assert reading["match"]["marker_id"] == road.markers[0]["id"]
    assert road.error_m(decode["fix"]) < 0.1
    elsewhere = road.context(coarse_position={"lon_deg": 20.0, "lat_deg": 20.0, "accuracy_m": 10.0})
    assert post_frame(real_client, frame, elsewhere).json()["summary"]["plates_read"] == 0, "no registry, no pattern"


def test_several_plates_are_fused(real_client: httpx.Client, place: Place) -> None:
    road = Road(real_client, place(), (4.2, 0.9, 0.0), (5.0, -0.8, 180.0)).register()
    decode = post_frame(real_client, road.frame(), road.context()).json()
    assert decode["summary"]["plates_matched"] == 2, decode["summary"]
    single = [r["fix"] for r in decode["readings"] if r["fix"]]
    assert sorted(decode["fix"]["marker_ids"]) == sorted(m["id"] for m in road.markers)
    assert road.error_m(decode["fix"]) < 0.05
    for axis in ("east_m", "north_m"):
        assert decode["fix"]["sigma"][axis] < min(fix["sigma"][axis] for fix in single)


def test_a_position_that_is_not_exact_gives_no_fix_for_localization(real_client: httpx.Client, place: Place) -> None:
    road = Road(real_client, place(), (5.0, 0.0, 0.0)).register(status="planned")
    fix = post_frame(real_client, road.frame(), road.context()).json()["fix"]
    assert fix["localization_grade"] == "unfit"
    assert fix["notes"] == ["the plate is planned, its position is not surveyed"]


def test_a_place_without_a_stated_bound_gives_no_fix_for_localization(real_client: httpx.Client, place: Place) -> None:
    """Coordinates said to be NAD83 in a system of WGS 84: stored, flagged, and every fix says why."""
    road = Road(real_client, place(), (5.0, 0.0, 0.0)).register()
    marker = road.markers[0]
    position = marker["position"]["original"] | {"realization": "NAD83(2011)"}
    change = {"position": position, "heading_deg": marker["heading_deg"]}
    answer = real_client.patch(f"/v1/markers/{marker['id']}", json=change, headers={"If-Match": '"1"'})
    assert answer.json()["position"]["localization_grade"] == "unfit"
    decode = post_frame(real_client, road.frame(), road.context()).json()
    assert decode["fix"]["localization_grade"] == "unfit"
    assert "NAD83(2011)" in " ".join(decode["fix"]["notes"])


def test_a_plate_without_heading_needs_the_vehicles(real_client: httpx.Client, place: Place) -> None:
    road = Road(real_client, place(), (5.0, 0.0, 20.0)).register(heading_deg=None)
    frame = road.frame()
    assert post_frame(real_client, frame, road.context()).json()["fix"] is None
    fix = post_frame(real_client, frame, road.context(heading_deg=HEADING_DEG)).json()["fix"]
    assert fix["localization_grade"] == "unfit"
    assert road.error_m(fix) < 0.3


def test_an_unregistered_position_plate_says_its_place(real_client: httpx.Client, place: Place) -> None:
    for holds in (False, True):  # whether the last digit is by accident the check digit of the others
        codes: tuple[PlateCode, ...] = ()
        while len(codes) != 1 + holds:
            road = Road(real_client, place(), (5.0, 0.0, 0.0))
            lon, lat, _height = wgs84_from_enu(from_vehicle_m(5.0, 0.0), road.origin)
            code = PlateCode.from_position(lon, lat)
            codes = decimal_codes(code.symbols, code.n)
        decode = post_frame(real_client, road.frame([code]), road.context()).json()
        [reading] = [r for r in decode["readings"] if r["outcome"] == "read"]
        match = reading["match"]
        assert (match["registered"], match["plausible"], match["ambiguous"]) == (False, True, False)
        assert match["lon_deg"] == pytest.approx(lon, abs=6e-7)
        assert match["lat_deg"] == pytest.approx(lat, abs=1e-5 if holds else 6e-7)
        there_m = np.linalg.norm(enu_from_wgs84(lon, lat, 0.0, (match["lon_deg"], match["lat_deg"], 0.0)))
        stated = re.findall(r"otherwise it is ([0-9.]+) m away", match["note"])  # from one rounded place to the other
        assert [float(metres) for metres in stated] == [pytest.approx(there_m, abs=0.16)] * holds
        assert decode["fix"] is None


@pytest.mark.parametrize("check_digits", [1, 2])
def test_an_unregistered_plate_with_check_digits_says_its_place(
    real_client: httpx.Client, place: Place, check_digits: int
) -> None:
    road = Road(real_client, place(), (5.0, 0.0, 0.0))
    lon, lat, _height = wgs84_from_enu(from_vehicle_m(5.0, 0.0), road.origin)
    code = PlateCode.from_position(lon, lat, check_digits=check_digits)
    decode = post_frame(real_client, road.frame([code]), road.context()).json()
    [reading] = [r for r in decode["readings"] if r["outcome"] == "read"]
    assert reading["scheme"] == "position"  # nothing says that these are check digits
    assert {"scheme": "position-check", "check_digits": check_digits} in reading["possible_schemes"]
    match = reading["match"]
    assert (match["registered"], match["plausible"]) == (False, True)
    assert "check digits" in match["note"]
    lon_decimals, lat_decimals = map(len, code.decimals)
    assert match["lon_deg"] == pytest.approx(lon, abs=0.6 * 10**-lon_decimals)
    assert match["lat_deg"] == pytest.approx(lat, abs=0.6 * 10**-lat_decimals)


def test_an_id_plate_far_from_its_place_is_named(real_server: LiveServer, place: Place) -> None:
    with real_server.agency("movers") as client:
        road = Road(client, place(), (5.0, 0.0, 0.0)).register(code={"scheme": "id"})
        frame, context = road.frame(), road.context()
        context["coarse_position"]["lat_deg"] += 0.1
        decode = post_frame(client, frame, context).json()
        [reading] = [r for r in decode["readings"] if r["outcome"] == "read"]
        assert reading["match"]["marker_id"] == road.markers[0]["id"]
        assert reading["match"]["plausible"] is False
        assert "elsewhere" in reading["match"]["note"]
        assert decode["fix"] is None
        with real_server.agency("watchers") as stranger:
            decode = post_frame(stranger, frame, context).json()
            [reading] = [r for r in decode["readings"] if r["outcome"] == "read"]
            assert reading["match"]["registered"] is False
            assert reading["match"]["marker_id"] is None


def test_any_orientation_of_the_file_gives_the_same_readings(real_client: httpx.Client, place: Place) -> None:
    road = Road(real_client, place(), (5.0, 0.4, 8.0)).register()
    jpeg = road.frame()
    pixels = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    for orientation, turn in ((3, cv2.ROTATE_180), (6, cv2.ROTATE_90_COUNTERCLOCKWISE), (8, cv2.ROTATE_90_CLOCKWISE)):
        exif, out = Image.Exif(), io.BytesIO()
        exif[0x0112] = orientation
        Image.fromarray(cv2.rotate(pixels, turn)[..., ::-1]).save(out, "JPEG", quality=95, exif=exif)
        decode = post_frame(real_client, out.getvalue(), road.context()).json()
        assert decode["frames"][0]["orientation"] == orientation
        assert road.error_m(decode["fix"]) < 0.08


def with_gps(pixels: Any, lon_deg: float, lat_deg: float, **more: object) -> bytes:
    """A JPEG with a position in its EXIF, as Pillow writes it."""
    exif, out = Image.Exif(), io.BytesIO()
    exif.get_ifd(0x8825).update(
        {
            1: "N" if lat_deg >= 0 else "S",
            2: tuple(TiffImagePlugin.IFDRational(n, 10**7) for n in _sexagesimal(lat_deg)),
            3: "E" if lon_deg >= 0 else "W",
            4: tuple(TiffImagePlugin.IFDRational(n, 10**7) for n in _sexagesimal(lon_deg)),
            **{int(tag): value for tag, value in more.items()},
        }
    )
    Image.fromarray(pixels[..., ::-1]).save(out, "JPEG", quality=95, exif=exif)
    return out.getvalue()


def _sexagesimal(angle_deg: float) -> tuple[int, int, int]:
    minutes, seconds = divmod(abs(angle_deg) * 3600, 60)
    return int(minutes // 60) * 10**7, int(minutes % 60) * 10**7, round(seconds * 1e7)


def test_the_position_in_the_exif_is_used_where_none_is_declared(real_client: httpx.Client, place: Place) -> None:
    road = Road(real_client, place(), (5.0, 0.4, 8.0)).register()
    pixels = cv2.imdecode(np.frombuffer(road.frame(), np.uint8), cv2.IMREAD_COLOR)
    context = road.context()
    at = context.pop("coarse_position")
    frame = with_gps(pixels, at["lon_deg"], at["lat_deg"])
    decode = post_frame(real_client, frame, context).json()
    assert road.error_m(decode["fix"]) < 0.08
    pose = decode["frames"][0]["pose"]
    assert (pose["source"], pose["accuracy_m"]) == ("exif", None)
    assert (pose["lon_deg"], pose["lat_deg"]) == pytest.approx((at["lon_deg"], at["lat_deg"]), abs=1e-9)
    declared = {**context, "coarse_position": {**at, "lat_deg": at["lat_deg"] + 1.0}}
    assert post_frame(real_client, frame, declared).json()["frames"][0]["pose"]["source"] == "context"


@pytest.mark.parametrize("more", [{"18": "Tokyo"}, {"1": "X"}, {"2": (0.0, 0.0, 0.0), "4": (0.0, 0.0, 0.0)}])
def test_a_position_that_is_none_is_not_used(real_client: httpx.Client, more: dict[str, object]) -> None:
    frame = with_gps(np.full((96, 96, 3), 90, np.uint8), 139.7, 35.6, **more)
    assert post_frame(real_client, frame, {}).json()["frames"][0]["pose"] is None


def test_a_road_without_plates_has_no_readings(real_client: httpx.Client, place: Place) -> None:
    road = Road(real_client, place()).register()
    decode = post_frame(real_client, road.frame([]), road.context()).json()
    assert decode["summary"]["plates_read"] == 0
    assert decode["summary"]["text"].startswith("no plate read")
    assert decode["fix"] is None


def test_a_drive_as_an_archive(real_client: httpx.Client, place: Place) -> None:
    road = Road(real_client, place(), (5.0, 0.4, 8.0)).register()
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for k in range(4):
            archive.writestr(f"{k}.jpg", road.frame(seed=k))
    answer = post_frame(real_client, out.getvalue(), road.context())
    assert answer.status_code == 202
    decode = wait_for(real_client, answer.headers["location"])
    assert decode["summary"]["plates_matched"] == 4
    assert all(road.error_m(frame["fix"]) < 0.08 for frame in decode["frames"])
    assert decode["fix"] is None  # each frame has its own
