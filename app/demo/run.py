"""The demo from start to end: register markers, fetch artwork, simulate drives, upload them, compare the results."""

from __future__ import annotations

import csv
import json
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import httpx
import numpy as np

from app.demo.cerpms import INTERVAL_S, build_lane, drive_lane_and_judge, list_lane_drives
from app.demo.drive import FPS, MIN_ROWS, SPEED_KMH, DemoFrame, DemoPlate, drive_over, list_plates, registered_code
from app.demo.magnets import BOOK, LENGTH_M, build, drive_and_judge, list_drives
from app.demo.road_plan import FILES, PlanResult, describe_plan, describe_proof, draw_plan_table, plan_road, prove_road
from app.demo.server import LocalServer, checked
from app.demo.table import LaneResult, Pass, TraceResult, draw_lane_table, draw_table, draw_trace_table
from app.errors import WaymarkError
from app.geodesy import enu_from_wgs84
from app.sensors.pose_track import ReceivedPacket
from app.values import JsonObject

_SEED = 7
_FORMATS = ("svg", "pdf", "dxf", "png")
_SHOWN_ROWS = 110.0  # the annotated picture is the frame whose plate is about so many rows high
Say = Callable[[str], None]
_PLATE_NOTES = (
    f"In view: the whole plate is in the frame and at least {MIN_ROWS:g} rows high. Frames are simulated in front of",
    "real road photos; the paper drove on a road. Errors: medians over the frames with a fix, survey included.",
)
_MAGNET_NOTES = (
    "Magnets: decoded with the right polarity and orientation, of those under the bar. Wrong way: tags reported as",
    "passed against the legal direction. Ratio: measured over true distance ratio. Along, across: RMS error of the",
    "position at the tags, survey included. Dashed, solid: lane departures detected, of the actual ones. False:",
    "readings where there is no magnet. Fields are simulated. METRO drove on roads, over tags of three magnets: share",
    "of lying / upright magnets, share of tags, ratio as mean ± standard deviation.",
)
_LANE_NOTES = (
    "Accepted: authentic packets with a new sequence. Path, own track: RMS distance from the lane's true centre line.",
    "Steering: RMS distance of the front axle of a simulated car that follows the path, from the true centre line.",
    "Radio, drives and attacks are simulated. The paper drove on roads; its 0.42 m and 0.38 m (table 1) are labelled",
    "mean squared errors, in metres, and are not comparable.",
)
_PLAN_NOTES = (
    "Read: markers that were read of those that were passed; intervals are Wilson's of 95 %. Drives are simulated,",
    "with the encoders, simulations and decoders of the product.",
)


@dataclass(slots=True)
class _Shown:
    """The frame whose annotated picture is written."""

    rows: float = 0.0
    decode_id: str = ""
    jpeg: bytes = b""
    context: dict[str, object] | None = None

    def offer(self, frame: DemoFrame, decode_id: str) -> None:
        if abs(frame.rows - _SHOWN_ROWS) < abs(self.rows - _SHOWN_ROWS):
            self.rows, self.decode_id, self.jpeg, self.context = frame.rows, decode_id, frame.jpeg, frame.context


