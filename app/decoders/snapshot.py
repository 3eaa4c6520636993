"""A signed snapshot -> what the decoders hold readings against, on board, without a connection.

Of the parts of Waymark this needs the definitions in `app.markers` and what the decoders take; no store, no network, no
clock. `open_snapshot` verifies before it reads, and refuses by a named error whatever it cannot vouch for.
"""

from __future__ import annotations

import fcntl
import math
import os
import uuid
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import cached_property
from pathlib import Path
from typing import Any, SupportsInt

import numpy as np
import numpy.typing as npt
import orjson
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
from pyproj import Geod

from app.decoders.cerpm.merge import KnownCerpms, RegisteredMarker
from app.decoders.cerpm.verify import SequenceSpan
from app.decoders.magnet.identify import RegisteredTag, TagCandidates, TagFormat, tag_candidates
from app.errors import UnreadableUpload
from app.geodesy import LocalizationGrade, grade_accuracy
from app.markers import snapshot as layout
from app.markers.cerpm import LaneSide
from app.markers.magnet import InformationTag, parse_tag
from app.markers.magnet_design import Codebook, Meaning
from app.markers.plate import PlateCode, PlateGeometry, PlateScheme
from app.markers.reading import STATUSES, position_warnings
from app.markers.snapshot import Trust
from app.values import JsonObject

_GEOD = Geod(ellps="WGS84")
_M_PER_DEG = 110_574.0  # [m] least length of a degree of latitude; source: WGS 84 at the equator
_CLOCK_SLACK = timedelta(minutes=10)  # that a vehicle's clock may be slow
_KM_H = {"km/h": 1.0, "mph": 1.609344}
_Columns = JsonObject  # arrays or values, by the names of `app.markers.snapshot.COLUMNS`
_CURE = "fetch the snapshot again"


@dataclass(frozen=True, slots=True)
class SnapshotMarker:
    """A marker of a snapshot."""

    # `marker_id`, `family`, `status`, `code`: the code is digits of a plate, text of a tag, or number of a CERPM
    marker_id: str
    family: str
    status: str
    code: str
    # `lon_deg`, `lat_deg`: [deg] WGS 84 / ITRF
    lon_deg: float
    lat_deg: float
    height_m: float | None
    heading_deg: float | None
    horizontal_rmse_m: float | None
    vertical_rmse_m: float | None
    heading_rmse_deg: float | None
    ellipsoidal: bool  # the height is above the ellipsoid
    exact: bool  # fit for localization by its survey and its reference frame
    kind: JsonObject  # what it has in common with others: scheme and geometry, or side and speed limit
    distance_m: float  # [m] from the place it was looked for
    # [deg] longitude and latitude of where the lane of an information tag begins
    lane_start_deg: tuple[float, float] | None = None
    earlier_spans: SequenceSpan | None = None  # first and last transmission of a CERPM that the server accepted

    @property
    def plate_code(self) -> PlateCode:
        """Code of a plate."""
        return PlateCode(self.code, PlateScheme(self.kind["scheme"]), self.kind["n"], self.kind["check_digits"] or 1)

    @property
    def plate_geometry(self) -> PlateGeometry:
        """Dimensions of a plate."""
        return PlateGeometry(self.kind["n"], self.kind["unit_mm"], self.kind["gap_mm"], self.kind["thickness_mm"])

    @property
    def grade(self) -> LocalizationGrade:
        """What its position is fit for."""
        return grade_accuracy(self.horizontal_rmse_m if self.exact else None)

    def localization_warnings(self, what: str) -> tuple[str, ...]:
        """What makes its position unfit for localization; `what` is what it is called."""
        note = self.kind.get("transform_note")
        return tuple(position_warnings(what, grade=self.grade, transform_note=note, status=self.status))


