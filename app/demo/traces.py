"""Drives over the demo's magnets: uploaded as the recorder's own files, decoded, compared with the truth."""

from __future__ import annotations

import io
import json
import time
import zipfile
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import httpx
import numpy as np

from app.demo.magnets import LENGTH_M, Built, Lane, TraceDrive
from app.demo.server import checked
from app.demo.table import TraceResult
from app.errors import Unavailable
from app.markers.magnet import LineTag, Orientation
from app.simulation.magnetic.drive import SimulatedDrive, TrueMagnet, simulate_drive
from app.simulation.magnetic.recorder import write_recorder_files

_UNDER_CM = 88.0  # a magnet farther off is beside the bar
_REACH_M = 0.4  # a reading so near to a magnet is of it
_EPISODE_S = 1.5  # between magnets of a line that are passed in one departure, and about it
_WAIT_S = 120.0


def drive_and_judge(
    client: httpx.Client, built: Built, drive: TraceDrive, rng: np.random.Generator
) -> tuple[TraceResult, dict[str, Any], bytes, dict[str, Any]]:
    """Drive over what is built.

    Returns
    -------
    result : TraceResult
    decode : dict
        The server's answer.
    recording : bytes
        ZIP of the recorder's files, as uploaded.
    context : dict
        Uploaded with it: a coarse position; the recorder knows no heading, and its files need no declaration.
    """
    scene, lane = built.scene(drive)
    simulated = simulate_drive(scene, rng)
    lon_deg, lat_deg = lane.lon_lat(0.0, float(rng.uniform(-5, 5)))
    coarse = {"lon_deg": lon_deg, "lat_deg": lat_deg, "accuracy_m": 15.0}
    context = {"coarse_position": coarse, "captured_at": "2026-06-01T08:00:00Z", "trace": {}}
    recording = _pack(simulated)
    decode = _upload(client, recording, context)
    return judge_drive(built, drive, lane, simulated, decode), decode, recording, context


def judge_drive(
    built: Built, drive: TraceDrive, lane: Lane, simulated: SimulatedDrive, decode: dict[str, Any]
) -> TraceResult:
    """The server's answer against what was simulated."""
    t_s = simulated.trace.t_s
    speed_kmh = 3.6 * LENGTH_M / float(t_s[-1] - t_s[0])
    result = TraceResult(drive.name, drive.clearance_m, speed_kmh, drive.wrong_way, len(built.tags))
    _judge_magnets(result, simulated, decode["magnets"])
    _judge_tags(result, built, lane, simulated, decode["tags"])
    for style in ("dashed", "solid"):
        result.departures[style] = _judge_departures(style, simulated.magnets, decode["crossings"])
    return result


def _pack(drive: SimulatedDrive) -> bytes:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, data in write_recorder_files(drive.trace).items():
            archive.writestr(name, data)
    return packed.getvalue()


def _upload(client: httpx.Client, recording: bytes, context: dict[str, Any]) -> dict[str, Any]:
    body = json.dumps(context).encode()
    parts = {"file": ("drive.zip", recording, "application/zip"), "context": ("context", body, "application/json")}
    decode: dict[str, Any] = checked(client.post("/v1/decodes", files=parts)).json()
    deadline = time.monotonic() + _WAIT_S
    while decode["state"] in ("queued", "running") and time.monotonic() < deadline:
        time.sleep(0.2)
        decode = checked(client.get(f"/v1/decodes/{decode['id']}")).json()
    if decode["state"] != "done":
        raise Unavailable(f"the decode of a drive is {decode['state']}: {decode['error']}")
    return decode


def _judge_magnets(result: TraceResult, drive: SimulatedDrive, readings: Sequence[dict[str, Any]]) -> None:
    """Assign the nearest reading to each magnet under the bar; others are false, except at magnets beside the bar."""
    left = list(readings)
    beside = [magnet for magnet in drive.magnets if abs(magnet.lateral_cm) > _UNDER_CM]
    for magnet in drive.magnets:
        if abs(magnet.lateral_cm) > _UNDER_CM:
            continue
        result.passed += 1
        if near := [r for r in left if _is_near(r, magnet)]:
            nearest = min(near, key=lambda r: abs(r["t_s"] - magnet.t_s))
            left.remove(nearest)
            kind = (str(magnet.polarity), int(magnet.orientation))
            result.found += (nearest["polarity"], nearest["phi_deg"]) == kind
    result.false = sum(not any(_is_near(r, magnet) for magnet in beside) for r in left)


def _is_near(reading: dict[str, Any], magnet: TrueMagnet) -> bool:
    off_m = abs(reading["t_s"] - magnet.t_s) * magnet.speed_m_s
    return off_m < _REACH_M and bool(abs(reading["lateral_cm"] - magnet.lateral_cm) < 100 * _REACH_M)


def _judge_tags(
    result: TraceResult, built: Built, lane: Lane, drive: SimulatedDrive, readings: Sequence[dict[str, Any]]
) -> None:
    markers = built.tags[::-1] if result.wrong_way else built.tags
    chainages_m = [tag.chainage_m for tag in drive.tags]
    claimed: list[dict[str, Any]] = []
    for number, (marker, placed, at) in enumerate(zip(markers, drive.tags, chainages_m, strict=True)):
        magnets = [magnet for magnet in drive.magnets if magnet.tag == number]
        near = [r for r in readings if abs(r["start_s"] - magnets[0].t_s) * magnets[0].speed_m_s < 1.0]
        if not near:
            continue
        claimed += near
        reading = near[0]
        right = reading["tag"] == marker["code"]["text"]
        result.right += right
        result.wrong += not right and reading["tag"] is not None
        result.flagged += reading["direction"] == "wrong-way"
        match = reading["match"]
        result.matched += right and match is not None and match["marker_id"] == marker["id"]
        if right and not reading["missing"]:
            result.deviations += [a / b for a, b in zip(reading["ratios"], placed.tag.ratios, strict=True)]
        if fix := reading["fix"]:
            last = magnets[-1]
            # where the bar truly is at the fix's time: level with the last magnet, but for the error of that time
            ahead_m, left_m = lane.off_m(fix["lon_deg"], fix["lat_deg"], at + placed.tag.length_m)
            result.along_m.append(ahead_m - (fix["t_s"] - last.t_s) * last.speed_m_s)
            result.across_m.append(left_m + last.lateral_cm / 100)
    result.wrong += sum(reading["tag"] is not None for reading in readings if reading not in claimed)


def _judge_departures(
    style: str, magnets: Sequence[TrueMagnet], crossings: Sequence[dict[str, Any]]
) -> tuple[int, int, int]:
    """True positives, actual departures, false positives."""
    under = [
        magnet
        for magnet in magnets
        if magnet.orientation is Orientation.UP
        and LineTag(magnet.polarity).style == style
        and abs(magnet.lateral_cm) <= _UNDER_CM
    ]
    starts = under[:1] + [b for a, b in pairwise(under) if b.t_s - a.t_s > _EPISODE_S]
    ends = [a for a, b in pairwise(under) if b.t_s - a.t_s > _EPISODE_S] + under[-1:]
    detected = [c for c in crossings if c["style"] == style]
    right = 0
    for start, end in zip(starts, ends, strict=True):
        side = "left" if start.lateral_cm >= 0 else "right"
        hits = [c for c in detected if c["side"] == side and start.t_s - _EPISODE_S < c["t_s"] < end.t_s + _EPISODE_S]
        right += bool(hits)
        if hits:
            detected.remove(hits[0])
    return right, len(starts), len(detected)