def run_demo(
    out: Path, *, say: Say, keep_serving: bool = False, host: str = "127.0.0.1", port: int | None = None
) -> bool:
    """Run the demo against a server of its own.

    Parameters
    ----------
    out : Path
        Folder for artwork, frames and results; created if it does not exist.
    say : callable
        Prints a line.
    keep_serving : bool
        Leave the server running until it is interrupted.
    host : str
        Address that the server listens on.
    port : int, optional
        Free port that the server listens at; without, any.

    Returns
    -------
    bool
        Whether every plate and every tag was decoded, matched and gave a position, the wrong way was reported, no
        reading was wrong, no forged packet was accepted, the paths follow the lane, and the plan passed its checks
        and its proof.

    Raises
    ------
    WaymarkError
        The server did not start, or refused a request.
    """
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="waymark-demo-", ignore_cleanup_errors=True) as folder:
        say("Starting a server with an empty registry (the first start compiles the decoders) ...")
        with LocalServer(Path(folder), host, port) as server, server.client() as client:
            passes, written = _demonstrate(client, out, say)
            say("")
            say(draw_table(passes))
            say("")
            for line in _PLATE_NOTES:
                say(line)
            say("")
            drives, more = _demonstrate_magnets(client, out, say)
            say("")
            say(draw_trace_table(drives))
            say("")
            for line in _MAGNET_NOTES:
                say(line)
            say("")
            lanes, most = _demonstrate_cerpms(client, out, say)
            say("")
            say(draw_lane_table(lanes))
            say("")
            for line in (*_LANE_NOTES, ""):
                say(line)
            made, last = _demonstrate_plan(client, out, say)
            for line in ("", *_PLAN_NOTES, "", *(f"- {line}" for line in written + more + most + last), ""):
                say(line)
            say(f"{_verdict(passes, drives, lanes, made)} {time.monotonic() - began:.0f} s.")
            if keep_serving:
                say(f"\nThe server keeps running at {server.url}/ until you press Ctrl-C. Key: {server.key}")
                server.wait()
    plates_and_magnets = all(p.is_good for p in passes) and all(d.is_good for d in drives)
    return plates_and_magnets and all(lane.is_good for lane in lanes) and made.is_good


def _demonstrate(client: httpx.Client, out: Path, say: Say) -> tuple[list[Pass], list[str]]:
    rng = np.random.default_rng(_SEED)
    plates = list_plates(rng)
    markers = [checked(client.post("/v1/markers", json=plate.body)).json() for plate in plates]
    say(f"Registered {len(markers)} plates, surveyed within 1 cm, on a lane in Karlsruhe at {client.base_url}")
    (out / "artwork").mkdir(parents=True, exist_ok=True)
    files = [_fetch_artwork(client, marker, out / "artwork") for marker in markers]
    bundle = checked(client.post("/v1/artwork", json={"marker_ids": [m["id"] for m in markers], "formats": _FORMATS}))
    (out / "artwork.zip").write_bytes(bundle.content)
    say(f"Wrote the artwork, after each plate was rendered and read back: {bundle.headers['Waymark-Proof']}")
    say(f"Simulating drives over them at {SPEED_KMH:g} km/h and {FPS:g} frames a second; uploading each frame ...")
    shown, passes = _Shown(), []
    rows: list[dict[str, object]] = []
    for number, (plate, marker) in enumerate(zip(plates, markers, strict=True), 1):
        drive_rng = np.random.default_rng([_SEED, number])
        passes.append(_drive(client, f"{number}", plate, marker, drive_rng, shown, rows))
    return passes, [
        f"artwork: {sum(files)} files in {out / 'artwork'}/, and {out / 'artwork.zip'} with manifest and quality sheet",
        *_write_results(client, out, shown, rows),
    ]


def _fetch_artwork(client: httpx.Client, marker: JsonObject, folder: Path) -> int:
    """Download a plate's artwork in every format."""
    for form in _FORMATS:
        answer = checked(client.get(f"/v1/markers/{marker['id']}/artwork.{form}"))
        if not answer.headers.get("Waymark-Proof", "").startswith("read-back "):
            raise WaymarkError("the server delivered artwork without a proof")
        (folder / f"{marker['code']['digits']}.{form}").write_bytes(answer.content)
    return len(_FORMATS)