class Snapshot:
    """The markers of an area, verified. `open_snapshot` makes one."""

    def __init__(
        self, header: np.void, columns: _Columns, kinds: list[JsonObject], codes: bytes, books: list[Any]
    ) -> None:
        self.version = int(header["version"])
        self.made_at_ms = int(header["made_at_ms"])
        self.expires_at_s = int(header["expires_at_s"])
        self.agency_id = str(uuid.UUID(bytes=bytes(header["agency_id"])))
        self.area_deg = tuple(float(header[name]) for name in ("west_deg", "south_deg", "east_deg", "north_deg"))
        self._books = books
        self._columns = columns
        self._kinds = kinds
        self._codes = codes
        self._ends = np.cumsum(columns["code_bytes"], dtype=np.int64)
        self._lon_deg = columns["lon_step"] * layout.DEGREE_STEP
        self._lat_deg = columns["lat_step"] * layout.DEGREE_STEP
        self._stands = columns["status"] != STATUSES.index(layout.RETIRED)
        self._family = np.array([kind["family"] for kind in kinds] or [""])[columns["kind"]]

    def __len__(self) -> int:
        """Markers that may be on the road."""
        return int(np.count_nonzero(self._stands))

    @cached_property
    def codebooks(self) -> tuple[Codebook, ...]:
        """The agency's codebooks: what tags look like, and what their codes mean."""
        return tuple(Codebook.from_document(book) for book in self._books)

    def summary(self) -> dict[str, object]:
        """What it holds, as plain values: whose, where, from when to when, and how many of what."""
        families = {name: self._family == name for name in sorted({kind["family"] for kind in self._kinds})}
        heard = self._columns["flags"] & layout.HEARD_FLAG != 0
        return {
            "version": self.version,
            "agency_id": self.agency_id,
            "made_at": datetime.fromtimestamp(self.made_at_ms / 1000, UTC),
            "expires_at": datetime.fromtimestamp(self.expires_at_s, UTC),
            "bbox_deg": self.area_deg,
            "markers": {name: int(np.count_nonzero(mine & self._stands)) for name, mine in families.items()},
            "retired_cerpms": int(np.count_nonzero(~self._stands)),
            "heard_cerpms": int(np.count_nonzero(heard)),
            "codebooks": [{"name": book.name, "entries": len(book.entries)} for book in self.codebooks],
        }

    def covers(self, lon_deg: float, lat_deg: float) -> bool:
        """Whether a place is in the snapshot's area: outside of it, that no marker is near means nothing."""
        west, south, east, north = self.area_deg
        inside = west <= lon_deg <= east if west <= east else lon_deg >= west or lon_deg <= east
        return inside and south <= lat_deg <= north

    def near(self, family: str, lon_deg: float, lat_deg: float, reach_m: float) -> list[SnapshotMarker]:
        """Markers of a family within a distance, nearest first."""
        reach_deg = reach_m / _M_PER_DEG * 1.001
        across_deg = reach_deg / max(math.cos(math.radians(min(abs(lat_deg) + reach_deg, 89.9))), 1e-3)
        off_deg = np.abs((self._lon_deg - lon_deg + 180.0) % 360.0 - 180.0)
        proposed = np.flatnonzero(
            self._stands
            & (self._family == family)
            & (np.abs(self._lat_deg - lat_deg) <= reach_deg)
            & (off_deg <= across_deg)
        )
        return [marker for marker in self._markers(proposed, lon_deg, lat_deg) if marker.distance_m <= reach_m]

    def plate_codebook(self, lon_deg: float, lat_deg: float, reach_m: float) -> tuple[PlateCode, ...]:
        """Codes for `decode_plates(..., codebook=)`."""
        return tuple(dict.fromkeys(marker.plate_code for marker in self.near("plate", lon_deg, lat_deg, reach_m)))

    def plate_geometries(self, lon_deg: float, lat_deg: float, reach_m: float) -> tuple[PlateGeometry, ...]:
        """Dimensions for `decode_plates(..., geometries=)`."""
        return tuple(dict.fromkeys(marker.plate_geometry for marker in self.near("plate", lon_deg, lat_deg, reach_m)))

    def match_plate(self, code: PlateCode, lon_deg: float, lat_deg: float, reach_m: float) -> SnapshotMarker | None:
        """The nearest plate with these digits within reach."""
        found = self.near("plate", lon_deg, lat_deg, reach_m)
        return next((m for m in found if m.code == code.digits and m.kind["n"] == code.n), None)

    def tags(self, lon_deg: float, lat_deg: float, reach_m: float) -> tuple[InformationTag, ...]:
        """Designs for `TagCandidates` and `decode_trace`."""
        return tuple(dict.fromkeys(tag.tag for tag in self.registered_tags(lon_deg, lat_deg, reach_m)))

    def registered_tags(self, lon_deg: float, lat_deg: float, reach_m: float) -> tuple[RegisteredTag, ...]:
        """What `match_tags` holds a trace against, within a distance, in the order of the markers' ids."""
        found = (_registered_tag(marker) for marker in self.near("magnet", lon_deg, lat_deg, reach_m))
        return tuple(sorted((tag for tag in found if tag is not None), key=lambda tag: tag.marker_id))

    def tag_candidates(self, lon_deg: float, lat_deg: float, reach_m: float) -> TagCandidates:
        """What `decode_trace` looks for: the tags within a distance; without any, the codebooks' formats."""
        designs = (book.design for book in self.codebooks)
        formats = (TagFormat(design.magnets, design.length_m, design.segment_m) for design in designs)
        return tag_candidates(self.registered_tags(lon_deg, lat_deg, reach_m), formats)

    def registered_cerpms(self, lon_deg: float, lat_deg: float, reach_m: float) -> dict[int, RegisteredMarker]:
        """What `merge_markers` holds packets against, by number, within a distance."""
        return {int(marker.code): _registered(marker) for marker in self.near("cerpm", lon_deg, lat_deg, reach_m)}

    def known_cerpms(self, numbers: Iterable[int]) -> KnownCerpms:
        """What `match_known_markers` takes, of the markers with these numbers wherever they are."""
        wanted = list(numbers)
        rows = [(number, self._cerpm_rows[number]) for number in wanted if number in self._cerpm_rows]
        markers = {number: self._marker(row, math.nan) for number, row in rows}
        intervals = {number: marker.kind.get("min_interval_s") for number, marker in markers.items()}
        return KnownCerpms(
            {number: _registered(marker) for number, marker in markers.items()},
            {n: [marker.earlier_spans] for n, marker in markers.items() if marker.earlier_spans is not None},
            {number: interval for number, interval in intervals.items() if interval is not None},
            {number: marker.localization_warnings("marker") for number, marker in markers.items()},
            frozenset(number for number, marker in markers.items() if marker.status == layout.RETIRED),
        )

    @cached_property
    def _cerpm_rows(self) -> dict[int, int]:
        """Rows of the CERPMs by their numbers."""
        rows = np.flatnonzero(self._family == "cerpm")
        ends = self._ends[rows]
        starts = ends - self._columns["code_bytes"][rows]
        places = zip(rows.tolist(), starts.tolist(), ends.tolist(), strict=True)
        return {int(self._codes[start:end]): row for row, start, end in places}

    def _markers(self, rows: npt.NDArray[np.intp], lon_deg: float, lat_deg: float) -> list[SnapshotMarker]:
        lons, lats = self._lon_deg[rows], self._lat_deg[rows]
        distance_m = _GEOD.inv(np.full(len(rows), lon_deg), np.full(len(rows), lat_deg), lons, lats)[2]
        made = [self._marker(int(row), float(m)) for row, m in zip(rows, distance_m, strict=True)]
        return sorted(made, key=lambda marker: (marker.distance_m, marker.marker_id))

    def _marker(self, row: int, distance_m: float) -> SnapshotMarker:
        column = {name: self._columns[name][row] for name, _form in layout.COLUMNS}
        end, kind = int(self._ends[row]), self._kinds[int(column["kind"])]
        height, heading = int(column["height_mm"]), int(column["heading_step"])
        return SnapshotMarker(
            marker_id=str(uuid.UUID(bytes=bytes(column["id"]))),
            family=kind["family"],
            status=STATUSES[int(column["status"])],
            code=self._codes[end - int(column["code_bytes"]) : end].decode(),
            lon_deg=round(float(self._lon_deg[row]), 9),
            lat_deg=round(float(self._lat_deg[row]), 9),
            height_m=None if height == layout.NO_HEIGHT else height / 1000,
            heading_deg=None if heading == layout.NO_HEADING else round(heading * layout.HEADING_STEP_DEG, 4),
            horizontal_rmse_m=_value(column["horizontal_rmse_mm"], 1e-3),
            vertical_rmse_m=_value(column["vertical_rmse_mm"], 1e-3),
            heading_rmse_deg=_value(column["heading_rmse_step"], layout.HEADING_RMSE_STEP_DEG),
            ellipsoidal=bool(column["flags"] & layout.ELLIPSOIDAL_FLAG),
            exact=bool(column["flags"] & layout.EXACT_FLAG),
            kind=kind,
            distance_m=distance_m,
            lane_start_deg=self._lane_start_deg(column),
            earlier_spans=_heard_before(column),
        )

    def _lane_start_deg(self, column: _Columns) -> tuple[float, float] | None:
        if self._kinds[int(column["kind"])].get("scheme") != "information-tag":
            return None
        steps = int(column["lane_lon_step"]), int(column["lane_lat_step"])
        return round(steps[0] * layout.DEGREE_STEP, 9), round(steps[1] * layout.DEGREE_STEP, 9)


