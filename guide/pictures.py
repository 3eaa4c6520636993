"""``python -m guide.pictures [NAME...]``: make the pictures of the tutorials in docs/images/tutorials.

`SHOTS` lists them: an address of a local server or a file that was made before, the size of the window, and what to
wait for. A new picture is one entry there. Needs Chromium and Poppler. The photos are simulated, as those of the demo.
"""

from __future__ import annotations

import argparse
import io
import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import httpx
import numpy as np
from PIL import Image, ImageChops

from app.decoders.plate.reader import decode_plates
from app.demo.drive import drive_over, list_plates
from app.demo.server import LocalServer
from app.markers.plate import PlateCode, PlateGeometry
from app.simulation.plate_face import PlateLook
from benchmarks.scenes.printed_plate import PrintFaults, Stain, photograph_print, printed_face
from guide.build import ROOT, build_guide
from tests.browser import Browser
from tests.tours import read_blocks

IMAGES = ROOT / "docs" / "images" / "tutorials"
MAX_BYTES = 150_000
"""Largest picture."""
REGISTRY_NUMBER = 0xC0FFEE42
"""Of the plate that the fabricator's tutorial makes."""
_FRAME_SEED = 3  # the drive of docs/images/frame.jpg, which benchmarks/pictures.py made
_FRAME_CODE = PlateCode("415919005230")
_STAINED_ROWS = 54.0
_STAIN_BGR = (38, 42, 46)
_COLOURS = 128
_MARGIN_PX = 12


@dataclass(frozen=True)
class Shot:
    """A picture of a page.

    Parameters
    ----------
    name : str
        Of the file, without its suffix.
    address : str
        Path on the server, or, with `file:`, a file in the folder that `_make_files` fills.
    size : tuple of int
        Width and height of the window. [px]
    until : str
        Expression that becomes true in the page when there is something to see.
    click : str, optional
        Selector of what is clicked then.
    """

    name: str
    address: str
    size: tuple[int, int]
    until: str = "true"
    click: str | None = None


_LOADED = "[...document.images].every((image) => image.complete && image.naturalWidth > 0)"
SHOTS = (
    Shot("api-docs", "/docs", (1000, 640), "document.querySelectorAll('.opblock').length > 50"),
    Shot("guide-search", "/guide/search.html?q=backup", (1100, 640),
         "document.querySelectorAll('#search-results li p.context').length > 4"),
    Shot("plate-artwork", "file:artwork.html", (640, 760), _LOADED),
    Shot("plan-strip", "file:strip.html", (1250, 900), _LOADED),
    Shot("print-grade", "file:grade.html", (800, 1100), _LOADED),
    Shot("stained-plate", "file:stained.html", (640, 300), _LOADED),
    Shot("trace", "file:trace.html", (1000, 620), _LOADED),
    Shot("lane", "file:lane.html", (1000, 620), _LOADED),
)  # fmt: skip


def main() -> int:
    """Make all pictures, or those that are named."""
    parser = argparse.ArgumentParser(prog="python -m guide.pictures", description=__doc__)
    names = [shot.name for shot in SHOTS]
    parser.add_argument("name", nargs="*", metavar="NAME", help=f"one of {', '.join(names)}; default: all, and photos")
    wanted = parser.parse_args().name
    if unknown := set(wanted) - set(names):
        parser.error(f"there is no picture {', '.join(sorted(unknown))}")
    chromium, poppler = shutil.which("chromium"), shutil.which("pdftoppm")
    if chromium is None or poppler is None:
        print("Chromium and pdftoppm are needed", file=sys.stderr)
        return 1
    IMAGES.mkdir(parents=True, exist_ok=True)
    if not wanted:
        (IMAGES / "print.jpg").write_bytes(printed_photo())
        (IMAGES / "stained.jpg").write_bytes(stained_frame())
        if not (ROOT / "build" / "guide").exists():
            build_guide(ROOT / "build" / "guide")
    with tempfile.TemporaryDirectory() as name, LocalServer(Path(name)) as server, server.client() as client:
        folder = Path(name)
        _make_files(folder, client, poppler)
        with Browser(chromium, folder / "profile") as browser:
            for shot in SHOTS:
                if not wanted or shot.name in wanted:
                    _write(shot, browser, server.url, folder)
    return 0