def _drive(
    client: httpx.Client,
    name: str,
    plate: DemoPlate,
    marker: JsonObject,
    rng: np.random.Generator,
    shown: _Shown,
    rows: list[dict[str, object]],
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
        record = {"plate": code.digits, "frame": number, "rows": round(frame.rows, 1), "decoded": bool(right)}
        if fix := decode["fix"]:
            error_m = enu_from_wgs84(fix["lon_deg"], fix["lat_deg"], 0.0, (frame.lon_deg, frame.lat_deg, 0.0))[:2]
            result.position_errors_m.append(float(np.hypot(*error_m)))
            result.heading_errors_deg.append(abs((fix["heading_deg"] - frame.heading_deg + 180) % 360 - 180))
            record["position_error_cm"] = round(100 * result.position_errors_m[-1], 2)
            record["heading_error_deg"] = round(result.heading_errors_deg[-1], 3)
        if right:
            shown.offer(frame, decode["id"])
        rows.append(record)
    return result


def _upload(client: httpx.Client, frame: DemoFrame) -> JsonObject:
    context = json.dumps(frame.context).encode()
    parts = {"file": ("frame.jpg", frame.jpeg, "image/jpeg"), "context": ("context", context, "application/json")}
    decode: dict[str, object] = checked(client.post("/v1/decodes", files=parts)).json()
    return decode


def _write_results(client: httpx.Client, out: Path, shown: _Shown, rows: list[dict[str, object]]) -> list[str]:
    with (out / "frames.csv").open("w", newline="") as file:
        names = ("plate", "frame", "rows", "decoded", "position_error_cm", "heading_error_deg")
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        writer.writerows(rows)
    written = [f"the results of all frames: {out / 'frames.csv'}"]
    if shown.decode_id:
        (out / "annotated.jpg").write_bytes(checked(client.get(f"/v1/decodes/{shown.decode_id}/annotated.jpg")).content)
        (out / "frame.jpg").write_bytes(shown.jpeg)
        (out / "frame.json").write_text(json.dumps(shown.context, indent=2) + "\n")
        written.append(f"an uploaded frame: {out / 'frame.jpg'}, its context: {out / 'frame.json'}")
        written.append(f"the same frame with the decoded plates: {out / 'annotated.jpg'}")
    return written


def _demonstrate_magnets(client: httpx.Client, out: Path, say: Say) -> tuple[list[TraceResult], list[str]]:
    """Register magnets, drive over them, and keep what was uploaded and drawn of the first drive."""
    (out / "layouts").mkdir(parents=True, exist_ok=True)
    built = build(client, out / "layouts", np.random.default_rng([_SEED, 100]))
    say(f"Created a codebook of {len(BOOK['meanings'])} meanings; registered {len(built.tags)} tags and 2 lines on")
    say(f"{LENGTH_M:.0f} m of lane, wrote their drilling sheets, surveyed the tags within 1 cm:")
    for marker in built.tags:
        at_m, code = marker["layout"]["chainage_m"], marker["code"]
        say(f"  {at_m:3.0f} m  {code['text']}  {code['meaning']['text']}")
    say("Simulating drives over them; uploading each drive as the files of METRO's recorder ...")
    results = []
    for number, drive in enumerate(list_drives()):
        result, decode, recording, context = drive_and_judge(
            client, built, drive, np.random.default_rng([_SEED, 100, number])
        )
        say(f"  {drive.name}: {decode['summary']['text']}")
        results.append(result)
        if number == 0:
            (out / "drive.zip").write_bytes(recording)
            (out / "drive.json").write_text(json.dumps(context, indent=2) + "\n")
            (out / "trace.svg").write_bytes(checked(client.get(decode["links"]["plot"])).content)
    return results, [
        f"drilling sheets as pdf, csv and geojson: {out / 'layouts'}/",
        f"the {results[0].name} drive as uploaded: {out / 'drive.zip'}, its context: {out / 'drive.json'}",
        f"its magnetic field with the decoded magnets: {out / 'trace.svg'}",
    ]


def _demonstrate_cerpms(client: httpx.Client, out: Path, say: Say) -> tuple[list[LaneResult], list[str]]:
    """Register CERPMs, drive past them, and keep what was uploaded and drawn of the first drive."""
    folder = out / "cerpms"
    folder.mkdir(parents=True, exist_ok=True)
    built = build_lane(client, np.random.default_rng([_SEED, 200]))
    say(f"Registered {len(built.markers)} CERPMs on both sides of the lane in Karlsruhe, 40 ft apart, closer in")
    say("bends, surveyed within 2 cm per axis; wrote their programs.")
    (folder / "programs.csv").write_text(built.table)
    dump = checked(client.get(f"/v1/markers/{built.markers[0]['id']}/payload.hex")).text
    (folder / "payload.txt").write_text(dump)
    plan = {"radio": {"interval_s": INTERVAL_S}, "design_speed_m_s": 8.3, "recommend": True}
    check = checked(client.post("/v1/radio-checks", json=plan)).json()
    (folder / "radio-check.json").write_text(json.dumps(check, indent=2) + "\n")
    say(f"Radio check: at one transmission every {INTERVAL_S:g} s {check['read_probability']:.1%} of markers are read")
    say(f"{check['preview_m']:.0f} m ahead at 30 km/h. To reach 99 %: {check['recommendation']['sentence']}.")
    say("Radio and check follow the rules of the United States (47 CFR 15.247), which do not apply in Germany: under")
    say("EU868, the check recommends slots and polite spectrum access.")
    say("Simulating drives past them; uploading each drive as packets, poses and a camera frame ...")
    results: list[LaneResult] = []
    received: list[ReceivedPacket] = []
    for number, drive in enumerate(list_lane_drives()):
        rng = np.random.default_rng([_SEED, 200, number])
        result, decode, recording, context, received = drive_lane_and_judge(client, built, drive, number, received, rng)
        say(f"  {drive.name}: {decode['summary']['text']}")
        results.append(result)
        if number == 0:
            (folder / "drive.zip").write_bytes(recording)
            (folder / "drive.json").write_text(json.dumps(context, indent=2) + "\n")
            for name, link in (("lane.svg", "plot"), ("lane.geojson", "lane"), ("overlay.jpg", "overlay")):
                (folder / name).write_bytes(checked(client.get(decode["links"][link])).content)
    return results, [
        f"programs of the CERPMs: {folder / 'programs.csv'}, one message explained: {folder / 'payload.txt'}, "
        f"the radio check: {folder / 'radio-check.json'}",
        f"the {results[0].name} drive past them: {folder / 'drive.zip'}, its context: {folder / 'drive.json'}",
        f"its lane: {folder / 'lane.svg'} and {folder / 'lane.geojson'}, over the frame: {folder / 'overlay.jpg'}",
    ]


def _demonstrate_plan(client: httpx.Client, out: Path, say: Say) -> tuple[PlanResult, list[str]]:
    """Plan a road, and prove the plan."""
    folder = out / "plan"
    made = plan_road(client, folder)
    for line in describe_plan(made.plan):
        say(line)
    say("Proving it: simulated vehicles drive over the plan, a sample of its markers in each drive ...")
    prove_road(client, made, folder)
    for line in ("", draw_plan_table(made), "", *describe_proof(made)):
        say(line)
    names = ", ".join(FILES)
    return made, [f"the plan of the road: {names} and proof.json in {folder}/"]


def _verdict(passes: list[Pass], drives: list[TraceResult], lanes: list[LaneResult], made: PlanResult) -> str:
    failed = [f"plate {p.name}" for p in passes if not p.is_good]
    failed += [f"drive {drive.name}" for drive in drives if not drive.is_good]
    failed += [f"drive {lane.name}" for lane in lanes if not lane.is_good]
    failed += [] if made.is_good else ["plan"]
    if failed:
        return f"FAILED: {', '.join(failed)}."
    return (
        "All plates and tags were decoded, matched and gave a position; the paths follow the lane; the plan is proved."
    )
