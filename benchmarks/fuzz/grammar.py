"""Valid files of a format's grammar with random but known content: what is read must be what was written.

Each writer follows the format's own description, not this project's readers. A refusal counts as refused, because a
vehicle's operator can act on it; a value that differs without one is a failure.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta

import numpy as np

from app.errors import WaymarkError
from app.formats.alignments.read import read_alignment
from app.formats.poses import PoseDeclaration, read_poses
from app.formats.traces.can_log import read_can_log
from app.formats.traces.declaration import CanDeclaration, CanSignal, TraceLimits, TraceReport
from app.formats.traces.parts import open_parts

Rng = np.random.Generator


@dataclass(slots=True)
class Compared:
    """What came of the files of one grammar."""

    tried: int = 0
    refused: int = 0
    failures: list[str] = field(default_factory=list)


def compare(name: str, files: int, seed: int = 1) -> Compared:
    """Write and read files of a grammar; the first failures with their seeds and files."""
    found = Compared()
    for number in range(files):
        rng = np.random.default_rng([seed, number])
        found.tried += 1
        text = ""
        try:
            text, check = GRAMMARS[name](rng)
            problem = check()
        except WaymarkError as error:
            found.refused += 1
            problem = f"a valid file was refused: {error}"
        if problem and len(found.failures) < 5:
            found.failures.append(f"{name}, seed {seed}/{number}: {problem}\n{text[:1500]}")
    return found


# === CAN logs: candump's log file, Vector's ASC, SavvyCAN's CSV.


def _can(rng: Rng) -> tuple[str, Callable[[], str]]:
    """Speed in 16 bits of one identifier among others, on one of several channels, 11 or 29 bits."""
    is_extended, channel = bool(rng.integers(2)), int(rng.integers(1, 4))
    own = int(rng.integers(0x800, 0x1FFFFFFF) if is_extended else rng.integers(1, 0x7FF))
    start, step = float(rng.integers(10_000, 2_000_000)) + 0.25, float(rng.choice([0.01, 0.02, 0.1]))
    count = int(rng.integers(12, 60))
    kmh = np.round(np.abs(np.cumsum(rng.normal(0, 1.5, count)) + 40), 2)
    frames: list[tuple[float, int, bool, int, bytes]] = []
    for k, value in enumerate(kmh):
        data = round(float(value) * 100).to_bytes(2, "little") + bytes(rng.integers(0, 256, 6, np.uint8))
        at = start + k * step
        frames.append((at, own, is_extended, channel, data))
        if rng.random() < 0.5:  # the same number of the other length, on the same channel
            frames.append((at + step / 5, own & 0x7FF or 1, not is_extended, channel, bytes(8)))
        if rng.random() < 0.5:
            frames.append((at + step / 4, own, is_extended, channel % 3 + 1, bytes([9] * 8)))
        if rng.random() < 0.3 and own != 0x7DF:
            frames.append((at + step / 3, 0x7DF, False, channel, bytes(8)))
    kind = str(rng.choice(["candump", "asc", "asc relative", "savvycan"]))
    text = {
        "candump": _candump, "asc": _asc, "asc relative": lambda f: _asc(f, relative=True), "savvycan": _savvycan,
    }[kind](frames)  # fmt: skip
    name = {"candump": "drive.log", "savvycan": "drive.csv"}.get(kind, "drive.asc")
    signal = CanSignal(arbitration_id=own, start_bit=0, length=16, factor=0.01, unit="km/h", extended=is_extended)
    declared = f"can{channel}" if kind == "candump" else channel

    def check() -> str:
        (part,) = open_parts({name: text.encode()}, TraceLimits())
        declaration = CanDeclaration(speed=signal, offset_s=0.0, channel=declared)
        series = read_can_log(part, [], declaration, TraceLimits(), TraceReport())["speed"]
        if len(series.value) != count:
            return f"{kind}: {len(series.value)} of {count} values"
        if np.abs(series.value - kmh).max() > 1e-9:
            return f"{kind}: other values"
        if np.abs(series.t_s - series.t_s[0] - np.arange(count) * step).max() > 2e-6 * count:
            return f"{kind}: other times"
        return ""

    return text, check


def _candump(frames: list[tuple[float, int, bool, int, bytes]]) -> str:
    """candump -l of can-utils: 3 or 8 digits tell the lengths of identifiers apart."""
    return "".join(
        f"({t:.6f}) can{channel} {number:0{8 if is_extended else 3}X}#{data.hex().upper()}\n"
        for t, number, is_extended, channel, data in frames
    )


def _asc(frames: list[tuple[float, int, bool, int, bytes]], *, relative: bool = False) -> str:
    """Vector's ASC: an x after 29 bits; relative times are those since the line before."""
    base = "relative" if relative else "absolute"
    lines = ["date Mon Jun 1 08:00:00.000 am 2026", f"base hex  timestamps {base}", "internal events logged",
             "Begin Triggerblock Mon Jun 1 08:00:00.000 am 2026"]  # fmt: skip
    zero = frames[0][0] - 0.5
    last = zero
    for t, number, is_extended, channel, data in frames:
        shown = round(t - zero, 6) - round(last - zero, 6) if relative else t - zero
        last = t
        text = f"{number:X}{'x' if is_extended else ''}"
        lines.append(f"   {shown:.6f} {channel}  {text:15} Rx   d {len(data)} " + " ".join(f"{b:02X}" for b in data))
    return "\n".join([*lines, "End TriggerBlock", ""])