def _write(shot: Shot, browser: Browser, url: str, folder: Path) -> None:
    browser.resize(*shot.size)
    local = shot.address.startswith("file:")
    browser.open((folder / shot.address[5:]).as_uri() if local else f"{url}{shot.address}")
    browser.until(shot.until)
    if shot.click is not None:
        browser.click(shot.click)
    path = IMAGES / f"{shot.name}.png"
    path.write_bytes(small_png(browser.screenshot(), trim=local))
    print(f"{path.relative_to(ROOT)}: {path.stat().st_size} bytes")


def small_png(png: bytes, *, trim: bool = False) -> bytes:
    """A picture with a palette, which is a quarter as large, and with `trim` without its white margins.

    Raises
    ------
    ValueError
        It is larger than `MAX_BYTES` even so.
    """
    out = io.BytesIO()
    image = Image.open(io.BytesIO(png)).convert("RGB")
    if trim:
        drawn = ImageChops.difference(image, Image.new("RGB", image.size, "white")).getbbox()
        assert drawn is not None, "nothing is drawn"
        left, top, right, bottom = drawn
        image = image.crop((max(0, left - _MARGIN_PX), max(0, top - _MARGIN_PX),
                            min(image.width, right + _MARGIN_PX), min(image.height, bottom + _MARGIN_PX)))  # fmt: skip
    image.quantize(_COLOURS, dither=Image.Dither.NONE).save(out, "PNG", optimize=True)
    if out.tell() > MAX_BYTES:
        raise ValueError(f"{out.tell()} bytes, more than {MAX_BYTES}: take a smaller window")
    return out.getvalue()


# --- what the tutorials upload --------------------------------------------------------------------------------------


def printed_photo() -> bytes:
    """A photo of the fabricator's plate: dark grey in place of black, and a stain."""
    look, stain = PlateLook(dark=(0.22, 0.22, 0.22)), Stain(60.0, 20.0, 14.0)
    face = printed_face(
        PlateCode.from_registry_number(REGISTRY_NUMBER), PlateGeometry(), look, PrintFaults(stains=(stain,))
    )  # fmt: skip
    rng = np.random.default_rng(1)
    return photograph_print(face, rng, side_px=560.0, size_px=(1100, 825), tilt_deg=6.0, turn_deg=12.0)


def stained_frame() -> bytes:
    """A frame of the drive of docs/images/frame.jpg, with a stain over some units of the plate."""
    place = list_plates(np.random.default_rng(_FRAME_SEED))[0].place
    frames = drive_over(place, _FRAME_CODE, np.random.default_rng(_FRAME_SEED))
    frame = min(frames, key=lambda frame: abs(frame.rows - _STAINED_ROWS))
    (IMAGES / "stained.json").write_text(json.dumps(frame.context, indent=2) + "\n")
    pixels = cv2.imdecode(np.frombuffer(frame.jpeg, np.uint8), cv2.IMREAD_COLOR)
    (reading,) = decode_plates(pixels)
    side = 400  # of a picture of the plate alone, in which the stain is drawn
    stain = np.zeros((side, side), np.float32)
    cv2.ellipse(stain, (220, 160), (48, 38), 20.0, 0.0, 360.0, 1.0, -1)
    square = np.array([[0, 0], [side, 0], [side, side], [0, side]], np.float32)
    frame_from_plate = cv2.getPerspectiveTransform(square, reading.corners_px.astype(np.float32))
    size = (pixels.shape[1], pixels.shape[0])
    share = cv2.warpPerspective(cv2.GaussianBlur(stain, (0, 0), 6.0), frame_from_plate, size)[..., None]
    stained = (pixels * (1.0 - share) + np.array(_STAIN_BGR, np.float32) * share).astype(np.uint8)
    return bytes(cv2.imencode(".jpg", stained, [cv2.IMWRITE_JPEG_QUALITY, 62])[1])


# --- what is shown --------------------------------------------------------------------------------------------------


