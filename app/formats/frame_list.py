"""A list of frames beside the pictures of a drive: when each was taken, and where the vehicle was.

`frames.csv` has a header line and one row for each picture; `frames.json` has one object for each, alone in a list or
under `frames`. A row names its picture; time, position, heading and accuracy are optional.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from app.errors import InvalidParameter, UnreadableUpload, UploadTooLarge
from app.formats.format import NAME_LENGTH, Sample
from app.formats.logs import ACCEPTED_TIMES, LogClock, LogReport, check_datum, in_hemisphere
from app.formats.poses import ALIASES, PoseDeclaration
from app.formats.text import clean_text, match_columns, read_number
from app.sensors.pose_track import find_jumps

FRAME_LISTS = ("frames.csv", "frames.json")
"""Names of the files, in any folder of an archive."""
TRACK_SUFFIXES, TRACKS = (".gpx", ".nmea", ".nma"), ("poses.csv", "track.csv")
"""Names of a track of the vehicle beside the frames."""
MAX_LIST_BYTES = 4 * 1024**2
"""[byte] 40,000 rows of 100 characters."""
_NAMES = ("file", "file_name", "filename", "name", "frame", "image", "picture", "path")
_ALIASES = {"file": _NAMES, **ALIASES}


@dataclass(frozen=True, slots=True)
class ListedFrame:
    """A row about one picture; NaN where it states nothing."""

    name: str  # of the picture, without its folder
    time_s: float = math.nan  # [s] seconds since 1970-01-01 UTC
    # `lon_deg`, `lat_deg`, `heading_deg`: [deg]
    lon_deg: float = math.nan
    lat_deg: float = math.nan
    heading_deg: float = math.nan
    accuracy_m: float = math.nan  # [m] standard deviation of the position

    @property
    def has_position(self) -> bool:
        """Whether it states a position."""
        return math.isfinite(self.lon_deg) and math.isfinite(self.lat_deg)


@dataclass(frozen=True, slots=True)
class FrameList:
    """What a list of frames states."""

    frames: Mapping[str, ListedFrame] = field(default_factory=dict)  # by the name of the picture
    report: LogReport = field(default_factory=LogReport)  # what was left out, and why


def is_frame_list(name: str) -> bool:
    """Whether a file of an archive is the list of its frames, by its name."""
    return _last(name).lower() in FRAME_LISTS


def is_beside_frames(name: str) -> bool:
    """Whether a file of an archive of frames is a list of the frames or a track of the vehicle, by its name."""
    last = _last(name).lower()
    return last in FRAME_LISTS or last.endswith(TRACK_SUFFIXES) or last in TRACKS


def read_frame_list(name: str, data: bytes, declaration: PoseDeclaration | None = None) -> FrameList:
    """Read a list of frames.

    Parameters
    ----------
    name : str
        Of the file; its suffix distinguishes JSON.
    declaration : PoseDeclaration, optional
        Clock, names of columns, and datum, as of a track.

    Raises
    ------
    UploadTooLarge
        The list is larger than `MAX_LIST_BYTES`.
    UnreadableUpload
        It is no JSON, or no list of objects.
    InvalidParameter
        A column is missing, or dates do not show the order of day and month.
    ReferenceSystemError
        The positions have another datum than WGS 84.
    """
    declaration, report = declaration or PoseDeclaration(), LogReport(format="frames")
    if len(data) > MAX_LIST_BYTES:
        raise UploadTooLarge(f"{name} has {len(data)} bytes", field="file", limit=f"{MAX_LIST_BYTES} bytes")
    read_rows = _json_rows if name.lower().endswith(".json") else _csv_rows
    rows = list(read_rows(name, data, declaration))
    texts = (str(values.get("time", "")) for _entry, values in rows if values is not None)
    is_track = any(values is not None and "lon" in values and "lat" in values for _entry, values in rows)
    times = declaration.times if is_track else declaration.frame_times
    clock = times.of_column(texts, "poses.clock.day_first")
    listed: dict[str, ListedFrame] = {}
    seen: set[str] = set()
    for entry, values in rows:
        report.entries += 1
        if values is None:
            report.leave_out(entry, "malformed", "the row cannot be read")
            continue
        frame = _frame_of(values, declaration, clock)
        if report.note_unread_time(values.get("time"), frame.time_s):
            report.warn(f"{report.unread_time!r} is no time between 2000 and 2100; times are {ACCEPTED_TIMES}")
        problem = _problem(frame)
        if problem is not None:
            report.leave_out(entry, *problem)
        elif frame.name in seen:
            listed.pop(frame.name, None)
            report.leave_out(entry, "same-name", f"another row names {frame.name}: neither is used")
        else:
            listed[frame.name] = frame
        seen.add(frame.name)
    if declaration.crs:
        for frame in listed.values():
            if frame.has_position:
                check_datum(declaration.crs, frame.lon_deg, frame.lat_deg)
                break
    return FrameList(_without_jumps(listed, report), report)


def _csv_rows(name: str, data: bytes, declaration: PoseDeclaration) -> Iterator[tuple[int, dict[str, object] | None]]:
    sample = Sample(name, data, declaration.columns or {})
    if not sample.is_text:
        raise UnreadableUpload(f"{name} is no text", field="file", cure="save the list of frames as CSV")
    log = sample.log
    places = log.places(_ALIASES, declaration.columns or {})
    if "file" not in places:
        shown = ", ".join(repr(clean_text(column, 40)) for column in log.columns[:24])
        raise InvalidParameter(
            f"{name} has no column with the names of the pictures; its columns are {shown}",
            field="file",
            limit=", ".join(_NAMES),
            cure="name the column file",
        )
    decimal = log.dialect.decimal
    for entry, cells in enumerate(log.rows()):
        if cells is None:
            yield entry, None
            continue
        values: dict[str, object] = {quantity: cells[place].strip() for quantity, place in places.items()}
        try:
            for quantity in ("lon", "lat", "heading", "accuracy"):
                if quantity in values:
                    values[quantity] = read_number(values[quantity], decimal)
        except (ValueError, OverflowError):
            yield entry, None
            continue
        yield entry, values


def _json_rows(name: str, data: bytes, declaration: PoseDeclaration) -> Iterator[tuple[int, dict[str, object] | None]]:
    try:
        document = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise UnreadableUpload(f"{name} is no JSON", field="file", cure="write one list of objects") from error
    listed = document.get("frames") if isinstance(document, dict) else document
    if not isinstance(listed, list):
        raise UnreadableUpload(f"{name} has no list of frames", field="file", cure='write {"frames": [{"file": ...}]}')
    for entry, row in enumerate(listed):
        if not isinstance(row, dict):
            yield entry, None
            continue
        names = tuple(str(key)[:64] for key in row)[:256]
        places = match_columns(names, _ALIASES, declaration.columns or {})
        cells = list(row.values())
        yield entry, {quantity: cells[place] for quantity, place in places.items()}


def _frame_of(values: Mapping[str, object], declaration: PoseDeclaration, clock: LogClock) -> ListedFrame:
    def number(quantity: str) -> float:
        value = values.get(quantity)
        if isinstance(value, bool) or not isinstance(value, int | float) or abs(value) > 1e9:
            return math.nan
        side = f"{quantity}_hemisphere"
        try:
            return in_hemisphere(float(value), values[side], side) if side in values else float(value)
        except ValueError:
            return math.nan

    name = values.get("file")
    accuracy_m, heading_deg = number("accuracy"), number("heading")
    return ListedFrame(
        _last(name) if isinstance(name, str) else "",
        clock.read(values.get("time")),
        number("lon"),
        number("lat"),
        heading_deg % 360.0,
        accuracy_m if accuracy_m > 0 else declaration.accuracy_m or math.nan,
    )


def _problem(frame: ListedFrame) -> tuple[str, str] | None:
    """Why a row is left out, as its kind and a sentence."""
    if not frame.name:
        return "no-name", "the row names no picture"
    if frame.has_position and not (abs(frame.lon_deg) <= 180 and abs(frame.lat_deg) <= 90):
        return "off-globe", "the position is out of range"
    if frame.lon_deg == 0 and frame.lat_deg == 0:
        return "null-island", "0, 0: the receiver had no position"
    return None


def _without_jumps(listed: dict[str, ListedFrame], report: LogReport) -> dict[str, ListedFrame]:
    """The frames without positions that can only be reached too fast, from both sides; their times stay."""
    placed = sorted(
        (frame for frame in listed.values() if frame.has_position and math.isfinite(frame.time_s)),
        key=lambda frame: frame.time_s,
    )
    table = np.array([(frame.time_s, frame.lon_deg, frame.lat_deg) for frame in placed]).reshape(-1, 3)
    order = list(listed)
    for frame, jumps in zip(placed, find_jumps(table), strict=True):
        if jumps:
            report.leave_out(order.index(frame.name), "jump", f"the position of {frame.name} jumps; it is not used")
            listed[frame.name] = ListedFrame(frame.name, frame.time_s)
    return listed


def _last(name: str) -> str:
    """The last part of a path, as `Member.name` has it."""
    last = name.replace("\\", "/").rsplit("/", 1)[-1]
    return "".join(c if c.isprintable() and not 0xD800 <= ord(c) <= 0xDFFF else "?" for c in last)[:NAME_LENGTH]