def _savvycan(frames: list[tuple[float, int, bool, int, bytes]]) -> str:
    lines = ["Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8"]
    for t, number, is_extended, channel, data in frames:
        cells = ",".join(f"{b:02X}" for b in data)
        lines.append(f"{round(t * 1e6)},{number:08X},{str(is_extended).lower()},Rx,{channel},{len(data)},{cells},")
    return "\n".join([*lines, ""])


# === NMEA 0183: sentences of an epoch in the order of the receiver's choice.


def _nmea(rng: Rng) -> tuple[str, Callable[[], str]]:
    """Positions with headings, over midnight or not, with talkers and sentences of different receivers."""
    count, rate_s = int(rng.integers(4, 20)), float(rng.choice([0.1, 0.2, 1.0]))
    begins = datetime(2026, int(rng.integers(1, 13)), 28, 23, 59, 59, tzinfo=UTC) - timedelta(
        seconds=float(rng.choice([0.0, 1.0, 40_000.0]))
    )
    lon = float(rng.uniform(-179, 179)) + np.cumsum(np.full(count, 4e-6))
    lat = float(rng.uniform(-70, 70)) + np.cumsum(np.full(count, 3e-6))
    heading = (float(rng.uniform(0, 360)) + np.cumsum(rng.uniform(2, 9, count))) % 360
    talker, fixes = str(rng.choice(["GP", "GN", "GL"])), str(rng.choice(["RMC", "GGA+ZDA", "RMC+GGA"]))
    order = rng.permutation(3)
    lines: list[str] = []
    for k in range(count):
        at = begins + timedelta(seconds=k * rate_s)
        clock = at.strftime("%H%M%S") + f".{at.microsecond // 10_000:02d}"
        place = f"{_degrees(lat[k], 'NS', 2)},{_degrees(lon[k], 'EW', 3)}"
        epoch = [
            f"{talker}RMC,{clock},A,{place},20.0,{heading[k]:.2f},{at:%d%m%y},,,A" if "RMC" in fixes else "",
            f"{talker}GGA,{clock},{place},4,12,0.8,100.0,M,47.0,M,," if "GGA" in fixes else "",
            f"{talker}HDT,{heading[k]:.2f},T",
        ]
        if fixes == "GGA+ZDA":
            epoch[0] = f"{talker}ZDA,{clock},{at:%d},{at:%m},{at:%Y},00,00"
        lines += [_sentence(epoch[place]) for place in order if epoch[place]]
    text = "\r\n".join([*lines, ""])

    def check() -> str:
        track, report = read_poses("a.nmea", text.encode(), PoseDeclaration())
        if len(track.time_s) != count:
            return f"{len(track.time_s)} of {count} positions ({fixes}, order {order})"
        wanted = begins.timestamp() + np.arange(count) * rate_s
        if np.abs(track.time_s - wanted).max() > 0.011:
            return f"times off by {np.abs(track.time_s - wanted).max():.2f} s ({fixes}, order {order})"
        if max(np.abs(track.lon_deg - lon).max(), np.abs(track.lat_deg - lat).max()) > 2e-7:
            return "other positions"
        off = np.abs((track.heading_deg - heading + 180) % 360 - 180)
        if not np.nanmax(off, initial=0.0) < 0.02 and not report.warnings:
            return f"headings off by {np.nanmax(off):.1f} deg, without a warning ({fixes}, order {order})"
        return ""

    return text, check


def _degrees(value: float, signs: str, width: int) -> str:
    whole, minutes = divmod(abs(value) * 60, 60)
    return f"{int(whole):0{width}d}{minutes:010.7f},{signs[int(value < 0)]}"


