"""The groups of the corpus, what is promised of each, and what is read now."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from app.decoders.fiducial import VERSION as FIDUCIALS
from app.decoders.magnet.decoder import VERSION as MAGNETS
from app.decoders.plate import DECODER_VERSION as PLATES
from benchmarks.corpus.counts import RECORDINGS, TRUTH, Count, Counts, Reader, read_truth
from benchmarks.corpus.drives import read_magnets, read_packet_logs
from benchmarks.corpus.frames import read_plate_frames, read_roads, read_signs, read_thermal_frames, read_video

MINIMA = Path(__file__).parent / "minima.json"
READERS: Mapping[str, Reader] = {
    "plates-thermal": read_thermal_frames, "plates-video": read_video, "plates": read_plate_frames,
    "magnets": read_magnets, "cerpm": read_packet_logs, "signs": read_signs, "roads": read_roads,
}  # fmt: skip
"""By the beginning of the group's name; the first that fits."""
VERSIONS = {"plates": PLATES, "magnets": MAGNETS, "signs": FIDUCIALS}
"""Of the decoders that have one, by the beginning of the groups' names."""


@dataclass(frozen=True, slots=True)
class Promise:
    """What one way of reading a group must keep."""

    least: int  # readings
    known_wrong: int = 0  # sure readings that are not true, known when the group was recorded and not cured since


def list_groups() -> list[str]:
    """Names of the groups, sorted."""
    return sorted(path.parent.name for path in RECORDINGS.glob(f"*/{TRUTH}"))


def read_group(name: str) -> Counts:
    """What is read in a group now, in each way."""
    reader = next(reader for start, reader in READERS.items() if name.startswith(start))
    folder = RECORDINGS / name
    return reader(folder, read_truth(folder))


def read_promises(minima: Path = MINIMA) -> dict[str, dict[str, Promise]]:
    """By group and way."""
    stored = json.loads(minima.read_text()) if minima.exists() else {}
    return {group: {way: Promise(*values) for way, values in ways.items()} for group, ways in stored.items()}


def broken(promise: Promise | None, count: Count) -> str:
    """What a count breaks of a promise; nothing if it keeps it."""
    if promise is None:
        return "nothing is promised: run `python -m benchmarks.corpus --raise`"
    if count.read < promise.least:
        return f"{count.read} of {count.possible} read, {promise.least} were promised"
    if len(count.wrong) > promise.known_wrong:
        return f"{len(count.wrong)} wrong, {promise.known_wrong} known: {'; '.join(count.wrong)}"
    return ""


def raise_promises(found: Mapping[str, Counts], minima: Path = MINIMA) -> None:
    """Raise each promise to what is read now; none is lowered, and no more wrong readings become known.

    Only a way of reading without a promise gets its first one, with the wrong readings that it has.
    """
    promises = read_promises(minima)
    for group, counts in found.items():
        ways = promises.setdefault(group, {})
        for way, count in counts.items():
            old = ways.get(way, Promise(count.read, len(count.wrong)))
            ways[way] = Promise(max(old.least, count.read), min(old.known_wrong, len(count.wrong)))
    rows = []
    for group in sorted(promises):
        ways_text = [f"  {json.dumps(way)}: [{p.least}, {p.known_wrong}]" for way, p in promises[group].items()]
        rows.append(f" {json.dumps(group)}: {{\n" + ",\n".join(ways_text) + "\n }")
    minima.write_text("{\n" + ",\n".join(rows) + "\n}\n")