def open_snapshot(data: bytes, trust: layout.Trust, now: datetime, *, newest_made_at_ms: int | None = None) -> Snapshot:
    """Verify a snapshot and read it.

    `app.decoders.snapshot` calls it with what the reader remembers.

    Parameters
    ----------
    trust : Trust
        The agency and its server's public keys; they come to the vehicle by another way than the snapshot.
    now : datetime
        Aware; by a clock that nobody on the road can set.
    newest_made_at_ms : int, optional
        `made_at_ms` of the newest snapshot of this agency that the reader has accepted. [ms since 1970-01-01 UTC]

    Raises
    ------
    NoSnapshot, OldSnapshot, FutureSnapshot, TruncatedSnapshot, ForeignSnapshot, ForgedSnapshot, ExpiredSnapshot,
    RolledBackSnapshot
        All are `SnapshotRefused`.
    """
    header = _header(data)
    public_key = trust.find_key(bytes(header["key_id"]))
    if public_key is None:
        raise layout.ForeignSnapshot(
            "the snapshot was signed under another key", limit="the trusted keys", cure="see docs/snapshots.md, Keys"
        )
    signed, signature = data[: -layout.SIGNATURE_BYTES], data[-layout.SIGNATURE_BYTES :]
    try:
        Ed25519PublicKey.from_public_bytes(public_key).verify(signature, signed)
    except InvalidSignature as error:
        raise layout.ForgedSnapshot(
            "the signature does not fit: the snapshot was changed or damaged", limit="Ed25519", cure=_CURE
        ) from error
    if bytes(header["agency_id"]) != uuid.UUID(trust.agency_id).bytes:
        raise layout.ForeignSnapshot(
            "the snapshot is of another agency",
            limit=f"agency {trust.agency_id}",
            cure="fetch it with the agency's key",
        )
    _check_time(header, now)
    if newest_made_at_ms is not None and int(header["made_at_ms"]) < newest_made_at_ms:
        behind_s = (newest_made_at_ms - int(header["made_at_ms"])) / 1000
        raise layout.RolledBackSnapshot(
            f"the snapshot was made {behind_s:.3f} s before one that was already accepted",
            limit="not older than the newest that was accepted",
            cure=_CURE,
        )
    return _read(header, signed[header.dtype.itemsize :])


