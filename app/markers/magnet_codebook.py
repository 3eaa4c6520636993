"""What the codes of information tags mean: meanings and the book that an agency keeps of them.

Source: METRO paper, sections 4, 6.3, 8.3 and 10 (arrows, stop line ahead, "prepare a 125 degree right turn").
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from app.errors import CodeMismatch, Conflict, InvalidParameter
from app.markers.magnet import InformationTag, parse_tag
from app.markers.magnet_design import TagDesign

MAX_NAME = 80
CODEBOOK_FORMAT = "waymark-codebook/1"


class MeaningKind(StrEnum):
    """Kinds of messages to a vehicle."""

    ARROW = "arrow"
    STOP_LINE_AHEAD = "stop-line-ahead"
    SPEED_LIMIT_KMH = "speed-limit-kmh"
    SPEED_LIMIT_MPH = "speed-limit-mph"
    BEND_LEFT = "bend-left"
    BEND_RIGHT = "bend-right"
    NOTICE = "notice"


class Arrow(StrEnum):
    """Directions that an arrow on the lane shows."""

    STRAIGHT = "straight"
    LEFT = "left"
    RIGHT = "right"
    STRAIGHT_LEFT = "straight-left"
    STRAIGHT_RIGHT = "straight-right"
    LEFT_RIGHT = "left-right"
    U_TURN = "u-turn"


_NUMBERS: dict[MeaningKind, tuple[str, float, float]] = {
    MeaningKind.STOP_LINE_AHEAD: ("m", 1.0, 500.0),
    MeaningKind.SPEED_LIMIT_KMH: ("km/h", 5.0, 150.0),
    MeaningKind.SPEED_LIMIT_MPH: ("mph", 5.0, 90.0),
    MeaningKind.BEND_LEFT: ("deg", 1.0, 180.0),
    MeaningKind.BEND_RIGHT: ("deg", 1.0, 180.0),
}
"""Unit and limits of the kinds whose value is a number."""


@dataclass(frozen=True, slots=True)
class Meaning:
    """A kind and its value.

    Parameters
    ----------
    kind : MeaningKind
    value : float or str
        A number in the kind's unit (distance to the stop line [m], speed limit, angle of the bend [deg]), the `Arrow`,
        or the text of a notice, 1 to 80 printable characters.

    Raises
    ------
    InvalidParameter
        The value does not belong to the kind.
    """

    kind: MeaningKind
    value: float | str

    def __post_init__(self) -> None:
        try:
            kind = MeaningKind(self.kind)
        except ValueError as error:
            raise InvalidParameter(
                f"{str(self.kind)[:40]!r} is no kind of meaning", field="kind", limit=", ".join(MeaningKind)
            ) from error
        object.__setattr__(self, "kind", kind)
        object.__setattr__(self, "value", _checked_value(kind, self.value))

    @property
    def unit(self) -> str:
        """Unit of the value; empty for arrows and notices."""
        return _NUMBERS[self.kind][0] if self.kind in _NUMBERS else ""

    @property
    def text(self) -> str:
        """For people, e.g. ``bend right 125 deg``."""
        value = f"{self.value:g}" if isinstance(self.value, float) else self.value
        kind = {MeaningKind.SPEED_LIMIT_KMH: "speed limit", MeaningKind.SPEED_LIMIT_MPH: "speed limit"}.get(
            self.kind, self.kind.value.replace("-", " ")
        )
        return value if self.kind is MeaningKind.NOTICE else f"{kind} {value} {self.unit}".rstrip()


def _checked_value(kind: MeaningKind, value: float | str) -> float | str:
    if kind in _NUMBERS:
        unit, low, high = _NUMBERS[kind]
        if isinstance(value, (str, bool)) or not math.isfinite(value) or not low <= value <= high:
            raise InvalidParameter(
                f"the value of {kind} is {value!r}", field="value", limit=f"{low:g} to {high:g} {unit}"
            )
        return float(value)
    if kind is MeaningKind.ARROW:
        if value not in set(Arrow):
            raise InvalidParameter(f"{str(value)[:40]!r} is no arrow", field="value", limit=", ".join(Arrow))
        return Arrow(value).value
    check_name("value", value)
    return value


def check_name(field: str, text: Any) -> None:
    """Refuse what is not a printable line of text."""
    plain = isinstance(text, str) and 1 <= len(text) <= MAX_NAME and text.isprintable() and text == text.strip()
    if not plain:
        raise InvalidParameter(
            f"{field} is not a line of text that can be printed",
            field=field,
            limit=f"1 to {MAX_NAME} printable characters without spaces at the ends",
        )


@dataclass(frozen=True, slots=True)
class Codebook:
    """The codes of one design and what they mean.

    Parameters
    ----------
    name : str
        1 to 80 printable characters.
    design : TagDesign
        What all its tags share.
    entries : tuple of (InformationTag, Meaning)
        In the order in which they were added.

    Raises
    ------
    InvalidParameter
        A tag is not of the design.
    Conflict
        A code or a meaning occurs twice.
    """

    name: str
    design: TagDesign
    entries: tuple[tuple[InformationTag, Meaning], ...] = ()

    def __post_init__(self) -> None:
        check_name("name", self.name)
        object.__setattr__(self, "entries", tuple(self.entries))
        for tag, _ in self.entries:
            if not self.design.admits(tag):
                raise CodeMismatch(
                    f"{tag.text} is not a code of this book",
                    field="entries",
                    limit=f"M = {self.design.magnets}, L = {self.design.length_m:g} m, "
                    f"Seg_d = {self.design.segment_m:g} m, neighbours at least {self.design.min_gap_m:g} m apart",
                )
        for what, values in (("code", self.tags), ("meaning", tuple(meaning for _, meaning in self.entries))):
            if len(set(values)) != len(values):
                raise Conflict(f"a {what} occurs twice in the book", field="entries", limit=f"each {what} once")

    @property
    def tags(self) -> tuple[InformationTag, ...]:
        """The codes, in the order in which they were added."""
        return tuple(tag for tag, _ in self.entries)

    def find_meaning(self, tag: InformationTag) -> Meaning | None:
        """What a tag means, or None if it is not in the book."""
        return dict(self.entries).get(tag)

    def find_tag(self, meaning: Meaning) -> InformationTag | None:
        """The code of a meaning, or None if it has none."""
        return next((tag for tag, known in self.entries if known == meaning), None)

    def to_document(self) -> dict[str, Any]:
        """As plain values, for JSON."""
        design = self.design
        return {
            "format": CODEBOOK_FORMAT,
            "name": self.name,
            "design": {
                "magnets": design.magnets,
                "length_m": design.length_m,
                "segment_m": design.segment_m,
                "min_gap_m": design.min_gap_m,
            },
            "entries": [{"code": t.text, "kind": m.kind.value, "value": m.value} for t, m in self.entries],
        }

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> Codebook:
        """The book that `to_document` wrote.

        Raises
        ------
        InvalidParameter
            It is not one: a part is missing, of the wrong type, or outside its limits.
        """
        if document.get("format") != CODEBOOK_FORMAT:
            raise InvalidParameter("this is not a codebook", field="format", limit=CODEBOOK_FORMAT)
        try:
            design = TagDesign(**document["design"])
            entries = tuple((parse_tag(e["code"]), Meaning(e["kind"], e["value"])) for e in document["entries"])
        except (KeyError, TypeError, AttributeError) as error:
            raise InvalidParameter(
                f"the codebook is incomplete or of the wrong form: {error}",
                field="document",
                limit="name, design {magnets, length_m, segment_m, min_gap_m}, entries [{code, kind, value}]",
            ) from error
        if not all(isinstance(tag, InformationTag) for tag, _ in entries):
            raise CodeMismatch("line tags have no place in a codebook", field="entries", limit="information tags")
        return cls(document.get("name", ""), design, entries)  # type: ignore[arg-type]