def _make_files(folder: Path, client: httpx.Client, poppler: str) -> None:
    """Drawings and plots as files, each with a page that shows it alone."""
    makers: dict[str, Callable[[], tuple[str, bytes]]] = {
        "artwork": lambda: ("svg", _artwork(client)),
        "strip": lambda: ("png", _strip(folder, poppler)),
        "grade": lambda: ("png", _grade(client, folder, poppler)),
        "stained": lambda: ("png", _stained_plate()),
        "trace": lambda: ("svg", _plot(client, "drive.zip", {"trace": {}, "captured_at": "2026-06-01T08:00:00Z"})),
        "lane": lambda: ("svg", _plot(client, "packets.csv", {"packets": {"accept_clear": True}})),
    }
    for name, make in makers.items():
        suffix, content = make()
        (folder / f"{name}.{suffix}").write_bytes(content)
        (folder / f"{name}.html").write_text(
            "<!doctype html><style>body { margin: 0; background: white } img { width: 100vw; height: 100vh; "
            f'object-fit: contain; object-position: top left }}</style><img src="{name}.{suffix}">'
        )


def _artwork(client: httpx.Client) -> bytes:
    place = {"lon_deg": 8.415919185, "lat_deg": 49.005230363}
    body = {"position": place, "code": {"scheme": "id", "registry_number": REGISTRY_NUMBER}}
    marker = client.post("/v1/markers", json=body).raise_for_status().json()
    return client.get(f"/v1/markers/{marker['id']}/artwork.svg").raise_for_status().content


def _stained_plate() -> bytes:
    """The surroundings of the plate in the stained frame."""
    pixels = cv2.imread(str(IMAGES / "stained.jpg"))
    corners_px = decode_plates(pixels, codebook=[_FRAME_CODE])[0].corners_px
    (left, top), (right, bottom) = corners_px.min(axis=0).astype(int), corners_px.max(axis=0).astype(int)
    margin = (right - left) // 3
    cut = pixels[max(0, top - margin) : bottom + margin, max(0, left - margin) : right + margin]
    return bytes(cv2.imencode(".png", cv2.resize(cut, None, fx=3, fy=3, interpolation=cv2.INTER_CUBIC))[1])


def _plot(client: httpx.Client, name: str, context: dict[str, object]) -> bytes:
    parts = {"file": (name, (ROOT / "docs" / "images" / name).read_bytes()), "context": ("c", json.dumps(context))}
    decode = client.post("/v1/decodes", files=parts).raise_for_status().json()
    return client.get(decode["links"]["plot"]).raise_for_status().content


def _grade(client: httpx.Client, folder: Path, poppler: str) -> bytes:
    parts = {
        "photo": ("print.jpg", (IMAGES / "print.jpg").read_bytes(), "image/jpeg"),
        "declaration": ("d", json.dumps({"code": {"digits": PlateCode.from_registry_number(REGISTRY_NUMBER).digits}})),
    }
    page = client.post("/v1/print-grades?format=pdf", files=parts).raise_for_status().content
    return _page_of(page, 1, 90, folder, poppler)


def _strip(folder: Path, poppler: str) -> bytes:
    """The first strip of the planner's tutorial: its road and its rules are those that the tutorial writes."""
    files = [commands for commands, _ in read_blocks((ROOT / "docs/tutorials/planner.md").read_text())][:2]
    subprocess.run(["bash", "-euc", "\n".join(files)], cwd=folder, check=True)
    command = [
        sys.executable, "-c", "from app.cli import main; main()", "plan", str(folder / "road.geojson"),
        "--rules", str(folder / "rules.yaml"), "--out", str(folder / "plan"),
    ]  # fmt: skip
    subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
    return _page_of((folder / "plan" / "drawings.pdf").read_bytes(), 2, 110, folder, poppler)


def _page_of(pdf: bytes, number: int, dpi: int, folder: Path, poppler: str) -> bytes:
    (folder / "page.pdf").write_bytes(pdf)
    options = ["-r", str(dpi), "-f", str(number), "-l", str(number), "-singlefile", "-png"]
    subprocess.run([poppler, *options, str(folder / "page.pdf"), str(folder / "page")], check=True)
    return (folder / "page.png").read_bytes()


if __name__ == "__main__":
    raise SystemExit(main())