def _header(data: bytes) -> np.void:
    if data[:8] != layout.MAGIC[: len(data)] or not data:
        raise layout.NoSnapshot("this is no snapshot", limit=f"begins with {layout.MAGIC.decode()}", cure=_CURE)
    version = int.from_bytes(data[8:10], "little") if len(data) >= 10 else layout.VERSION
    limit, message = f"version {layout.VERSION}", f"the snapshot is of version {version}"
    if version > layout.VERSION:
        raise layout.FutureSnapshot(message, limit=limit, cure="update the reader")
    if version < layout.VERSION:
        raise layout.OldSnapshot(message, limit=limit, cure="update the server, and fetch the snapshot again")
    least = layout.HEADER.itemsize + layout.SIGNATURE_BYTES
    header: np.void | None = np.frombuffer(data, dtype=layout.HEADER, count=1)[0] if len(data) >= least else None
    wanted = least + int(header["body_bytes"]) if header is not None else least
    if header is None or len(data) != wanted:
        raise layout.TruncatedSnapshot(f"the snapshot has {len(data)} bytes", limit=f"{wanted} bytes", cure=_CURE)
    return header


def _check_time(header: np.void, now: datetime) -> None:
    now_s, expires_at_s, made_at_ms = now.timestamp(), int(header["expires_at_s"]), int(header["made_at_ms"])
    if now_s >= expires_at_s:
        raise layout.ExpiredSnapshot(
            f"the snapshot expired {now_s - expires_at_s:.0f} s ago", limit="its time", cure=_CURE
        )
    if now_s < made_at_ms / 1000 - _CLOCK_SLACK.total_seconds():
        raise layout.ExpiredSnapshot(
            "the snapshot is from the future", limit="a clock that is right", cure="set the clock"
        )
    if expires_at_s * 1000 - made_at_ms > layout.MAX_VALIDITY // timedelta(milliseconds=1):
        raise layout.ExpiredSnapshot(
            "the snapshot is valid for too long", limit=f"{layout.MAX_VALIDITY.days} days", cure=_CURE
        )


