"""The demo from start to end: register, fetch artwork, drive, upload, compare."""

from __future__ import annotations

import csv
import json
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from app.demo.drive import FPS, LEAST_ROWS, SPEED_KMH, DemoFrame, DemoPlate, drive_over, list_plates, registered_code
from app.demo.server import LocalServer
from app.demo.table import Pass, draw_table
from app.errors import WaymarkError
from app.geodesy import enu_from_wgs84

_SEED = 7
_FORMATS = ("svg", "pdf", "dxf", "png")
_SHOWN_ROWS = 110.0  # the annotated picture is the frame whose plate is about so many rows high
Say = Callable[[str], None]


@dataclass(slots=True)
class _Shown:
    """The frame that becomes the annotated picture."""

    rows: float = 0.0
    decode_id: str = ""
    jpeg: bytes = b""
    context: dict[str, Any] | None = None

    def offer(self, frame: DemoFrame, decode_id: str) -> None:
        if abs(frame.rows - _SHOWN_ROWS) < abs(self.rows - _SHOWN_ROWS):
            self.rows, self.decode_id, self.jpeg, self.context = frame.rows, decode_id, frame.jpeg, frame.context


def run_demo(out: Path, *, say: Say, keep_serving: bool = False) -> bool:
    """Run the demo against a server of its own.

    Parameters
    ----------
    out : Path
        Folder for artwork, frames and results; created if need be.
    say : callable
        Prints a line.
    keep_serving : bool
        Leave the server running until it is interrupted.

    Returns
    -------
    bool
        Every plate was read, matched and gave a position, and nothing was read wrong.

    Raises
    ------
    WaymarkError
        The server did not start, or refused a request.
    """
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="waymark-demo-", ignore_cleanup_errors=True) as folder:
        say("Starting a server with an empty registry (the very first start compiles the decoder) ...")
        with LocalServer(Path(folder)) as server, server.client() as client:
            passes, written = _demonstrate(client, out, say)
            say("")
            say(draw_table(passes))
            say("")
            for line in _summary(passes, written, time.monotonic() - began):
                say(line)
            if keep_serving:
                say(f"\nThe server stays at {server.url}/ until you press Ctrl-C. Key: {server.key}")
                server.wait()
    return all(p.is_good for p in passes)


def _demonstrate(client: httpx.Client, out: Path, say: Say) -> tuple[list[Pass], list[str]]:
    rng = np.random.default_rng(_SEED)
    plates = list_plates(rng)
    markers = [_checked(client.post("/v1/markers", json=plate.body)).json() for plate in plates]
    say(f"Registered {len(markers)} plates, surveyed within 1 cm, on a lane in Karlsruhe at {client.base_url}")
    (out / "artwork").mkdir(parents=True, exist_ok=True)
    files = [_fetch_artwork(client, marker, out / "artwork") for marker in markers]
    bundle = _checked(client.post("/v1/artwork", json={"marker_ids": [m["id"] for m in markers], "formats": _FORMATS}))
    (out / "artwork.zip").write_bytes(bundle.content)
    say(f"Wrote the artwork; each plate was rendered and read back first: {bundle.headers['Waymark-Proof']}")
    say(f"Driving over them at {SPEED_KMH:g} km/h, {FPS:g} frames a second; uploading each frame ...")
    shown, passes = _Shown(), []
    rows: list[dict[str, Any]] = []
    for number, (plate, marker) in enumerate(zip(plates, markers, strict=True), 1):
        drive_rng = np.random.default_rng([_SEED, number])
        passes.append(_drive(client, f"{number}", plate, marker, drive_rng, shown, rows))
    return passes, [
        f"{sum(files)} files in {out / 'artwork'}/, and {out / 'artwork.zip'} with manifest and quality sheet",
        *_write_results(client, out, shown, rows),
    ]


def _fetch_artwork(client: httpx.Client, marker: dict[str, Any], folder: Path) -> int:
    """Download a plate's artwork in every format."""
    for form in _FORMATS:
        answer = _checked(client.get(f"/v1/markers/{marker['id']}/artwork.{form}"))
        if not answer.headers.get("Waymark-Proof", "").startswith("read-back "):
            raise WaymarkError("an artwork came without its proof")
        (folder / f"{marker['code']['digits']}.{form}").write_bytes(answer.content)
    return len(_FORMATS)


