"""Valid files of roads with known content, for `benchmarks.fuzz.grammar`."""

from __future__ import annotations

import math

import numpy as np

from app.formats.alignments.read import read_alignment
from benchmarks.fuzz.grammar import Check, Grammar, Rng
from benchmarks.fuzz.grammar_dxf import write_dxf, write_dxf_survey
from benchmarks.fuzz.grammar_landxml import write_landxml

# === OpenDRIVE: one straight road with a lane offset and widths as cubics that begin anywhere.


def _xodr(rng: Rng) -> tuple[str, Check]:
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


ROAD_GRAMMARS: dict[str, Grammar] = {
    "landxml": write_landxml,
    "dxf": write_dxf,
    "dxf-survey": write_dxf_survey,
    "opendrive": _xodr,
}