def _read(header: np.void, packed: bytes) -> Snapshot:
    count = int(header["markers"])
    kinds_bytes, codes_bytes, books_bytes = (int(header[f"{name}_bytes"]) for name in ("kinds", "codes", "books"))
    size = count * layout.ROW_BYTES + kinds_bytes + codes_bytes + books_bytes
    try:
        body = zlib.decompressobj().decompress(packed, size + 1)
    except zlib.error as error:
        raise layout.TruncatedSnapshot("the body cannot be inflated", limit="zlib", cure=_CURE) from error
    if len(body) != size or count > layout.MAX_MARKERS:
        raise layout.TruncatedSnapshot(f"the body has {len(body)} bytes", limit=f"{size} bytes", cure=_CURE)
    columns, start = {}, 0
    for name, form in layout.COLUMNS:
        columns[name] = np.frombuffer(body, dtype=form, count=count, offset=start)
        start += columns[name].nbytes
    codes_at, books_at = start + kinds_bytes, start + kinds_bytes + codes_bytes
    kinds, books = orjson.loads(body[start:codes_at]), orjson.loads(body[books_at:])
    return Snapshot(header, columns, kinds, body[codes_at:books_at], books)


def _registered_tag(marker: SnapshotMarker) -> RegisteredTag | None:
    """An information tag; None of a line."""
    tag = parse_tag(marker.code)
    if not isinstance(tag, InformationTag):
        return None
    lane_lon_deg, lane_lat_deg = marker.lane_start_deg or (marker.lon_deg, marker.lat_deg)
    meaning = marker.kind.get("meaning")
    return RegisteredTag(
        marker.marker_id, marker.status, tag, marker.lon_deg, marker.lat_deg, marker.height_m,
        marker.heading_deg or 0.0, lane_lon_deg, lane_lat_deg, marker.horizontal_rmse_m, marker.grade,
        marker.localization_warnings("tag"), None if meaning is None else Meaning(**meaning),
    )  # fmt: skip


