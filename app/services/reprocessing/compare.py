"""Two results of one upload, reading by reading."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from typing import Any, Literal, NamedTuple, NotRequired

from pyproj import Geod
from typing_extensions import TypedDict

MIN_MOVED_M = 0.01
"""A reading whose position moved less is the same. [m] Source: below what any of the sensors resolves."""
MIN_CONFIDENCE_STEP = 0.01
SAME_TAG_S = 1.0
"""Tags of a trace whose middles are no farther apart are the same one. [s] Source: at 30 m/s, a tag's length."""
_WGS84 = Geod(ellps="WGS84")


class Change(TypedDict):
    """How a reading differs. Members that do not apply are left out."""

    change: Literal["gained", "lost", "changed"]
    family: str
    frame: NotRequired[int]
    at_s: NotRequired[float]
    code_before: str | None
    code: str | None
    confidence_before: NotRequired[float | None]
    confidence: NotRequired[float | None]
    moved_m: NotRequired[float]


class Comparison(NamedTuple):
    """The changes, and the number of readings that are the same."""

    changes: list[Change]
    same: int


class _Reading(NamedTuple):
    family: str
    code: str
    frame: int | None = None
    at_s: float | None = None
    confidence: float | None = None
    place: tuple[float, float] | None = None


def compare_results(before: Mapping[str, Any], after: Mapping[str, Any]) -> Comparison:
    """How the readings of a result differ from those of an earlier one, whatever the kind of upload.

    A reading is the same if its family, its frame or time, and its code are; what is left over at the same place of
    the upload is a changed code; the rest was gained or lost.
    """
    changes: list[Change] = []
    same = 0
    olds, news = _by_place(before), _by_place(after)
    for place in sorted(set(olds) | set(news), key=str):
        old, new = list(olds[place]), list(news[place])
        for reading in list(old):
            twin = _find(new, reading)
            if twin is None:
                continue
            old.remove(reading)
            new.remove(twin)
            change = _difference(reading, twin)
            if change is None:
                same += 1
            else:
                changes.append(change)
        while old and new:
            one = old.pop(0)
            other = _at_the_same_time(one, new)
            if other is None:
                changes.append(_change("lost", one, None))
            else:
                new.remove(other)
                changes.append(_change("changed", one, other))
        changes += [_change("lost", one, None) for one in old]
        changes += [_change("gained", None, one) for one in new]
    return Comparison(changes, same)


def _find(candidates: list[_Reading], wanted: _Reading) -> _Reading | None:
    same = [one for one in candidates if one.code == wanted.code]
    if wanted.at_s is None:
        return same[0] if same else None
    return _at_the_same_time(wanted, same)


def _at_the_same_time(wanted: _Reading, candidates: list[_Reading]) -> _Reading | None:
    if wanted.at_s is None:
        return candidates[0] if candidates else None
    near = [one for one in candidates if abs((one.at_s or 0.0) - wanted.at_s) <= SAME_TAG_S]
    return min(near, key=lambda one: abs((one.at_s or 0.0) - (wanted.at_s or 0.0)), default=None)


def _difference(one: _Reading, other: _Reading) -> Change | None:
    moved_m = _distance_m(one, other)
    step = abs((one.confidence or 0.0) - (other.confidence or 0.0))
    if (moved_m or 0.0) < MIN_MOVED_M and step < MIN_CONFIDENCE_STEP:
        return None
    return _change("changed", one, other)


def _change(kind: Literal["gained", "lost", "changed"], before: _Reading | None, after: _Reading | None) -> Change:
    known = after or before
    assert known is not None
    change: Change = {
        "change": kind,
        "family": known.family,
        "code_before": before.code if before else None,
        "code": after.code if after else None,
    }
    if known.frame is not None:
        change["frame"] = known.frame
    if known.at_s is not None:
        change["at_s"] = round(known.at_s, 3)
    if before is not None:
        change["confidence_before"] = before.confidence
    if after is not None:
        change["confidence"] = after.confidence
    if before is not None and after is not None and (moved_m := _distance_m(before, after)) is not None:
        change["moved_m"] = round(moved_m, 3)
    return change


def _distance_m(one: _Reading, other: _Reading) -> float | None:
    if one.place is None or other.place is None:
        return None
    return float(_WGS84.inv(*one.place, *other.place)[2])


def _by_place(result: Mapping[str, Any]) -> dict[tuple[str, int | None], list[_Reading]]:
    found: dict[tuple[str, int | None], list[_Reading]] = defaultdict(list)
    for reading in _readings(result):
        found[reading.family, reading.frame].append(reading)
    return found


def _readings(result: Mapping[str, Any]) -> Iterator[_Reading]:
    """The readings of a result of any kind: plates and fiducials of frames, tags of traces, CERPMs of packet logs."""
    for one in result.get("readings") or ():
        code = one.get("digits") or one.get("code") or one.get("id")
        if one.get("outcome", "read") == "read" and code is not None:
            yield _Reading(
                one["family"], str(code), frame=one.get("frame"), confidence=one.get("confidence"),
                place=_place(one.get("fix")),
            )  # fmt: skip
    for one in result.get("tags") or ():
        yield _Reading(
            "magnet", one.get("tag") or "unreadable", at_s=(one["start_s"] + one["end_s"]) / 2,
            confidence=one.get("confidence"), place=_place(one.get("fix")),
        )  # fmt: skip
    for one in result.get("markers") or ():
        if "number" in one:
            yield _Reading("cerpm", str(one["number"]), place=_place(one))


def _place(fix: Mapping[str, Any] | None) -> tuple[float, float] | None:
    if fix is None or fix.get("lon_deg") is None or fix.get("lat_deg") is None:
        return None
    return fix["lon_deg"], fix["lat_deg"]
