"""Groups of recordings of drives: traces of bars over magnets, and logs of packets of raised markers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from app.decoders.cerpm.merge import MergedMarkers, RegisteredMarker, merge_markers
from app.decoders.cerpm.verify import verify_packets
from app.decoders.magnet.decoder import decode_trace
from app.decoders.magnet.identify import TagCandidates
from app.decoders.magnet.readings import Finding, MagnetReading, TagReading
from app.decoding.recordings import packet_strengths, read_drive_files
from app.formats.format import SpooledFile
from app.lanes.estimate import fit_lane
from app.markers.magnet import InformationTag, Orientation, Polarity, parse_tag
from app.sensors.magnetometer_bar import MagnetometerBar, MagnetTrace
from app.simulation.magnetic.drive import SimulatedDrive, TrueMagnet
from app.simulation.magnetic.recorder import Chip
from app.simulation.magnetic.road import PlacedTag
from app.simulation.radio.lanes import lane_from_wgs84
from benchmarks.cerpm.path_errors import MIN_CONFIDENCE, TOLERANCE_M, place_errors
from benchmarks.cerpm.scenes import key_of, markers_from_merged
from benchmarks.corpus.counts import Counts, Tally
from benchmarks.hunt.bars import lossy_trace
from benchmarks.magnets.drawn_scenes import FORMAT
from benchmarks.magnets.score import score_magnets, score_tags

SURE = 0.95
"""Confidence from which on a reading of a magnet or a tag that is not true counts as wrong."""
BAR = MagnetometerBar.metro(forward_m=3.2)
_COUNT_UT = np.array(Chip().count_ut)
_WRONG_M = 1.0  # [m] a sure path that is so far off is wrong, and so is the place of a marker

# === Magnets.


def write_trace(path: Path, trace: MagnetTrace) -> MagnetTrace:
    """Store a trace in counts of the chip and microseconds, and return it as it is read back."""
    counts = np.clip(
        np.round(trace.field_ut.astype(float) / _COUNT_UT), -(1 << 15), (1 << 15) - 1
    )  # chips have 16 bits
    delta = np.diff(counts, axis=0, prepend=0).astype(np.int32)
    stamps = np.diff(np.round(trace.t_s * 1e6), prepend=0).astype(np.int32)
    assert trace.heading_t_s is not None
    assert trace.heading_deg is not None
    np.savez_compressed(
        path, counts=np.moveaxis(delta, 0, 2).astype(np.int16 if np.abs(delta).max() < 32767 else np.int32),
        stamps=stamps, speed_t_s=trace.speed_t_s.astype(np.float32), speed_m_s=trace.speed_m_s.astype(np.float32),
        heading_t_s=trace.heading_t_s.astype(np.float32), heading_deg=trace.heading_deg.astype(np.float32),
    )  # fmt: skip
    return read_trace(path)


def read_trace(path: Path) -> MagnetTrace:
    """A stored trace."""
    with np.load(path) as stored:
        counts = np.cumsum(np.moveaxis(stored["counts"].astype(np.int64), 2, 0), axis=0)
        series = [stored[name].astype(float) for name in ("speed_t_s", "speed_m_s", "heading_t_s", "heading_deg")]
        return MagnetTrace(np.cumsum(stored["stamps"]) / 1e6, (counts * _COUNT_UT).astype(np.float32), *series)


def magnets_row(drive: SimulatedDrive) -> dict[str, Any]:
    """What is true of a drive over magnets."""
    return {
        "magnets": [
            [round(m.t_s, 4), round(m.lateral_cm, 2), str(m.polarity), int(m.orientation), m.tag,
             round(m.speed_m_s, 3), round(m.clearance_m, 4)]
            for m in drive.magnets
        ],
        "tags": [[placed.tag.text, placed.chainage_m, placed.left_m] for placed in drive.tags],
        "length_m": round(drive.length_m, 2),
    }  # fmt: skip


def _drive(row: Mapping[str, Any], trace: MagnetTrace) -> SimulatedDrive:
    magnets = tuple(
        TrueMagnet(t, lateral, Polarity(polarity), Orientation(orientation), tag, speed, clearance)
        for t, lateral, polarity, orientation, tag, speed, clearance in row["magnets"]
    )
    tags = tuple(PlacedTag(_tag(text), chainage, left) for text, chainage, left in row["tags"])
    return SimulatedDrive(trace, magnets, tags, row["length_m"])


def _tag(text: str) -> InformationTag:
    tag = parse_tag(text)
    assert isinstance(tag, InformationTag)
    return tag


def read_magnets(folder: Path, truth: Sequence[Any]) -> Counts:
    """Magnets and tags, with nothing declared, with the clearance, with registered tags, and without some samples."""
    tally = Tally()
    for row in truth:
        drive = _drive(row, read_trace(folder / row["file"]))
        formats, registered = TagCandidates(formats=[FORMAT]), [placed.tag for placed in drive.tags]
        clearance_m = float(np.median([m.clearance_m for m in drive.magnets])) if drive.magnets else None
        _count(tally, "nothing declared", row, drive, decode_trace(drive.trace, BAR, candidates=formats))
        declared = replace(BAR, clearance_m=clearance_m)
        _count(tally, "clearance declared", row, drive, decode_trace(drive.trace, declared, candidates=formats))
        lossy = lossy_trace(drive.trace, 0.05, np.random.default_rng(5))
        _count(tally, "without 5 % of the samples", row, drive, decode_trace(lossy, BAR, candidates=formats))
        if registered:
            known = decode_trace(drive.trace, BAR, candidates=TagCandidates(tags=registered))
            _count(tally, "tags registered", row, drive, known)
    return tally.counts


def _count(tally: Tally, way: str, row: Mapping[str, Any], drive: SimulatedDrive, findings: Sequence[Finding]) -> None:
    sure = [f for f in findings if not isinstance(f, MagnetReading | TagReading) or f.confidence >= SURE]
    magnets, claimed = score_magnets(drive, findings), score_magnets(drive, sure)
    wrong = [f"{row['file']}: {claimed.wrong} magnets of another kind"] * bool(claimed.wrong)
    wrong += [f"{row['file']}: {claimed.extra} magnets where none is"] * bool(claimed.extra)
    tally.add(f"magnets, {way}", magnets.true, magnets.found, wrong)
    if drive.tags:
        tags, claims = score_tags(drive, findings), score_tags(drive, sure)
        wrong = [f"{row['file']}: {claims.wrong} other tags"] * bool(claims.wrong)
        tally.add(f"tags, {way}", tags.true, tags.right, wrong)


# === Raised markers that send packets.


def read_packet_logs(folder: Path, truth: Sequence[Any]) -> Counts:
    """Markers that are verified, and tens of metres of the path through them that are within 25 cm."""
    tally = Tally()
    for row in truth:
        files = read_drive_files(row["file"], SpooledFile.at(folder / row["file"]))
        lane = lane_from_wgs84(row["left_deg"], row["right_deg"])
        places = {int(number): place for number, place in row["markers"].items()}
        verification = verify_packets(files.packets, {number: key_of(number) for number in places})
        merged = merge_markers(verification.packets, {}, files.track)
        right, _ = _compare_places(row["file"], merged, places)
        tally.add("markers", row["heard"], right)  # one that sends another place is found by its registration alone
        registered = {number: RegisteredMarker(lon, lat, sigma_m=0.02) for number, (lon, lat) in places.items()}
        known = merge_markers(verification.packets, registered, files.track)
        right, wrong = _compare_places(row["file"], known, places)
        tally.add("markers, with the registry", row["heard"], right, wrong)
        for way, track in (("with the track", files.track), ("packets alone", None)):
            path = fit_lane(markers_from_merged(merged), track, strengths=packet_strengths(verification))
            found = place_errors(lane, path, *row["span_m"])
            possible = int((row["span_m"][1] - row["span_m"][0]) / 10)
            if found is None:
                tally.add(f"path by 10 m, {way}", possible, 0)
                continue
            sure = found.confidence >= MIN_CONFIDENCE
            good_m = 0.25 * float((sure & (found.off_m <= TOLERANCE_M)).sum())
            bad_m = 0.25 * float((sure & (found.off_m > _WRONG_M)).sum())
            wrong = [f"{row['file']}: {bad_m:.0f} m of path"] * (bad_m >= 1)
            tally.add(f"path by 10 m, {way}", possible, min(int(good_m / 10), possible), wrong)
    return tally.counts


def _compare_places(
    name: str, merged: MergedMarkers, places: Mapping[int, tuple[float, float]]
) -> tuple[int, list[str]]:
    """Markers that are where they stand, and those that are not."""
    right, wrong = 0, []
    for number, lon, lat in zip(merged.number.tolist(), merged.lon_deg, merged.lat_deg, strict=True):
        true = places[number]
        off_m = 111_195 * math.hypot((lon - true[0]) * math.cos(math.radians(lat)), lat - true[1])
        right += off_m < _WRONG_M
        wrong += [f"{name}: marker {number} is {off_m:.1f} m off"] * (off_m >= _WRONG_M)
    return right, wrong