def _sentence(content: str) -> str:
    checksum = 0
    for byte in content.encode():
        checksum ^= byte
    return f"${content}*{checksum:02X}"


# === OpenDRIVE: one straight road with a lane offset and widths as cubics that begin anywhere.


def _xodr(rng: Rng) -> tuple[str, Callable[[], str]]:
    """The centre of a lane is half its width beside the lane offset, at every s; before a first record both are 0."""
    length, hdg = float(rng.uniform(120, 400)), float(rng.uniform(-3, 3))
    x0, y0 = 458_000 + float(rng.uniform(0, 500)), 5_428_000 + float(rng.uniform(0, 500))
    offsets = _cubics(rng, length, first=float(rng.choice([0.0, 40.0])), level=float(rng.uniform(-2, 2)), slope=0.004)
    widths = _cubics(rng, length, first=0.0, level=float(rng.uniform(3, 4)), slope=0.002)
    side = int(rng.choice([-1, 1]))
    records = "".join(_record("laneOffset", "s", *one) for one in offsets)
    width = "".join(_record("width", "sOffset", *one) for one in widths)
    lane = f'<lane id="{side}" type="driving" level="false">{width}</lane>'
    where = "right" if side < 0 else "left"
    text = (
        '<?xml version="1.0"?><OpenDRIVE><header revMajor="1" revMinor="6"><geoReference><![CDATA[EPSG:25832]]>'
        f'</geoReference></header><road name="" length="{length!r}" id="1" junction="-1"><planView>'
        f'<geometry s="0" x="{x0!r}" y="{y0!r}" hdg="{hdg!r}" length="{length!r}"><line/></geometry></planView>'
        f'<lanes>{records}<laneSection s="0">{"" if side < 0 else _side(where, lane)}<center><lane id="0" type="none"/>'
        f"</center>{_side(where, lane) if side < 0 else ''}</laneSection></lanes></road></OpenDRIVE>"
    )

    def check() -> str:
        (found,) = read_alignment(text.encode()).lanes
        line = found.centre
        if line is None:
            return "no centre"
        ahead, left = np.array([math.cos(hdg), math.sin(hdg)]), np.array([-math.sin(hdg), math.cos(hdg)])
        rest = line[:, :2] - [x0, y0]
        s, t = rest @ ahead, rest @ left
        wanted = np.array([_value(offsets, at) + side * _value(widths, at) / 2 for at in s])
        off = np.abs(t - wanted)
        if off.max() > 0.005:
            return f"{off.max():.3f} m off at s {s[int(off.argmax())]:.1f} of {length:.1f}"
        if min(abs(s.max() - length), abs(s.min())) > 0.5:
            return f"the lane is from {s.min():.1f} to {s.max():.1f} of {length:.1f} m"
        return ""

    return text, check


def _side(where: str, lane: str) -> str:
    return f"<{where}>{lane}</{where}>"


def _cubics(rng: Rng, length: float, *, first: float, level: float, slope: float) -> list[tuple[float, ...]]:
    """Records that join in value, from a start on; the first one begins at 0 where it begins late."""
    starts = [first]
    while starts[-1] < length - 60 and len(starts) < 4:
        starts.append(starts[-1] + float(rng.uniform(30, 60)))
    records = list[tuple[float, ...]]()
    value = level if first == 0 else 0.0
    for k, at in enumerate(starts):
        end = starts[k + 1] if k + 1 < len(starts) else length
        b, c, d = rng.uniform(-slope, slope), rng.uniform(-1, 1) * 1e-5, rng.uniform(-1, 1) * 1e-8
        records.append((at, value, float(b), float(c), float(d)))
        ds = end - at
        value += b * ds + c * ds**2 + d * ds**3
    return records


def _value(records: list[tuple[float, ...]], at: float) -> float:
    at = max(at, 0.0)  # the place of the first vertex is -1e-9
    held = [one for one in records if one[0] <= at]
    if not held:
        return 0.0
    start, a, b, c, d = held[-1]
    ds = at - start
    return a + b * ds + c * ds**2 + d * ds**3


def _record(tag: str, s_name: str, s: float, a: float, b: float, c: float, d: float) -> str:
    return f'<{tag} {s_name}="{s!r}" a="{a!r}" b="{b!r}" c="{c!r}" d="{d!r}"/>'


GRAMMARS: dict[str, Callable[[Rng], tuple[str, Callable[[], str]]]] = {"can": _can, "nmea": _nmea, "opendrive": _xodr}
"""A file as text, and what compares its content: the difference, empty for none."""