def _registered(marker: SnapshotMarker) -> RegisteredMarker:
    limit, rmse_m = marker.kind["speed_limit"], marker.horizontal_rmse_m
    return RegisteredMarker(
        marker.lon_deg,
        marker.lat_deg,
        marker.height_m,
        LaneSide[str(marker.kind["side"]).upper()],
        math.nan if limit is None else limit["value"] * _KM_H[limit["unit"]],
        math.nan if not rmse_m else rmse_m / math.sqrt(2),  # horizontal RMSE is of both axes together
    )


def _heard_before(column: _Columns) -> SequenceSpan | None:
    if not column["flags"] & layout.HEARD_FLAG:
        return None
    heard_ms = int(column["first_heard_ms"]), int(column["last_heard_ms"])
    times_s = (math.nan if ms == layout.NO_TIME else ms / 1000 for ms in heard_ms)
    return SequenceSpan(int(column["first_sequence"]), int(column["last_sequence"]), *times_s)


def _value(steps: SupportsInt, step: float) -> float | None:
    return None if int(steps) == layout.NO_RMSE else round(int(steps) * step, 6)


# === Open snapshots, and remember the newest one: a reader that has seen it refuses older ones.
#
# The memory is a small file. Everything that decides is in `app.decoders.snapshot`.


class UnreadableMemory(UnreadableUpload):
    """The file that remembers the newest snapshot cannot be read; without it a rollback cannot be detected."""


def open_newest_snapshot(data: bytes, trust: Trust, now: datetime, memory: Path) -> Snapshot:
    """Verify a snapshot and read it, unless a newer one of the agency was opened before with the same memory.

    A reader that uses snapshots of several areas keeps one memory for each area: snapshots of different areas were made
    at different times.

    Parameters
    ----------
    data, trust, now
        As of `app.decoders.snapshot.open_snapshot`.
    memory : Path
        File with the time of the newest snapshot of each agency; created if it is missing. It is replaced atomically,
        and is on the disk before the snapshot is returned. Processes may share it.

    Raises
    ------
    SnapshotRefused
        As of `open_snapshot`. The memory is unchanged.
    UnreadableMemory
        The memory is damaged.
    OSError
        The memory cannot be read or written.
    """
    with _locked(memory.parent) as folder:
        newest = _read_newest_snapshot(memory)
        snapshot = open_snapshot(data, trust, now, newest_made_at_ms=newest.get(trust.agency_id))
        if newest.get(trust.agency_id) != snapshot.made_at_ms:
            _replace(memory, {**newest, trust.agency_id: snapshot.made_at_ms}, folder)
    return snapshot


@contextmanager
def _locked(folder: Path) -> Iterator[int]:
    """Descriptor of a folder that no other process locks meanwhile."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield descriptor
    finally:
        os.close(descriptor)


def _read_newest_snapshot(memory: Path) -> dict[str, int]:
    try:
        newest = orjson.loads(memory.read_bytes())
    except FileNotFoundError:
        return {}
    except orjson.JSONDecodeError:
        newest = None
    if not isinstance(newest, dict) or not all(type(made_at_ms) is int for made_at_ms in newest.values()):
        raise UnreadableMemory(
            f"{memory} is damaged",
            limit="an object of times by agency",
            cure="restore it; or remove it, and open a snapshot that was just fetched from the server",
        )
    return newest


def _replace(memory: Path, newest: dict[str, int], folder: int) -> None:
    """Write the file so that it is either the old or the new one after a loss of power."""
    fresh = memory.with_name(memory.name + ".new")
    with fresh.open("wb") as file:
        file.write(orjson.dumps(newest))
        file.flush()
        os.fsync(file.fileno())
    fresh.replace(memory)
    os.fsync(folder)