def _drive(
    client: httpx.Client,
    name: str,
    plate: DemoPlate,
    marker: dict[str, Any],
    rng: np.random.Generator,
    shown: _Shown,
    rows: list[dict[str, Any]],
) -> Pass:
    """Upload the frames of a pass over one plate and compare with the truth."""
    code = registered_code(marker)
    result = Pass(name, code.scheme, code.digits)
    with ThreadPoolExecutor(1) as uploads:  # the next frame is rendered while one is decoded
        sent = [(frame, uploads.submit(_upload, client, frame)) for frame in drive_over(plate.place, code, rng)]
    for number, (frame, answer) in enumerate(sent):
        decode = answer.result()
        read = [reading for reading in decode["readings"] if reading["outcome"] == "read"]
        right = [reading for reading in read if reading["digits"] == code.digits]
        result.in_view += 1
        result.decoded += bool(right)
        result.wrong += len(read) - len(right[:1])
        result.matched += any(reading["match"] and reading["match"]["marker_id"] == marker["id"] for reading in right)
        row = {"plate": code.digits, "frame": number, "rows": round(frame.rows, 1), "decoded": bool(right)}
        if fix := decode["fix"]:
            error_m = enu_from_wgs84(fix["lon_deg"], fix["lat_deg"], 0.0, (frame.lon_deg, frame.lat_deg, 0.0))[:2]
            result.position_errors_m.append(float(np.hypot(*error_m)))
            result.heading_errors_deg.append(abs((fix["heading_deg"] - frame.heading_deg + 180) % 360 - 180))
            row["position_error_cm"] = round(100 * result.position_errors_m[-1], 2)
            row["heading_error_deg"] = round(result.heading_errors_deg[-1], 3)
        if right:
            shown.offer(frame, decode["id"])
        rows.append(row)
    return result


def _upload(client: httpx.Client, frame: DemoFrame) -> dict[str, Any]:
    context = json.dumps(frame.context).encode()
    parts = {"file": ("frame.jpg", frame.jpeg, "image/jpeg"), "context": ("context", context, "application/json")}
    decode: dict[str, Any] = _checked(client.post("/v1/decodes", files=parts)).json()
    return decode


def _write_results(client: httpx.Client, out: Path, shown: _Shown, rows: list[dict[str, Any]]) -> list[str]:
    with (out / "frames.csv").open("w", newline="") as file:
        names = ("plate", "frame", "rows", "decoded", "position_error_cm", "heading_error_deg")
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        writer.writerows(rows)
    written = [f"every frame's result in {out / 'frames.csv'}"]
    if shown.decode_id:
        (out / "annotated.jpg").write_bytes(
            _checked(client.get(f"/v1/decodes/{shown.decode_id}/annotated.jpg")).content
        )
        (out / "frame.jpg").write_bytes(shown.jpeg)
        (out / "frame.json").write_text(json.dumps(shown.context, indent=2) + "\n")
        written.append(f"a frame as uploaded in {out / 'frame.jpg'}, its context in {out / 'frame.json'}")
        written.append(f"the same frame with what was read in it: {out / 'annotated.jpg'}")
    return written


def _summary(passes: list[Pass], written: list[str], seconds: float) -> list[str]:
    bad = [p.name for p in passes if not p.is_good]
    verdict = f"FAILED: plate {', '.join(bad)}" if bad else "All plates were read, matched and gave a position."
    return [
        f"In view: the whole plate is in the picture, {LEAST_ROWS:g} rows high or more. Frames are simulated before",
        "real road photos; the paper drove on a road. Errors: medians over the frames with a fix, survey included.",
        "",
        *(f"- {line}" for line in written),
        "",
        f"{verdict} {sum(p.in_view for p in passes)} frames, {seconds:.0f} s.",
    ]


def _checked(answer: httpx.Response) -> httpx.Response:
    if answer.is_error:
        raise WaymarkError(
            f"{answer.request.method} {answer.request.url.path} answered {answer.status_code}: {answer.text}"
        )
    return answer
